"""Dressed people: pictures of every outfit, and how good draped garments are.

python -m benchmarks.clothed.draping picture docs/images/bodies-clothed.png
python -m benchmarks.clothed.draping sheet docs/images/clothed-people.png --identities 6 --poses 1 --subdivide 0
python -m benchmarks.clothed.draping people FOLDER --identities 50 --poses 20 --subdivide 0   # again: resumes
python -m benchmarks.clothed.draping walk docs/images/clothed-walk.gif
python -m benchmarks.clothed.draping measure [--outfits coat] [--identities 3] [--poses 4] [--subdivide 0]
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from datagen.bodies.clothed.draping import depths
from datagen.bodies.clothed.model import DRAPING, ClothedModel, body_faces
from datagen.bodies.skinning import skin
from datagen.common.files import write_atomically
from datagen.common.seeding import Stream, generator
from datagen.mesh.geometry import Mesh, edges_of
from datagen.mesh.parts import part_colors
from datagen.poses import JOINTS, PARENTS, Poses, draw_poses
from datagen.recipe import OUTFITS, AnnyBody, ClothedBody, DrapeSolver, PhenotypeRanges, PoseRecipe
from training.viz.mesh_grid import Panel, Row, mesh_grid, standing
from training.viz.render.camera import frame
from training.viz.render.renderer import render_mesh

_PEOPLE = {"adult": (0.8, 0.7, 0.5, 0.5, 0.5, 0.3), "child": (0.5, 0.3, 0.5, 0.5, 0.5, 0.5),
           "elder": (0.2, 1.0, 0.3, 0.8, 0.4, 0.6)}  # fmt: skip
_SHOWN: dict[str, dict[str, tuple[float, float, float]]] = {
    "T-pose": {},
    "arms up": {"left_shoulder": (0, 0, 60), "right_shoulder": (0, 0, -60)},
    "stride": {
        "left_hip": (-50, 0, 0), "left_knee": (20, 0, 0), "right_hip": (25, 0, 0), "right_knee": (30, 0, 0),
        "left_shoulder": (0, 0, -60), "right_shoulder": (0, 0, 60),
    },
    "sitting": {
        "left_hip": (-90, 0, 8), "right_hip": (-90, 0, -8), "left_knee": (85, 0, 0), "right_knee": (85, 0, 0),
        "left_shoulder": (0, 0, -55), "right_shoulder": (0, 0, 55), "left_elbow": (0, -60, 0),
        "right_elbow": (0, 60, 0),
    },
}  # fmt: skip


def picture(path: Path) -> None:
    """Every outfit in four poses on three bodies."""
    body = AnnyBody(topology="anny", phenotypes=PhenotypeRanges(age=(0, 1)))
    model, poses = ClothedModel(ClothedBody(body=body, detail=1)), _shown_poses()
    rows = []
    for number, outfit in enumerate(OUTFITS):
        for name, phenotypes in _PEOPLE.items():
            parameters = np.array([*phenotypes, number, 1.0])
            faces, colors = model.faces(parameters), part_colors(model.part_labels(parameters)) / 255
            posed = model.vertices(parameters, poses)
            rows.append(Row(f"{outfit}\n{name}", [Panel(Mesh(standing(one), faces), colors) for one in posed]))
            print(outfit, name, flush=True)
    title = "Every outfit in four poses, draped, on an adult, a child and an old person"
    mesh_grid(rows, path, columns=list(_SHOWN), title=title, one_scale=False, size=(230, 250))


def sheet(path: Path, people: int, poses: int, subdivide: int) -> None:
    """Random people of all ages, each in every outfit, in NPT's first poses."""
    body = AnnyBody(topology="anny", phenotypes=PhenotypeRanges(age=(0, 1)))
    model = ClothedModel(ClothedBody(body=body, detail=subdivide, solver=DrapeSolver(subdivide=subdivide)))
    drawn, rows = draw_poses(PoseRecipe(), range(poses)), []
    for identity in range(people):
        person, panels = model.draw_identity(generator(1, Stream.IDENTITY, identity), identity), []
        for number in range(len(OUTFITS)):
            parameters = np.array([*person[:-2], number, person[-1]])
            faces, colors = model.faces(parameters), part_colors(model.part_labels(parameters)) / 255
            posed = model.vertices(parameters, drawn)
            assert np.isfinite(posed).all()
            panels += [Panel(Mesh(standing(one), faces), colors) for one in posed]
        age = person[model.parameter_names.index("age")]
        rows.append(Row(f"person {identity}\nage {age:.2f}", panels))
        print(identity, flush=True)
    columns = [f"{outfit}, {pose}" for outfit in OUTFITS for pose in range(poses)]
    title = f"{people} random people of all ages in every outfit, in NPT's first poses, draped"
    mesh_grid(rows, path, columns=columns, title=title, one_scale=False, size=(150, 150))


