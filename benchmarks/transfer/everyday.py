"""Poses of everyday life, made by hand: ``python -m benchmarks.transfer.everyday FOLDER [--weights W]``.

A grown-up sits, squats, folds the arms, looks over the shoulder, crawls; a child, and an old person of 13,718 vertices,
take these poses from that which is half of the list further on. Nothing was trained on them. Printed are, pose by pose,
the rest error of the source in degrees and, of both, PMD, millimetres and the normals' error, the best turn taken out;
drawn, in FOLDER, source, target, output and truth. Two minutes of one core.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.bodies import load_body
from datagen.common.seeding import Stream, generator
from datagen.mesh.geometry import Mesh
from datagen.poses import JOINTS, PARENTS, Poses
from datagen.recipe import AnnyBody, AnnyTopology, PhenotypeRanges
from training.evaluation.robustness import Case
from training.inference.mesh_reading import normalised
from training.inference.transfer import PoseTransfer
from training.objectives import PMD_UNIT
from training.viz.comparison_figure import comparison_figure
from training.viz.transfer_example import Comparison
from workflows.pretrained import weights_named

_IN_A_PICTURE = 7
_PANEL = (300, 300)

PEOPLE: dict[str, tuple[float, AnnyTopology, int]] = {
    "child": (0.25, "notoes_collapse5pc", 4),
    "grown-up": (0.55, "notoes_collapse10pc", 3),
    "old person": (0.9, "anny", 5),
}
"""What `Person` is made of."""

Turns = dict[str, tuple[float, ...]]
"""Joints of a side, as the left one's, or of the middle, each turned about SMPL's x, then y, then z, in degrees."""

HANGING: Turns = {"shoulder": (0, 0, -75)}
POSES: dict[str, tuple[Turns, Turns]] = {  # what both sides do, and what the right one does in its place
    "standing": ({**HANGING, "elbow": (0, -15, 0)}, {}),
    "arms out, head turned": ({"head": (0, 35, 0), "neck": (0, 30, 0)}, {}),
    "hands up": ({"shoulder": (0, 0, 65), "collar": (0, 0, 15)}, {}),
    "waving": ({**HANGING, "head": (0, -10, 8)}, {"shoulder": (-60, -10, 5), "elbow": (0, -100, 0)}),
    "hands on hips": ({"shoulder": (50, 15, -50), "elbow": (0, -95, 0), "wrist": (0, 0, -20)}, {}),
    "arms crossed": ({"shoulder": (55, -25, -60), "elbow": (0, -105, 0)}, {"shoulder": (45, -20, -55)}),
    "hands behind the head": ({"shoulder": (-80, 5, 15), "elbow": (0, -130, 0), "collar": (0, 0, 12)}, {}),
    "telephone": ({**HANGING, "head": (0, 15, 10)}, {"shoulder": (-20, -25, -65), "elbow": (0, -140, 0)}),
    "reading": ({**HANGING, "elbow": (0, -80, 0), "head": (25, 0, 0), "neck": (15, 0, 0)}, {}),
    "looking over the shoulder": (
        {**HANGING, "spine1": (0, 13, 0), "spine2": (0, 13, 0), "spine3": (0, 13, 0), "neck": (0, 30, 0)},
        {},
    ),
    "leaning sideways": (
        {"spine1": (0, 0, 10), "spine2": (0, 0, 10), "spine3": (0, 0, 10), "shoulder": (0, 0, 70)},
        {"shoulder": (0, 0, -80)},
    ),
    "sitting": ({**HANGING, "elbow": (0, -50, 0), "hip": (-88, 0, 6), "knee": (88, 0, 0)}, {}),
    "cross-legged": (
        {"shoulder": (0, -20, -65), "elbow": (0, -40, 0), "hip": (-75, 35, -45), "knee": (125, 0, 0),
         "ankle": (20, 0, 0)},
        {"hip": (-80, 35, -42)},
    ),
    "squatting": (
        {"shoulder": (0, -75, -20), "hip": (-115, 0, 20), "knee": (130, 0, 0), "ankle": (-25, 0, 0),
         "spine1": (20, 0, 0)},
        {},
    ),
    "picking up": (
        {"spine1": (20, 0, 0), "spine2": (22, 0, 0), "spine3": (20, 0, 0), "shoulder": (0, -60, -55),
         "hip": (-60, 0, 4),
         "knee": (40, 0, 0)},
        {},
    ),
    "walking": (
        {"shoulder": (0, 20, -72), "elbow": (0, -20, 0), "hip": (-28, 0, 0), "knee": (12, 0, 0)},
        {"shoulder": (0, -30, -70), "hip": (18, 0, 0), "knee": (25, 0, 0), "ankle": (15, 0, 0)},
    ),
    "running": (
        {"shoulder": (0, 35, -60), "elbow": (0, -95, 0), "hip": (-75, 0, 0), "knee": (95, 0, 0), "spine1": (12, 0, 0)},
        {"shoulder": (0, -50, -60), "elbow": (0, -90, 0), "hip": (20, 0, 0), "knee": (55, 0, 0), "ankle": (30, 0, 0)},
    ),
    "boxing": (
        {"shoulder": (20, -60, -50), "elbow": (0, -125, 0), "hand": (0, 0, -75), "hip": (-25, 0, 8),
         "knee": (25, 0, 0)},
        {"shoulder": (0, -85, -10), "elbow": (0, -10, 0), "hip": (10, 0, 15), "knee": (20, 0, 0)},
    ),
    "kicking": (
        {"shoulder": (0, 10, -40), "elbow": (0, -50, 0), "spine2": (-8, 0, 0)},
        {"hip": (-95, 0, 5), "knee": (15, 0, 0)},
    ),
    "lunge": (
        {"shoulder": (0, 0, -10), "hip": (-85, 0, 5), "knee": (90, 0, 0), "neck": (0, 60, 0)},
        {"hip": (25, 0, 15), "knee": (5, 0, 0), "ankle": (-20, 0, 0), "shoulder": (0, 0, 0)},
    ),
    "on one leg": (
        {"shoulder": (0, -15, 75), "elbow": (0, -25, 0)},
        {"hip": (-60, 55, -40), "knee": (120, 0, 0), "ankle": (30, 0, 0)},
    ),
    "kneeling": ({**HANGING, "knee": (100, 0, 0), "ankle": (45, 0, 0), "head": (20, 0, 0)}, {}),
    "crawling": ({"shoulder": (0, -85, 0), "hip": (-85, 0, 0), "knee": (85, 0, 0), "neck": (-40, 0, 0)}, {}),
    "hugging the knees": (
        {"hip": (-120, 0, 5), "knee": (135, 0, 0), "spine1": (18, 0, 0), "spine2": (18, 0, 0), "spine3": (15, 0, 0),
         "shoulder": (30, -70, -40), "elbow": (0, -70, 0), "neck": (25, 0, 0)},
        {},
    ),
    "throwing": (
        {"shoulder": (0, -50, 20), "spine1": (0, -12, 0), "spine2": (0, -12, -6), "hip": (-40, 0, 5),
         "knee": (30, 0, 0)},
        {"shoulder": (-70, 25, 10), "elbow": (0, -100, 0), "hip": (15, 0, 8), "knee": (30, 0, 0)},
    ),
    "lying on the side": (
        {"shoulder": (0, -80, 10), "elbow": (0, -120, 0), "hip": (-50, 0, 0), "knee": (70, 0, 0), "neck": (10, 0, 12)},
        {"hip": (-75, 0, 0), "knee": (95, 0, 0)},
    ),
    "fists on the chest": (
        {"shoulder": (35, -35, -65), "elbow": (0, -135, 0), "hand": (0, 0, -80), "wrist": (0, 0, -30)},
        {},
    ),
    "bowing": ({**HANGING, "hip": (-40, 0, 0), "spine1": (12, 0, 0), "spine2": (12, 0, 0), "head": (20, 0, 0)}, {}),
}  # fmt: skip


def main() -> None:
    """Transfer, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--weights", default="human", help="a run, or weights that come along")
    options = parser.parse_args()
    transfer = PoseTransfer.from_run(weights_named(options.weights))
    giver, *takers = (Person(*PEOPLE[who]) for who in ("grown-up", "child", "old person"))
    names, rows, errors = list(POSES), list[Comparison](), list[list[float]]()
    of_each = "PMD x1e-4 | mm | normal"
    print(f"| pose | rest error | child: {of_each} | old person: {of_each} |\n|---|{'---:|' * 7}")
    for number, name in enumerate(names):
        other = names[(number + len(names) // 2) % len(names)]
        source = giver(name)
        stands = transfer.standing(source)
        upright = Mesh(stands.upright(source.vertices), source.faces)
        cells = [transfer.rest_error(upright) if np.isnan(stands.rest_error) else stands.rest_error]
        for which, taker in enumerate(takers):
            case = Case(number, (0, 0, 0, 0), source, taker(other), taker(name))
            output = aligned(posed(transfer, case), case.truth.vertices)
            score = case.score(normalised(output))
            cells += [score.pmd / PMD_UNIT, score.millimetres, score.normal_degrees]
            if which == number % 2:
                rows.append(comparison(case, f"{name}, from {other}", output))
        errors.append(cells)
        print(f"| {name} | {words(cells)} |", flush=True)
    print(f"| mean | {words(np.mean(errors, axis=0))} |\n| median | {words(np.median(errors, axis=0))} |")
    options.folder.mkdir(parents=True, exist_ok=True)
    for first in range(0, len(rows), _IN_A_PICTURE):
        path = options.folder / f"everyday-{first // _IN_A_PICTURE + 1}.png"
        print(comparison_figure(rows[first : first + _IN_A_PICTURE], path, panel=_PANEL))


def words(cells: Sequence[float] | NDArray[np.float64]) -> str:
    """Cells of a row."""
    return " | ".join(f"{value:.2f}" if place % 3 == 1 else f"{value:.1f}" for place, value in enumerate(cells))


class Person:
    """One of Anny's people, in the poses by name."""

    def __init__(self, age: float, topology: AnnyTopology, number: int) -> None:
        self._body = load_body(AnnyBody(topology=topology, phenotypes=PhenotypeRanges(age=(age, age))))
        self._who = self._body.draw_identity(generator(98, Stream.IDENTITY, number), number)

    def __call__(self, name: str) -> Mesh:
        """The person in a pose, in metres, Y up, facing +Z."""
        poses = Poses(JOINTS, PARENTS, axis_angles(*POSES[name])[None])
        return Mesh(self._body.vertices(self._who, poses)[0].astype(np.float64), self._body.faces(self._who))


def axis_angles(both: Turns, right: Turns) -> NDArray[np.float64]:
    """Axis-angle [24, 3] in radians: what both sides do, mirrored, but for what the right one does in its place."""
    rotations = np.zeros((len(JOINTS), 3))
    for row, joint in enumerate(JOINTS):
        side, _, name = joint.rpartition("_")
        turns = right.get(name, both.get(name)) if side == "right" else both.get(name)
        if turns is not None:
            turned = Rotation.from_euler("xyz", turns, degrees=True).as_rotvec()
            rotations[row] = turned * (1.0, -1.0, -1.0) if side == "right" else turned
    return rotations


def posed(transfer: PoseTransfer, case: Case) -> NDArray[np.float64]:
    """The target [v, 3] in the source's pose, both as they are found to stand."""
    source, target = map(transfer.standing, (case.source, case.target))
    output = transfer(source=case.source, target=case.target, source_axes=source, target_axes=target)
    return output.vertices.astype(np.float64)


def aligned(output: NDArray[np.float64], truth: NDArray[np.floating]) -> NDArray[np.float64]:
    """The output turned and moved onto the truth."""
    centre, about = output.mean(axis=0), truth.mean(axis=0)
    turn, _ = Rotation.align_vectors(truth - about, output - centre)
    return turn.apply(output - centre) + about


def comparison(case: Case, title: str, output: NDArray[np.float64]) -> Comparison:
    """A row of the picture."""
    outputs = {"Output": Mesh(output, case.target.faces)}
    return Comparison(title, source=case.source, target=case.target, outputs=outputs, truth=case.truth)


if __name__ == "__main__":
    main()
