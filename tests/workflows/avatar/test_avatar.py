"""``dsffnet avatar``: recipes that cannot be are refused in one line; scans become an avatar that is animated."""

from copy import deepcopy
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml

from datagen.bodies import load_body
from datagen.bodies.clothed.model import DRAPING
from datagen.common.assets import Asset
from datagen.common.errors import MeshError, RecipeError
from datagen.common.seeding import Stream, generator
from datagen.poses import JOINTS, PARENTS, Poses, draw_poses
from datagen.poses.pose_files import write_pose_file
from datagen.recipe import AnnyBody, ClothedBody, PoseRecipe
from tests.support.commands import command
from tests.support.shapes.outfits import drawn_outfit, person_arrays, stockinged
from workflows.avatar.animate import poses_of
from workflows.avatar.evaluate import Measured, markdown
from workflows.avatar.outfits import can_be_draped_again, draw_points, is_of, outer_scan, require_people, wearers
from workflows.avatar.recipe import ScanRecipe, known_avatars, load_avatar
from workflows.avatar.run import run_avatar
from workflows.pipeline.run_folder import AvatarFolder
from workflows.pipeline.tasks import TaskRunner
from workflows.recipe.loader import load_recipe, save_recipe

TINY: dict[str, Any] = {
    "data": {
        "body": {
            "family": "clothed",
            "body": {"family": "anny", "topology": "notoes_collapse5pc"},
            "outfits": ["skirt"],
            "solver": {"subdivide": 0, "frames": 4, "substeps": 2, "settle": 4},
        },
        "identities": {"training": 0, "evaluation": 1},
        "poses": {"seen": 3, "unseen": 1},
        "triples": {"count": 0},
    },
    "field": {"centres": 150, "spacing": 0.06},
    "scans": {"around": 500, "surface": 2000},
    "template": {
        "network": {"name": "template", "width": 32, "points": 200, "hand_points": 50},
        "batch": 2, "steps": 40, "optimiser": "adam", "schedule": {"name": "constant"}, "device": "cpu",
    },
    "cell": 0.06,
    "avatar": {
        "network": {"name": "avatar", "map_size": 16, "unet_width": 2, "hidden_width": 16, "geometry": 8, "pose": 8,
                    "scan_points": 400},
        "batch": 2, "steps": 8, "optimiser": "adam", "schedule": {"name": "constant"}, "device": "cpu",
    },
    "evaluation": {"frames": 1, "samples": 1000, "examples": 1},
}  # fmt: skip


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.yaml"
    path.write_text(yaml.safe_dump(TINY))
    return path


@pytest.mark.parametrize("name", known_avatars())
def test_the_recipes_that_come_along_can_be(name: str) -> None:
    recipe = load_avatar(name)
    assert recipe.template.network.name == "template" and recipe.avatar.network.name == "avatar"
    assert recipe.data.identities.evaluation > 0 and recipe.description


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("avatar.network.map_size=100", r"map_size must be a power of two, got 100"),
        ("field.spacing=9", r"field.spacing"),
        ("training.steps=-1", r"unknown key 'training'.* \(a recipe has description, data, people, field, "),
        ("fields.spacing=9", r"unknown key 'fields.spacing'|unknown key 'fields'"),
    ],
)
def test_a_recipe_that_cannot_be_is_refused(change: str, said: str, recipe: Path) -> None:
    with pytest.raises(RecipeError, match=said):
        load_avatar(str(recipe), [change])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("cell=0.05", r"was made by another recipe: cell differ. Choose another --out, or add --fresh to start over"),
        ("scans.around=600", r"another recipe: scans differ"),
        ("data.poses.seed=4", r"another recipe: data differ"),
        ("avatar.learning_rate=0.5", r"avatar.learning_rate: 0.001 there, 0.5 here"),
        ("template.network.width=16", r"template.network: "),
    ],
)
def test_another_recipe_in_its_folder_is_refused_before_anything_is_touched(
    change: str, said: str, recipe: Path, tmp_path: Path
) -> None:
    folder = AvatarFolder(tmp_path / "run")
    folder.path.mkdir()
    save_recipe(load_avatar(str(recipe)), folder.recipe)
    before = folder.recipe.read_bytes()
    with pytest.raises(RecipeError, match=said):
        run_avatar(load_avatar(str(recipe), [change]), folder.path, TaskRunner(local=True))
    assert [its.name for its in folder.path.iterdir()] == ["recipe.yaml"] and folder.recipe.read_bytes() == before


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("avatar.compile=true", r"network 'avatar' knows no compile: take it away"),
        ("template.augmentation.turn=5", r"network 'template' knows no augmentation: take it away"),
        ("avatar.precision=bfloat16", r"knows no precision"),
        (
            "avatar.network.features_rate=2 avatar.optimiser=muon",
            r"'muon' knows no network.features_rate: take it away",
        ),
    ],
)
def test_keys_without_effect_are_refused(change: str, said: str, recipe: Path) -> None:
    with pytest.raises(RecipeError, match=said):
        load_avatar(str(recipe), change.split())