def people(folder: Path, count: int, poses: int, subdivide: int) -> None:
    """Random people of all ages, each in every outfit and pose: a picture and figures a person, which are kept."""
    folder = folder / f"version {DRAPING.version}, {poses} poses, {subdivide} times subdivided"
    folder.mkdir(parents=True, exist_ok=True)
    body = AnnyBody(topology="notoes_collapse5pc", phenotypes=PhenotypeRanges(age=(0, 1)))
    model = ClothedModel(ClothedBody(body=body, detail=subdivide, solver=DrapeSolver(subdivide=subdivide)))
    drawn, begun = draw_poses(PoseRecipe(), range(poses)), time.time()
    paths = [folder / f"person-{identity:03d}" for identity in range(count)]
    missing = [identity for identity, path in enumerate(paths) if not path.with_suffix(".json").exists()]
    for made, identity in enumerate(missing, 1):
        _person(model, identity, drawn, paths[identity])
        left = (len(missing) - made) * (time.time() - begun) / made
        print(f"person {identity}: {made} of {len(missing)}, {left / 60:.0f} minutes left", flush=True)
    found = [json.loads(path.with_suffix(".json").read_text()) for path in paths]
    deep, stretch = (np.array([its[key] for its in found]) for key in ("deep", "stretch"))
    print(f"{len(found)} people, {deep.size} poses, {sum(its['seconds'] for its in found):.0f} CPU s, all finite")
    for outfit, inside, longer in zip(OUTFITS, deep.transpose(1, 0, 2), stretch.transpose(1, 0, 2), strict=True):
        print(f"{outfit} | {np.median(inside):.2%}, {inside.max():.2%} | {np.median(longer):.2f}, {longer.max():.2f}")


def _person(model: ClothedModel, identity: int, poses: Poses, path: Path) -> None:
    """Write a person's picture and, for each outfit and pose, the share deeper than 2 mm and p99 of the stretch."""
    begun, rows = time.process_time(), []
    deep, stretch = np.zeros((2, len(OUTFITS), len(poses)))
    drawn = model.draw_identity(generator(1, Stream.IDENTITY, identity), identity)
    for number, outfit in enumerate(OUTFITS):
        parameters = np.array([*drawn[:-2], number, drawn[-1]])
        person, posed = model.person(tuple(parameters.tolist())), model.vertices(parameters, poses)
        assert np.isfinite(posed).all(), (identity, outfit)
        first, edges, bodies = len(person.skin.vertices), edges_of(person.garment.faces), model.world_rotations(poses)
        for pose, body in enumerate(skin(person.body, bodies)):
            deep[number, pose] = np.mean(depths(posed[pose, first:], body, body_faces()) > 0.002)
            longer = _lengths(posed[pose, first:], edges) / person.garment.lengths(edges)
            stretch[number, pose] = np.percentile(longer, 99)
        faces, colors = model.faces(parameters), part_colors(model.part_labels(parameters)) / 255
        rows.append(Row(outfit, [Panel(Mesh(standing(one), faces), colors) for one in posed]))
    title = f"person {identity}, age {drawn[model.parameter_names.index('age')]:.2f}"
    columns = [str(pose) for pose in range(len(poses))]
    mesh_grid(rows, path.with_suffix(".png"), columns=columns, title=title, one_scale=False, size=(96, 110))
    found = {"seconds": time.process_time() - begun, "deep": deep.tolist(), "stretch": stretch.tolist()}
    write_atomically(path.with_suffix(".json"), json.dumps(found).encode())


def walk(path: Path, frames: int = 20) -> None:
    """Two people who walk on the spot, as a GIF that loops; each frame is draped alone."""
    body, size = AnnyBody(topology="anny"), (260, 400)
    model, strips = ClothedModel(ClothedBody(body=body, detail=1)), []
    angle = np.radians(50)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    for outfit, phenotypes in (("skirt", (0.1, 0.66, 0.5, 0.4, 0.5, 0.4)), ("coat", _PEOPLE["adult"])):
        parameters = np.array([*phenotypes, list(OUTFITS).index(outfit), 1.0])
        faces, colors = model.faces(parameters), part_colors(model.part_labels(parameters)) / 255
        posed = [one @ turn.T - [0, one[:, 1].min(), 0] for one in model.vertices(parameters, _steps(frames))]
        camera = frame([Mesh(one, faces) for one in posed], size=size)
        look: dict[str, Any] = {"colors": colors, "camera": camera, "size": size, "background": (1.0, 1.0, 1.0)}
        strips.append([render_mesh(one, faces, **look) for one in posed])
    pictures = [Image.fromarray(np.concatenate(pair, axis=1)).quantize(96) for pair in zip(*strips, strict=True)]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=60, loop=0, optimize=True)


