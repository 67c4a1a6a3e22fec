"""Recipes that somebody else wrote: each is refused in one line, soon, and nothing in it is resolved or executed."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from datagen.common.errors import RecipeError
from datagen.recipe import DatasetRecipe
from datagen.recipe.text import read_values
from training.recipes.files import recipe_in
from workflows.cli import main as cli
from workflows.recipe.loader import change_recipe, load_recipe
from workflows.studies.comparison.plan import plan_comparison
from workflows.studies.sweep.plan import plan_sweep

READERS: dict[str, Callable[[Path], object]] = {
    "a recipe": lambda path: load_recipe(str(path)),
    "a training recipe": recipe_in,
    "a sweep": lambda path: plan_sweep(recipe="smoke", shared=[], trials=str(path)),
    "a comparison": lambda path: plan_comparison(str(path), kind="comparison"),
}
BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
HOSTILE: dict[str, tuple[bytes, str]] = {
    "a billion laughs": (BOMB.encode(), r"alias \*a is not supported, write its values out \(line 2"),
    "an alias to itself": (b"data: &a {b: *a}", r"alias \*a is not supported"),
    "5,000 deep": (b"[" * 5_000, r"nested more than 32 deep \(line 1, column 33\)"),
    "900,000 deep": (b"[" * 900_000, r"nested more than 32 deep"),
    "5,000 mappings deep": (b"{a: " * 5_000, r"nested more than 32 deep"),
    "a repeated key": (b"data: {seed: 1, seed: 2}", r"duplicate key 'seed' \(line 1, column 17\)"),
    "Latin-1": (b"description: caf\xe9", r"not UTF-8 text \(byte 0xe9 at 16\)"),
    "UTF-16": ("data: 1".encode("utf-16"), r"not UTF-8 text \(byte 0xff at 0\)"),
    "a NUL": (b"description: a\0b", r"#x0000"),
    "a NUL in words": (b'description: "a\\0b"', r"description: a NUL is not supported"),
    "a call": (b"!!python/object/apply:os.system ['touch pwned']", r"constructor for the tag '.*os.system'"),
    "a name of Python's": (b"data: !!python/name:os.system", r"constructor for the tag"),
    "a number as a key": (b"1: 2", r"key '1' is not text, put it in quotes"),
    "a list as a key": (b"? [a, b]\n: 1", r"key of several values is not text"),
    "a number of 5,000 digits": (b"seed: " + b"9" * 5_000, r"cannot be read: .*4300 digits"),
    "two megabytes": (b"description: " + b"x" * 2_000_000, r"is longer than the 1,000,000 bytes"),
    "two documents": (b"a: 1\n---\nb: 2", r"another document"),
    "an interpolation": (b"data: {body: {path: '${oc.env:HOME}'}}", r"data.body.path: interpolation is not supported"),
    "an escaped interpolation": (b'description: "\\x24{oc.env:HOME}"', r"interpolation is not supported"),
}  # fmt: skip


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_files_are_refused_in_one_short_line(
    case: str, reader: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    content, says = HOSTILE[case]
    Path("r.yaml").write_bytes(content)
    with pytest.raises(RecipeError, match=says) as raised:
        READERS[reader](Path("r.yaml"))
    assert "r.yaml" in str(raised.value) and "\n" not in str(raised.value) and len(str(raised.value)) < 300
    assert [path.name for path in tmp_path.iterdir()] == ["r.yaml"]


@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_file_is_not_read(reader: str, tmp_path: Path) -> None:
    (tmp_path / "zero.yaml").symlink_to("/dev/zero")
    with pytest.raises(RecipeError, match=r"zero.yaml"):
        READERS[reader](tmp_path / "zero.yaml")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[" * 900_000, "nested too deep"),
        ("[" * 500 + "]" * 500, "nested more than 32 deep"),
        ('{"seed": 1, "seed": 2}', "duplicate key 'seed'"),
        ('{"seed": ' + "9" * 5_000 + "}", "4300 digits"),
        ('{"start_from": "${oc.env:HOME}"}', "start_from: interpolation is not supported"),
        (r'{"start_from": "\u0024{oc.env:HOME}"}', "interpolation is not supported"),
        (r'{"start_from": "\ud800"}', "start_from: not UTF-8 text"),
        (r'{"start_from": "a\u0000"}', "start_from: a NUL is not supported"),
        ('{"learning_rate": NaN}', "learning_rate: .*finite number"),
    ],
)
def test_json_is_no_more_trusted_than_yaml(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "r.json").write_text(text, encoding="utf-8")
    with pytest.raises(RecipeError, match=says) as raised:
        recipe_in(tmp_path / "r.json")
    assert "\n" not in str(raised.value) and len(str(raised.value)) < 300


WORDS = {
    "training.start_from=${oc.env:SECRET}": "training.start_from: interpolation is not supported",
    "training.start_from=${training.seed}": "interpolation is not supported",
    "training.steps=*a": r"alias \*a is not supported",
    "training.steps=" + "[" * 5_000: "nested more than 32 deep",
    "training" + ".a" * 5_000 + "=1": "has too many parts",
    "training.seed.of=1": "seed.of' leads through a value that is no section: 0",
    "training.network.encoder_widths.5=1": "there is no entry '5' in a list of 3",
    "training.network.encoder_widths." + "9" * 5_000 + "=1": "there is no entry",
    "training..seed=1": "is not of the form section.key=value",
    "=1": "is not of the form section.key=value",
    "training.start_from=a\0b": "a NUL is not supported",
    "training.start_from=\udce9": "not UTF-8 text",
    "training.steps=" + "9" * 400: "steps has 1,329 bits, the largest whole number has 63",
    "training.steps=0x" + "f" * 50_000: "steps has 200,000 bits",
    "training.network.encoder_widths=[1, 1, " + "9" * 400 + "]": "encoder_widths has 1,329 bits",
    "training.learning_rate=0x" + "f" * 50_000: "given: a number of 200,000 bits",
    "training.learning_rate=.nan": "finite number",
    "training.steps=.inf": "finite number",
    "training.batch=" + "x" * 100_000: "characters",
}


@pytest.mark.parametrize("of", ["a recipe", "a training recipe"])
@pytest.mark.parametrize("word", WORDS, ids=lambda word: word[:30])
def test_hostile_words_are_refused_in_one_short_line(
    word: str, of: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SECRET", "of the person who runs it")
    file = tmp_path / "r.yaml"
    file.write_text("training: {seed: 0, network: {encoder_widths: [1, 1, 1]}}", encoding="utf-8")
    with pytest.raises(RecipeError, match=WORDS[word]) as raised:
        load_recipe(str(file), [word]) if of == "a recipe" else recipe_in(file, [word])
    message = str(raised.value)
    assert "\n" not in message and len(message) < 600 and "of the person" not in message


def test_the_recipe_of_somebody_elses_dataset_resolves_nothing_either(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SECRET", "of the person who runs it")
    stored = DatasetRecipe.model_validate({"body": {"family": "smpl", "path": "${oc.env:SECRET}"}})
    with pytest.raises(RecipeError, match=r"recipe x.zarr: data.body.path: interpolation is not supported"):
        change_recipe({"data": stored.model_dump(mode="json")}, [], where="x.zarr")


def test_a_recipe_of_thousands_of_faults_names_the_first(tmp_path: Path) -> None:
    entries = ", ".join(f"k{number}: 1" for number in range(3_000))
    (tmp_path / "r.yaml").write_text(f"training: {{{entries}}}", encoding="utf-8")
    with pytest.raises(RecipeError, match=r"unknown key 'training.k0'.*; and 2,995 more faults") as raised:
        load_recipe(str(tmp_path / "r.yaml"))
    assert len(str(raised.value)) < 1_000


def test_a_long_key_is_not_repeated_for_each_of_its_values(tmp_path: Path) -> None:
    (tmp_path / "r.json").write_text(json.dumps({"k" * 300_000: [1] * 200_000}), encoding="utf-8")
    assert len(read_values(tmp_path / "r.json")) == 1  # 60 GB if each had its dotted key


def test_yaml_as_a_person_writes_it(tmp_path: Path) -> None:
    text = "\ufeffseed: 1e-3\nday: 2026-01-01\nmore: {list: [1, .5, -1E+5, text, true, null]}"
    (tmp_path / "r.yaml").write_text(text, encoding="utf-8")
    assert read_values(tmp_path / "r.yaml") == {
        "seed": 0.001,
        "day": "2026-01-01",
        "more": {"list": [1, 0.5, -1e5, "text", True, None]},
    }


def test_the_command_says_it_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "r.yaml").write_text("description: ${oc.env:HOME}", encoding="utf-8")
    with pytest.raises(SystemExit) as ended:
        cli.main(["recipe", "--recipe", str(tmp_path / "r.yaml")])
    printed = capsys.readouterr()
    assert ended.value.code == 2 and printed.out == "" and printed.err.count("\n") == 1
    assert printed.err.startswith("error: ") and "description: interpolation is not supported" in printed.err
