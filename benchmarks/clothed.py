"""Dressed people: pictures of every outfit, and how good draped garments are.

python -m benchmarks.clothed picture docs/images/bodies-clothed.png
python -m benchmarks.clothed measure [--identities 3] [--poses 4]
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from datagen.bodies.clothed.draping import depths
from datagen.bodies.clothed.model import ClothedModel, body_faces
from datagen.bodies.skinning import skin
from datagen.common.seeding import Stream, generator
from datagen.mesh.geometry import Mesh, edges_of
from datagen.poses import JOINTS, PARENTS, Poses, draw_poses
from datagen.recipe import OUTFITS, AnnyBody, ClothedBody, DrapeSolver, PhenotypeRanges, PoseRecipe
from training.viz.mesh_grid import Panel, Row, mesh_grid, standing

_COLORS = np.array([to_rgb(color) for color in ("#D9A98A", "#55708F", "#C9B458", "#8F4E4E")])
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
            faces, colors = model.faces(parameters), _COLORS[model.part_labels(parameters)]
            posed = model.vertices(parameters, poses)
            rows.append(Row(f"{outfit}\n{name}", [Panel(Mesh(standing(one), faces), colors) for one in posed]))
            print(outfit, name, flush=True)
    title = "Every outfit in four poses, draped, on an adult, a child and an old person"
    mesh_grid(rows, path, columns=list(_SHOWN), title=title, one_scale=False, size=(230, 250))


def _shown_poses() -> Poses:
    degrees = np.zeros((len(_SHOWN), len(JOINTS), 3))
    for pose, turned in enumerate(_SHOWN.values()):
        for joint, turn in turned.items():
            degrees[pose, JOINTS.index(joint)] = turn
    return Poses(JOINTS, PARENTS, np.radians(degrees))


def measure(identities: int, poses: int, subdivide: int) -> None:
    """One line an outfit over random people of all ages in NPT's poses: rate, depth in the body, stretch, skinning."""
    body = AnnyBody(topology="notoes_collapse5pc", phenotypes=PhenotypeRanges(age=(0, 1)))
    usual = DrapeSolver(subdivide=subdivide)
    finer = usual.model_copy(update={"frames": 2 * usual.frames, "substeps": 2 * usual.substeps, "settle": 480})
    model, fine = (ClothedModel(ClothedBody(body=body, detail=subdivide, solver=its)) for its in (usual, finer))
    drawn = draw_poses(PoseRecipe(), range(poses))
    print("outfit | vertices | CPU s a pose | > 2 mm inside: median, worst | stretch: p50, p99 | finer | skinned")
    for number, outfit in enumerate(OUTFITS):
        print(outfit, "|", " | ".join(_measured(model, fine, number, identities, drawn)), flush=True)


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
        found["skinned"].append(_apart(draped, skin(person.garment.rest, world)))
        if identity == 0:
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
    parser.add_argument("what", choices=["picture", "measure"])
    parser.add_argument("path", nargs="?", type=Path, default=Path("docs/images/bodies-clothed.png"))
    parser.add_argument("--identities", type=int, default=3)
    parser.add_argument("--poses", type=int, default=4)
    parser.add_argument("--subdivide", type=int, default=1)
    given = parser.parse_args()
    if given.what == "picture":
        picture(given.path)
    else:
        measure(given.identities, given.poses, given.subdivide)