def _steps(frames: int) -> Poses:
    """A stride of the left and one of the right leg; what is on the right is half a turn behind."""
    time = np.arange(frames) * 2 * np.pi / frames
    degrees = np.zeros((frames, len(JOINTS), 3))
    for side, sign, phase in (("left", 1, time), ("right", -1, time + np.pi)):
        swing = np.sin(phase)
        degrees[:, JOINTS.index(f"{side}_hip"), 0] = -8 - 26 * swing
        degrees[:, JOINTS.index(f"{side}_knee"), 0] = 12 + 38 * np.clip(np.cos(phase - 0.4), 0, 1)
        degrees[:, JOINTS.index(f"{side}_shoulder"), 2] = -58 * sign
        degrees[:, JOINTS.index(f"{side}_elbow"), 1] = -sign * (25 - 15 * swing)
        degrees[:, JOINTS.index(f"{side}_shoulder"), 1] = 18 * sign * swing
    return Poses(JOINTS, PARENTS, np.radians(degrees))


def _shown_poses() -> Poses:
    degrees = np.zeros((len(_SHOWN), len(JOINTS), 3))
    for pose, turned in enumerate(_SHOWN.values()):
        for joint, turn in turned.items():
            degrees[pose, JOINTS.index(joint)] = turn
    return Poses(JOINTS, PARENTS, np.radians(degrees))


def measure(outfits: list[str], identities: int, poses: int, subdivide: int) -> None:
    """One line an outfit over random people of all ages in NPT's poses: rate, depth in the body, stretch, skinning."""
    body = AnnyBody(topology="notoes_collapse5pc", phenotypes=PhenotypeRanges(age=(0, 1)))
    usual = DrapeSolver(subdivide=subdivide)
    steps = {"frames": 2 * usual.frames, "substeps": 2 * usual.substeps, "settle": 4 * usual.settle}
    finer = usual.model_copy(update=steps)
    model, fine = (ClothedModel(ClothedBody(body=body, detail=subdivide, solver=its)) for its in (usual, finer))
    drawn = draw_poses(PoseRecipe(), range(poses))
    print("outfit | vertices | CPU s a pose | > 2 mm inside: median, worst | stretch: p50, p99 | finer | skinned")
    for outfit in outfits:
        row = _measured(model, fine, list(OUTFITS).index(outfit), identities, drawn)
        print(outfit, "|", " | ".join(row), flush=True)


def _measured(model: ClothedModel, fine: ClothedModel, outfit: int, identities: int, poses: Poses) -> list[str]:
    found: dict[str, list[Any]] = {key: [] for key in ("vertices", "seconds", "inside", "stretch", "finer", "skinned")}
    for identity in range(identities):
        drawn = model.draw_identity(generator(0, Stream.IDENTITY, identity), identity)
        parameters = np.array([*drawn[:-2], outfit, drawn[-1]])
        person = model.person(tuple(parameters.tolist()))
        first, edges, world = len(person.skin.vertices), edges_of(person.garment.faces), model.world_rotations(poses)
        begun = time.process_time()
        draped = model.vertices(parameters, poses)[:, first:]
        found["seconds"].append((time.process_time() - begun) / len(poses))
        assert np.isfinite(draped).all()
        body = skin(person.body, world)
        found["vertices"].append(draped.shape[1])
        found["inside"] += [np.mean(depths(*pair, body_faces()) > 0.002) for pair in zip(draped, body, strict=True)]
        found["stretch"] += [_lengths(one, edges) / person.garment.lengths(edges) for one in draped]
        found["skinned"].append(_apart(draped[:2], skin(person.garment.rest, world[:2])))
        found["finer"].append(_apart(draped[:2], fine.vertices(parameters, poses[:2])[:, first:]))
    stretch = np.percentile(np.concatenate(found["stretch"]), [50, 99])
    return [
        f"{np.mean(found['vertices']):,.0f}", f"{np.mean(found['seconds']):.2f}",
        f"{np.median(found['inside']):.2%}, {np.max(found['inside']):.2%}", f"{stretch[0]:.3f}, {stretch[1]:.2f}",
        f"{np.mean(found['finer']):.1f}", f"{np.mean(found['skinned']):.1f}",
    ]  # fmt: skip


def _lengths(vertices: NDArray[np.floating], edges: NDArray[np.int64]) -> NDArray[np.floating]:
    return np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)


def _apart(one: NDArray[np.floating], other: NDArray[np.floating]) -> float:
    return 1000 * float(np.linalg.norm(one - other, axis=2).mean())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["picture", "sheet", "people", "walk", "measure"])
    parser.add_argument("path", nargs="?", type=Path, help="file, or folder of people; measure takes none")
    parser.add_argument("--identities", type=int, default=3)
    parser.add_argument("--poses", type=int, default=4)
    parser.add_argument("--subdivide", type=int, default=1)
    parser.add_argument("--outfits", nargs="+", choices=list(OUTFITS), default=list(OUTFITS))
    given = parser.parse_args()
    if given.path is None and given.what != "measure":
        parser.error(f"{given.what} needs the path that it writes to")
    if given.what == "picture":
        picture(given.path)
    elif given.what == "sheet":
        sheet(given.path, given.identities, given.poses, given.subdivide)
    elif given.what == "people":
        people(given.path, given.identities, given.poses, given.subdivide)
    elif given.what == "walk":
        walk(given.path)
    else:
        measure(given.outfits, given.identities, given.poses, given.subdivide)