def test_batch_norm_is_of_one_rank(recipe: Path) -> None:
    with pytest.raises(RecipeError, match=r"normalisation 'batch' would be each rank's own, but ranks is 2"):
        load_avatar(str(recipe), ["avatar.network.normalisation=batch", "avatar.ranks=2"])


def test_hidden_triangles_of_a_scan_do_not_count() -> None:
    inner, outer = (trimesh.creation.icosphere(subdivisions=2, radius=radius) for radius in (0.5, 0.4))
    body = replace(stockinged().body, vertices=inner.vertices, faces=inner.faces, weights=np.ones((162, 1)))
    scans = np.concatenate([inner.vertices, outer.vertices])[None].astype(np.float32)
    subject = replace(
        stockinged(),
        body=body,
        scans=scans,
        faces=np.concatenate([inner.faces, outer.faces + 162]),
        parts=np.repeat([0, 1], 162),
        transforms=np.eye(3, 4, dtype=np.float32)[None, None],
    )
    found = outer_scan(subject, 0)
    assert len(found.faces) == 320 and found.faces.max() < 162, "the garment within the body is hidden"


def test_the_points_of_a_frame_are_its_own_in_whatever_order_tasks_end(tmp_path: Path) -> None:
    outfit = drawn_outfit(tmp_path, with_template=False)
    files, kept = (outfit.samples.path, outfit.surfaces.path), list[list[bytes]]()
    for turned in (iter, reversed):
        tasks: Any = SimpleNamespace(
            frames=lambda task, arguments, what, turned=turned: turned([task(*each) for each in arguments])
        )
        draw_points(ScanRecipe(around=64, surface=100), outfit, outfit.subject.load(), tasks)
        kept.append([file.read_bytes() for file in files])
    assert kept[0] == kept[1]


def test_people_are_called_by_their_outfits_and_numbered_where_two_wear_one() -> None:
    dataset: Any = SimpleNamespace(
        recipe=SimpleNamespace(body=ClothedBody(outfits=("skirt", "coat"))),
        identities=lambda split: [4, 5, 6, 8] if split == "evaluation" else [0],
        parameters=lambda identity: np.array([0.5, identity % 2, 1.0]),
    )
    assert wearers(dataset) == {"skirt": 4, "coat": 5, "skirt-2": 6, "skirt-3": 8}


