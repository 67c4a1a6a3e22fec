"""Text is UTF-8 wherever it lies, and nothing ends with a traceback in a shell whose encoding is ASCII."""

import ast
from collections.abc import Iterator

import pytest

from tests.support.commands import ROOT


def texts_of_no_encoding(source: str) -> Iterator[int]:
    """Lines that read or write text in whatever encoding the shell has."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        method = isinstance(node.func, ast.Attribute)
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        given = {keyword.arg for keyword in node.keywords}
        modes = [argument.value for argument in node.args if isinstance(argument, ast.Constant)]
        opens = (name == "open" and (not method or len(modes) == len(node.args))) or name == "fdopen"
        asks_text = name in ("run", "Popen", "check_output") and "text" in given
        as_text = opens and not any("b" in str(mode) for mode in modes)
        if (name in ("read_text", "write_text") or as_text or asks_text) and "encoding" not in given:
            yield node.lineno


def test_the_search_finds_them() -> None:
    found = 'p.read_text()\nopen(p)\nopen(p, "w")\np.open("a")\nrun(c, text=True)\nos.fdopen(3)'
    assert list(texts_of_no_encoding(found)) == [1, 2, 3, 4, 5, 6]
    fine = 'p.read_text(encoding="utf-8")\nopen(p, "rb")\nrun(c)\np.open("wb")'
    assert not list(texts_of_no_encoding(fine))


@pytest.mark.parametrize("package", ["datagen", "dsffnet", "training", "workflows"])
def test_every_file_of_text_names_its_encoding(package: str) -> None:
    found = {
        f"{path.relative_to(ROOT)}:{line}"
        for path in (ROOT / package).rglob("*.py")
        for line in texts_of_no_encoding(path.read_text(encoding="utf-8"))
    }
    assert not found
