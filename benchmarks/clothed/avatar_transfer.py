"""Ways to bring a dressed person into a source's pose, where the truth is simulated: DSFFNet, `parts`, an avatar.

python -m benchmarks.clothed.avatar_transfer runs/avatar [--frames 8] [--picture transfer.png]

The source is a bare person of Anny in the avatar's unseen poses. The networks move a scan of the dressed person in the
seen pose that turns joints least; the avatar is driven by the pose that the weights `human` read off the source, and by
the true one. Outputs are moved to where they are nearest to the truth: where a body stands is not asked.
Normals are those of the meshes; of these, an avatar's surface is smoothed where a pose tears it, other outputs are not.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb

from datagen.bodies import load_body
from datagen.common.arrays import Floats
from datagen.common.seeding import Stream, generator
from datagen.mesh.geometry import Mesh, vertex_normals
from datagen.poses import Poses
from datagen.recipe import AnnyBody
from datagen.store import open_dataset
from training.avatar.metrics import Surface, score
from training.avatar.subject import Subject, posed_by
from training.inference.orientation import UPRIGHT
from training.inference.pose_reading import read_poses
from training.inference.transfer import PoseTransfer
from training.viz.mesh_grid import Panel, Row, mesh_grid, standing
from workflows.avatar.evaluate import learned_avatar
from workflows.avatar.outfits import outer_scan
from workflows.pipeline.run_folder import AvatarFolder
from workflows.pretrained import own_weights

_DIRECT = {"DSFFNet": "dsffnet-people", "parts": "human", "parts, dressed": "dressed"}
_SAMPLES, _SOURCE, _MOVES = 20_000, 11, 20
_SKINNED, _READ, _TRUE = "template + skinning by the pose read", "avatar by the pose read", "avatar by the true pose"
_DRAWN = {"source": "source", "truth": "truth", "the target as it is": "target", **{name: name for name in _DIRECT},
          _READ: "avatar, pose read", _TRUE: "avatar, true pose"}  # fmt: skip


def compare(folder: AvatarFolder, frames: int) -> Iterator[tuple[str, int, dict[str, Mesh]]]:
    """Of each outfit and unseen frame: source, truth, and what each method makes of it."""
    wardrobe, network = learned_avatar(folder)
    attributes = open_dataset(folder.data).attributes
    joints, parents = tuple(attributes["joints"]), tuple(attributes["joint_parents"])
    transfers = {name: PoseTransfer.from_run(own_weights(its)) for name, its in _DIRECT.items()}
    for number, subject in enumerate(wardrobe.subjects):
        its = subject.unseen[:frames]
        sources = _sources(Poses(joints, parents, subject.rotations[its].astype(np.float64)))
        resting, *posed = sources
        read = Poses(*read_poses([own_weights("human")], [resting, *posed]))[1:]
        driven = posed_by(subject.body, read.rotations, read.joints, read.parents)
        by_read = list(wardrobe.animated(network, number, driven))
        by_truth = list(wardrobe.posed(network, [(number, frame) for frame in its]))
        target = _plainest(subject)
        for place, frame in enumerate(its):
            truth = outer_scan(subject, frame)
            made = {"the target as it is": Mesh(target.vertices, truth.faces)}
            for name, transfer in transfers.items():
                output = transfer(source=posed[place], target=target, source_axes=UPRIGHT, target_axes=UPRIGHT)
                made[name] = Mesh(output.vertices, truth.faces)
            made[_SKINNED] = wardrobe.surface(number, by_read[place].skinned)
            made[_READ] = by_read[place].mesh
            made[_TRUE] = by_truth[place].mesh
            yield subject.name, frame, {"source": posed[place], "truth": truth} | made


def _sources(poses: Poses) -> list[Mesh]:
    """A bare person at rest, facing +Z, and in each pose."""
    body = load_body(AnnyBody(topology="notoes_collapse5pc"))
    who = body.draw_identity(generator(_SOURCE, Stream.IDENTITY, 0), 0)
    resting = Poses(poses.joints, poses.parents, np.zeros_like(poses.rotations[:1]))
    return [
        Mesh(each.astype(np.float64), body.faces(who)) for its in (resting, poses) for each in body.vertices(who, its)
    ]


def _plainest(subject: Subject) -> Mesh:
    turned = np.abs(subject.rotations[:, 1:]).sum(axis=(1, 2))
    return subject.scan(min(subject.seen, key=lambda frame: float(turned[frame])))


def _shown(mesh: Mesh) -> Mesh:
    """Without vertices that no triangle has."""
    kept, faces = np.unique(mesh.faces, return_inverse=True)
    return Mesh(mesh.vertices[kept], faces.reshape(-1, 3))


def _beside(mesh: Mesh, truth: Mesh) -> Mesh:
    """Moved, without a turn, to where the truth's surface is nearest to it on average."""
    wanted, own = (Surface.sampled(each, _SAMPLES // 4) for each in (truth, mesh))
    offset: Floats = wanted.points.mean(axis=0) - own.points.mean(axis=0)
    for _ in range(_MOVES):
        near = own.points[own.nearest(wanted.points - offset)]
        offset = np.median(wanted.points - near, axis=0)
    return Mesh(mesh.vertices + offset, mesh.faces)


def report(found: list[tuple[str, int, dict[str, Mesh]]]) -> None:
    """The table, in millimetres."""
    print("| outfit | method | scan to model | model to scan | to plane | normals | Hausdorff |")
    values: dict[tuple[str, str], list[tuple[float, ...]]] = defaultdict(list)
    for outfit, _, meshes in found:
        truth = _shown(meshes["truth"])
        for method, mesh in list(meshes.items())[2:]:
            model = _beside(_shown(mesh), truth)
            its = score(model, vertex_normals(model.vertices, model.faces), truth, samples=_SAMPLES)
            row = (its.scan_to_model, its.model_to_scan, its.plane, its.normal_angle, its.hausdorff)
            values[outfit, method].append(row)
    for (outfit, method), rows in values.items():
        print(
            f"| {outfit} | {method} |", " | ".join(f"{value:.1f}" for value in np.mean(rows, axis=0)), "|", flush=True
        )


def picture(found: list[tuple[str, int, dict[str, Mesh]]], path: Path) -> None:
    """Two poses of each outfit by all methods."""
    rows = list[Row]()
    for outfit in dict.fromkeys(outfit for outfit, *_ in found):
        for _, frame, meshes in [row for row in found if row[0] == outfit][:2]:
            shown = [meshes[name] for name in _DRAWN]
            panels = [Panel(Mesh(standing(each.vertices), each.faces), to_rgb("#C9B458")) for each in shown]
            rows.append(Row(f"{outfit},\npose {frame}", panels))
    mesh_grid(
        rows,
        path,
        columns=[*_DRAWN.values()],
        title="A source's pose on people in clothes",
        one_scale=False,
        size=(230, 270),
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of dsffnet avatar train")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--picture", type=Path, help="PNG to write")
    options = parser.parse_args()
    its_found = list(compare(AvatarFolder(options.folder), options.frames))
    report(its_found)
    if options.picture:
        picture(its_found, options.picture)
