"""The page holds the meshes to the stated precision, loads nothing, and shows hostile names as plain text."""

import base64
import json
import re
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.common.arrays import Floats
from tests.support.reports.pages import Elements
from training.viz.look import Look, Paint
from training.viz.transfer_example import Comparison, Motion, NamedMesh, placed
from training.viz.viewer import MOTION_LIMIT, frames_apart, viewer_payload, write_viewer


def decode_positions(mesh: dict[str, Any]) -> Floats:
    """Return the positions [v, 3] of an embedded mesh, as the page sees them."""
    levels = np.frombuffer(base64.b64decode(mesh["positions"]), "<u2").reshape(-1, 3)
    return np.asarray(np.array(mesh["low"]) + levels * np.array(mesh["step"]))


def examples(count: int = 2, name: str = "body", methods: tuple[str, ...] = ("DSFFNet",)) -> list[Comparison]:
    """Transfers whose n-th output by the m-th method is off by n * m centimetres."""
    random = np.random.default_rng(0)
    faces = random.integers(0, 50, (80, 3))
    up = np.array([0.0, 1, 0])
    made = []
    for index in range(1, count + 1):
        truth = random.normal(size=(50, 3)) + 5
        source, target, right = (NamedMesh(one, faces, name) for one in (*random.normal(size=(2, 50, 3)), truth))
        outputs = {
            m: NamedMesh(truth + 0.01 * index * place * up, faces, "") for place, m in enumerate(methods, start=1)
        }
        made.append(Comparison(f"{name} {index}", source, target, outputs, right, dict.fromkeys(methods, name)))
    return made


def script() -> str:
    """The sources that the bundle is built from, three.js left out."""
    names = ("viewer.js", "viewer.data.js", "viewer.meshes.js", "viewer.tiles.js")
    return "\n".join((files("training.viz") / "assets" / name).read_text(encoding="utf-8") for name in names)


def parsed(path: Path) -> Elements:
    return Elements(path.read_text(encoding="utf-8"))