def test_clothes_are_draped_again_only_as_they_were(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Else what another version of the simulation, or another garment, does would count as its error."""
    body, coat = ClothedBody(outfits=("skirt", "coat")), Asset("coat.obj", "CC0-1.0", "a hash")
    here = SimpleNamespace(assets=(DRAPING, coat))
    monkeypatch.setattr("workflows.avatar.outfits.load_body", lambda _: here)
    made: dict[str, Any] = {"assets": [asdict(DRAPING), asdict(coat), asdict(Asset("poses", "MIT", "1"))]}
    dataset: Any = SimpleNamespace(recipe=SimpleNamespace(body=body), attributes={"body": made}, url="people.zarr")
    assert can_be_draped_again(dataset) and not caplog.messages
    for other in (replace(DRAPING, version="3"), coat), (DRAPING, replace(coat, version="another")):
        here.assets = other
        assert not can_be_draped_again(dataset)
        assert "people.zarr is draped otherwise now" in caplog.messages.pop()
        caplog.clear()
    here.assets, dataset.recipe.body = (DRAPING, coat), ClothedBody(method="skinned")
    assert not can_be_draped_again(dataset) and not caplog.messages


def test_scans_of_another_dataset_are_made_again(tmp_path: Path) -> None:
    outfit = drawn_outfit(tmp_path)
    assert is_of(outfit, "a leg") and not is_of(outfit, "another dataset")
    outfit.subject.path.write_bytes(b"")
    assert not is_of(outfit, "a leg")


def test_an_avatar_is_no_network_of_transfers() -> None:
    with pytest.raises(RecipeError, match=r"training.network: 'avatar' learns from scans of a person: dsffnet avatar"):
        load_recipe("smoke", ["training.network.name=avatar", "training.network.map_size=32"])


def test_somebody_must_become_an_avatar(recipe: Path) -> None:
    with pytest.raises(RecipeError, match=r"data.identities.evaluation is 0, but these are the people"):
        load_avatar(str(recipe), ["data.identities.evaluation=0", "data.identities.training=2"])


def test_sections_learn_what_they_are_called(recipe: Path) -> None:
    recipe.write_text(yaml.safe_dump(TINY | {"avatar": deepcopy(TINY["template"])}))
    with pytest.raises(RecipeError, match=r"avatar.network: need 'avatar', not 'template'"):
        load_avatar(str(recipe))


def test_people_without_clothes_are_no_avatars(recipe: Path) -> None:
    recipe.write_text(yaml.safe_dump(TINY | {"data": {**TINY["data"], "body": {"family": "leg"}}}))
    with pytest.raises(RecipeError, match=r"learned of dressed people, not of 'leg'; use clothed"):
        load_avatar(str(recipe))


def test_poses_of_a_file_are_taken_as_they_are(tmp_path: Path) -> None:
    rotations = np.random.default_rng(0).normal(0, 0.2, (5, len(JOINTS), 3))
    write_pose_file(tmp_path / "poses.npz", Poses(JOINTS, PARENTS, rotations))
    folder = AvatarFolder(tmp_path)
    folder.recipe.touch()
    found = poses_of(folder, tmp_path / "poses.npz", count=9, seed=0)
    assert np.allclose(found.rotations, rotations)
    folder.recipe.unlink()
    with pytest.raises(RecipeError, match=r"is no folder of an avatar. Make one: dsffnet avatar train"):
        poses_of(AvatarFolder(tmp_path), None, count=9, seed=0)


def test_the_table_has_a_row_for_each_method_and_part() -> None:
    values = {"scan_to_model": 1.26, "model_to_scan": 2, "plane": 3, "normal_angle": 4, "hausdorff": 5}
    rows = [
        Measured("skirt", "seen", method, values | {"chamfer": 2.5e-5, "cosine": 0.9}, {0: values, 2: values})
        for method in ("template + skinning", "avatar")
    ]
    text = markdown(rows)
    assert "| seen | template + skinning | 1.3 | 2.0 | 3.0 | 4.0 | 5.0 | 2.5 | 0.900 |" in text
    assert text.count("| seen | skin |") == 1 and "| seen | garment 2 |" in text, "parts of the avatar alone"


def test_from_scans_to_an_animation(recipe: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = ["avatar", "train", "--recipe", str(recipe), "--out", str(out), "--local"]
    done = command(*words)
    assert done.returncode == 0, done.stderr
    assert (
        "| unseen | avatar |" in done.stdout
        and "| unseen | simulation, finer steps |" in done.stdout
        and (out / "evaluation" / "figures" / "examples.png").stat().st_size > 1e4
    )
    again = command(*words)
    assert all(
        f"{stage}: skipped" in again.stdout for stage in ("generate", "outfits", "templates", "avatar", "evaluate")
    )
    (out / "outfits" / "skirt" / "template.safetensors").unlink()
    mended = command(*words)
    assert mended.returncode == 0 and "templates: finished" in mended.stdout and "avatar: skipped" in mended.stdout
    walk = command("avatar", "animate", str(out), "-o", str(tmp_path / "walk.glb"), "--stations", "2")
    assert walk.returncode == 0, walk.stderr
    assert len(trimesh.load(tmp_path / "walk.glb").geometry) == 1
    person = _person(tmp_path / "person.obj")
    like = command("avatar", "animate", str(out), "-o", str(tmp_path / "like.glb"), "--source", str(person))
    assert like.returncode == 0 and (tmp_path / "like.glb").stat().st_size > 1000, like.stderr
    nobody = command(
        "avatar", "animate", str(out), "-o", str(tmp_path / "no.glb"), "--source", str(tmp_path / "no.obj")
    )
    assert nobody.returncode != 0 and "no mesh file or folder at" in nobody.stderr
    wrong = command("avatar", "animate", str(out), "--outfit", "coat", "-o", str(tmp_path / "walk.glb"))
    assert wrong.returncode != 0 and "has the outfits skirt: there is no outfit 'coat' in it" in wrong.stderr


def test_from_scans_of_ones_own_to_an_animation(recipe: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / "ann.npz", **person_arrays())
    out = tmp_path / "run"
    words = ["avatar", "train", "--recipe", str(recipe), "--people", str(tmp_path / "ann.npz"), "--out", str(out)]
    words += ["--local", "--set", "field.centres=80", "field.spacing=0.08"]
    done = command(*words)
    assert done.returncode == 0, done.stderr
    assert "## ann" in done.stdout and "| unseen | avatar |" in done.stdout
    assert "simulation" not in done.stdout and "generate" not in done.stdout, "nothing was made"
    again = command(*words)
    assert all(f"{stage}: skipped" in again.stdout for stage in ("outfits", "templates", "avatar", "evaluate"))
    walk = command("avatar", "animate", str(out), "-o", str(tmp_path / "walk.glb"), "--stations", "2")
    assert walk.returncode == 0 and (tmp_path / "walk.glb").stat().st_size > 1000, walk.stderr
    other = command(*words[:-4], "--set", "field.centres=80", "field.spacing=0.08", "cell=0.05")
    assert other.returncode != 0 and "was made by another recipe: cell differ" in other.stderr
    missing = command(*words[:5], str(tmp_path / "nobody.npz"), "--out", str(out), "--local", "--fresh")
    assert missing.returncode != 0 and "no file of scans at" in missing.stderr, missing.stderr
    assert (out / "evaluation" / "tables.md").exists(), "nothing is removed for what cannot be begun"
    strangers = {"poses": np.zeros((2, 1, 3)), "joints": np.array(["tail"]), "parents": np.array([-1])}
    np.savez(tmp_path / "strangers.npz", **strangers)
    still = command("avatar", "animate", str(out), "-o", str(tmp_path / "x.glb"), "--poses",
                    str(tmp_path / "strangers.npz"))  # fmt: skip
    assert still.returncode != 0 and "the poses turn tail, ..., none of which ann has" in still.stderr
    np.savez(tmp_path / "ann.npz", **{**person_arrays(), "parts": np.ones(384, int)})
    changed = command(*words)
    assert changed.returncode != 0 and "ann.npz is not the file that" in changed.stderr
    (tmp_path / "ann.npz").unlink()
    gone = command(*words)
    assert gone.returncode == 0 and "outfits: skipped" in gone.stdout, "what was made of it is there"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"data": None}, r"need one of the two, scans that are made or files of one's own"),
        ({"people": ["ann.npz"]}, r"need one of the two"),
        ({"data": None, "people": ["a/ann.npz", "b/ann.npz"]}, r"two files are called 'ann'"),
        ({"data": None, "people": ["...npz"]}, r"'\.\.' becomes the name of an outfit and of folders"),
    ],
)
def test_scans_are_made_or_ones_own(change: dict[str, Any], said: str, recipe: Path) -> None:
    recipe.write_text(yaml.safe_dump(TINY | change))
    with pytest.raises(RecipeError, match=said):
        load_avatar(str(recipe))


def test_keys_of_data_are_refused_beside_people(recipe: Path) -> None:
    with pytest.raises(RecipeError, match=r"--set data.poses.seed=4 has no effect beside --people"):
        load_avatar(str(recipe), ["data.poses.seed=4"], people=["ann.npz"])


def test_people_learned_together_have_the_same_joints(recipe: Path, tmp_path: Path) -> None:
    arrays = person_arrays()
    np.savez(tmp_path / "ann.npz", **arrays)
    np.savez(tmp_path / "ben.npz", **{**arrays, "joints": np.array([f"bone {n}" for n in range(len(JOINTS))]),
                                      "parents": np.array(PARENTS)})  # fmt: skip
    given = load_avatar(str(recipe), people=[tmp_path / "ann.npz", tmp_path / "ben.npz"])
    with pytest.raises(RecipeError, match=r"ben.npz has other joints than .*ann.npz"):
        require_people(given, AvatarFolder(tmp_path / "run"), fresh=False)
    with pytest.raises(RecipeError, match=r"ann.npz has 3 scans to learn from, fewer than template.batch, 4"):
        require_people(load_avatar(str(recipe), ["template.batch=4"], people=[tmp_path / "ann.npz"]),
                       AvatarFolder(tmp_path / "run"), fresh=False)  # fmt: skip


def _person(path: Path) -> Path:
    """A file of a bare person in a random pose."""
    body = load_body(AnnyBody(topology="notoes_collapse5pc"))
    who = body.draw_identity(generator(7, Stream.IDENTITY, 0), 0)
    trimesh.Trimesh(body.vertices(who, draw_poses(PoseRecipe(), [1]))[0], body.faces(who), process=False).export(path)
    return path


def test_poses_are_of_a_file_or_of_people(tmp_path: Path) -> None:
    folder = AvatarFolder(tmp_path)
    folder.recipe.touch()
    with pytest.raises(RecipeError, match=r"--poses and --source both say what to play: name one"):
        poses_of(folder, tmp_path / "poses.npz", tmp_path / "person.obj", count=9, seed=0)


def test_an_animation_is_a_glb(tmp_path: Path) -> None:
    from workflows.avatar.animate import animate

    poses = Poses(JOINTS, PARENTS, np.zeros((2, len(JOINTS), 3)))
    with pytest.raises(MeshError, match=r"an animation is a .glb file, not '.obj'"):
        animate(AvatarFolder(tmp_path), None, poses, tmp_path / "walk.obj", frames_per_second=24, picture=None)