def page_data(path: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads(parsed(path).texts["data"])
    return data


def embedded(example: dict[str, Any]) -> dict[str, Any]:
    """The meshes of an example by the names that `placed` gives them."""
    outputs = {f"output {name}": mesh for name, mesh in example["outputs"].items()}
    return {role: example[role] for role in ("source", "target", "truth")} | outputs


def test_positions_decode_to_within_half_a_step(tmp_path: Path) -> None:
    originals = examples(methods=("DSFFNet", "NPT"))
    data = page_data(write_viewer(originals, tmp_path / "viewer.html", title="t"))
    for original, example in zip(originals, data["examples"], strict=True):
        assert set(embedded(example)) == set(placed(original))
        for name, mesh in placed(original).items():
            half_step = np.ptp(mesh.vertices, axis=0) / 65535 / 2
            off = np.abs(decode_positions(embedded(example)[name]) - mesh.vertices)
            assert (off <= half_step * (1 + 1e-6) + 1e-12).all()


def test_triangles_are_exact_and_kept_once(tmp_path: Path) -> None:
    originals = examples()
    data = page_data(write_viewer(originals, tmp_path / "viewer.html", title="t"))
    assert len(data["faces"]) == 1
    kept = data["faces"][data["examples"][1]["truth"]["faces"]]
    assert kept["kind"] == "uint16"
    indices = np.frombuffer(base64.b64decode(kept["indices"]), "<u2").reshape(-1, 3)
    assert (indices == originals[0].source.faces).all()


def test_many_vertices_take_wider_indices() -> None:
    vertices = np.random.default_rng(0).normal(size=(65536, 3))
    mesh = NamedMesh(vertices, np.array([[0, 1, 65535]]), "")
    payload = viewer_payload([Comparison("big", mesh, mesh, {"m": mesh}, mesh)])
    (kept,) = payload["faces"].values()
    indices = np.frombuffer(base64.b64decode(kept["indices"]), "<u4")
    assert kept["kind"] == "uint32" and indices.tolist() == [0, 1, 65535]


def test_errors_are_in_the_unit_of_the_bar_and_share_its_limit(tmp_path: Path) -> None:
    data = page_data(write_viewer(examples(), tmp_path / "viewer.html", title="t"))
    errors = [example["errors"]["DSFFNet"] for example in data["examples"]]
    values = [np.frombuffer(base64.b64decode(one["levels"]), "<u2") * one["step"] for one in errors]
    assert values[0] == pytest.approx(1.0, rel=1e-4) and values[1] == pytest.approx(2.0, rel=1e-4)
    assert data["error"]["unit"] == "cm" and data["error"]["limit"] == pytest.approx(2.0)
    assert errors[1]["text"] == "mean 2, max 2 cm" and errors[1]["mean"] == pytest.approx(2.0)


def test_several_methods_are_all_there_and_the_best_is_named(tmp_path: Path) -> None:
    data = page_data(write_viewer(examples(methods=("b", "a", "NPT")), tmp_path / "viewer.html", title="t"))
    assert [method["name"] for method in data["methods"]] == ["b", "a", "NPT"]
    assert len({method["color"] for method in data["methods"]}) == 3
    for example in data["examples"]:
        assert list(example["outputs"]) == list(example["errors"]) == ["b", "a", "NPT"] and example["best"] == "b"


def test_without_a_truth_there_are_meshes_and_no_errors(tmp_path: Path) -> None:
    transfer = replace(examples(1)[0], truth=None, metrics={})
    (example,) = page_data(write_viewer([transfer], tmp_path / "viewer.html", title="t"))["examples"]
    assert example["truth"] is None and example["errors"] == {} and example["best"] is None
    assert set(example["outputs"]) == {"DSFFNet"} and example["metrics"] == {"DSFFNet": ""}


def test_each_example_is_first_seen_whole(tmp_path: Path) -> None:
    small, large = examples(2)
    larger = [NamedMesh(1000 * np.asarray(mesh.vertices), mesh.faces, "") for mesh in (large.source, large.target)]
    lone = replace(large, source=larger[0], target=larger[1], outputs={}, truth=None)
    views = [one["view"] for one in viewer_payload([small, lone])["examples"]]
    assert views[1]["height"] > 100 * views[0]["height"]
    assert all(np.linalg.norm(view["direction"]) == pytest.approx(1) for view in views)


def test_the_page_loads_nothing(tmp_path: Path) -> None:
    elements = parsed(write_viewer(examples(), tmp_path / "viewer.html", title="t")).elements
    for _, attributes in elements:
        assert not {"src", "href", "srcset", "action", "poster"} & set(attributes)
    policy = next(a["content"] for _, a in elements if a.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None and policy.startswith("default-src 'none'") and "http" not in policy
    assert not re.search(r"url\(|@import", (files("training.viz") / "assets" / "viewer.css").read_text())


def test_the_bundle_can_stand_in_a_page_and_carries_its_licence(tmp_path: Path) -> None:
    assets = files("training.viz") / "assets"
    bundle = (assets / "viewer.bundle.js").read_text(encoding="utf-8")
    assert len(bundle) < 800_000 and not re.search(r"</script|<!--", bundle, re.IGNORECASE)
    licence = (assets / "THREE-LICENSE.txt").read_text(encoding="utf-8")
    assert "MIT License" in licence and "three.js authors" in licence
    assert licence in write_viewer(examples(), tmp_path / "viewer.html", title="t").read_text(encoding="utf-8")
    assert "innerHTML" not in script()


def test_pinned_versions_agree() -> None:
    assets = files("training.viz") / "assets"
    pinned = json.loads((assets / "package.json").read_text(encoding="utf-8"))["devDependencies"]
    heading = (assets / "viewer.js").read_text(encoding="utf-8").splitlines()[0]
    assert f"three {pinned['three']}" in heading and f"esbuild {pinned['esbuild']}" in heading
    assert f'"{pinned["three"].split(".")[1]}"' in (assets / "viewer.bundle.js").read_text(encoding="utf-8")


def test_the_bundle_is_built_from_the_script() -> None:
    assets = files("training.viz") / "assets"
    bundle = (assets / "viewer.bundle.js").read_text(encoding="utf-8")
    words = set(re.findall(r'(?<!from )"([\w ]{4,}|[.#][\w-]+)"', script()))
    assert len(words) > 30 and {word for word in words if f'"{word}"' not in bundle} == set()


def test_page_and_script_agree_on_names() -> None:
    assets = files("training.viz") / "assets"
    page = (assets / "viewer.html").read_text(encoding="utf-8")
    wanted = set(re.findall(r'find\("(\w+)"\)', script()))
    assert wanted and wanted <= set(re.findall(r'id="(\w+)"', page))


def test_nothing_to_show_is_refused_and_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one"):
        write_viewer([], tmp_path / "viewer.html", title="t")
    broken = examples(1)
    broken[0].outputs["DSFFNet"].vertices[0] = np.inf
    with pytest.raises(ValueError, match="1 of 50 vertices of the output DSFFNet are not finite"):
        write_viewer(broken, tmp_path / "viewer.html", title="t")
    assert not list(tmp_path.iterdir())


def painted(mesh: NamedMesh) -> NamedMesh:
    """The mesh with a texture on half of its faces, and a seam."""
    texture = np.zeros((4, 8, 3), np.uint8)
    uvs = np.zeros((len(mesh.faces), 3, 2))
    uvs[::2] += 0.5
    paints = (Paint((1.0, 1.0, 1.0), texture), Paint((0.0, 0.5, 0.0)))
    return replace(mesh, look=Look(paints, np.arange(len(mesh.faces)) % 2, uvs, np.full((len(mesh.vertices), 3), 0.5)))


def test_what_faces_look_like_is_kept_once_with_all_of_its_faces() -> None:
    (example,) = examples(1)
    target = painted(NamedMesh(example.target.vertices, example.target.faces, "t"))
    output = replace(target, vertices=np.asarray(target.vertices) + 1)
    payload = viewer_payload([replace(example, target=target, outputs={"m": output}, truth=None)])
    (shown,) = payload["examples"]
    assert shown["source"]["look"] is None and shown["target"]["look"] == shown["outputs"]["m"]["look"]
    look = payload["looks"][shown["target"]["look"]]
    of, faces = (np.frombuffer(base64.b64decode(look[name]), "<u4") for name in ("of", "faces"))
    first = look["paints"][0]["faces"]
    assert [paint["faces"] for paint in look["paints"]] == [40, 40]
    order = np.argsort(np.arange(80) % 2, kind="stable")
    assert np.array_equal(of[faces.reshape(-1, 3)], np.asarray(target.faces)[order])
    uvs = np.frombuffer(base64.b64decode(look["uvs"]), "<f4").reshape(-1, 2)[faces.reshape(-1, 3)]
    assert (uvs[:first] == 0.5).all() and (uvs[first:] == 0).all()
    assert look["paints"][0]["texture"].startswith("data:image/jpeg;base64,") and look["paints"][1]["texture"] is None
    assert set(base64.b64decode(look["colors"])) == {128}


def test_a_sequence_is_whole_and_stays_where_it_begins() -> None:
    (example,) = examples(1)
    source, posed = example.source, example.outputs["DSFFNet"]
    frames = [
        (
            NamedMesh(np.asarray(source.vertices) + step, source.faces, f"w{step}"),
            NamedMesh(np.asarray(posed.vertices) * 2 + step, posed.faces, f"o{step}"),
        )
        for step in range(5)
    ]
    first = replace(example, source=frames[0][0], outputs={"m": frames[0][1]}, truth=None, motion=Motion(frames, 12.5))
    (shown,) = viewer_payload([first])["examples"]
    motion = shown["motion"]
    assert motion["rate"] == 12.5 and [frame["name"] for frame in motion["output"]] == ["o0", "o1", "o2", "o3", "o4"]
    stands = placed(first)
    scale = np.ptp(stands["source"].vertices, axis=0).max() / np.ptp(source.vertices, axis=0).max()
    for step, (one, other) in enumerate(zip(motion["source"], motion["output"], strict=True)):
        assert np.allclose(decode_positions(one), stands["source"].vertices + scale * step, atol=1e-3)
        assert np.allclose(decode_positions(other), stands["output m"].vertices + step, atol=1e-3)
    still = viewer_payload([replace(first, motion=None)])["examples"][0]
    assert still["motion"] is None and still["view"]["height"] < shown["view"]["height"], "all frames are in view"


def test_a_long_sequence_is_thinned_to_a_page_of_bounded_size() -> None:
    assert frames_apart(100, 2 * 6890) == 1 and frames_apart(1000, 2 * 6890) == 3
    for count, vertices in ((10_000, 738), (2_000, 2 * 6890), (3, 10**7)):
        kept = len(range(0, count, frames_apart(count, vertices)))
        assert kept == 1 or kept * 8 * vertices <= MOTION_LIMIT
