"""The point avatar on simulated scans of one person in a skirt: what each part of the method is worth.

python -m benchmarks.clothed.avatar /tmp/avatar [--steps 600] [--normalisation group] [--picture avatar.png]

The template is a stand-in for a learned one: the dressed mesh, skinned to the canonical pose and simplified, with the
weights of the nearest vertex of the bare body. Scans are kept in the folder, and made once.
"""

import argparse
import time
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
import torch
from matplotlib.colors import to_rgb
from scipy.spatial import cKDTree

from datagen.bodies import load_body
from datagen.bodies.clothed.figure import BODY_VERTICES
from datagen.bodies.clothed.model import ClothedModel
from datagen.characters.simplify import simplify
from datagen.common.arrays import Floats
from datagen.common.seeding import Stream, generator
from datagen.mesh.geometry import Mesh
from datagen.poses import JOINTS, PARENTS, Poses, draw_poses
from datagen.recipe import AnnyBody, ClothedBody, PoseRecipe
from training.avatar.maps import PositionMaps, Views
from training.avatar.metrics import Footprints, Surface, score
from training.networks.avatar import Avatar, CanonicalPoints, PointAvatar
from training.objectives.point_losses import Edges, Scan, avatar_loss
from training.viz.mesh_grid import Panel, Row, mesh_grid, standing
from training.viz.render.lighting import vertex_normals

_SEEN, _UNSEEN, _POINTS = 32, 8, 5_000
_SCAN_POINTS, _BATCH = 8_000, 2
_SIZES = {"map_size": 128, "unet_width": 8, "hidden_width": 128, "geometry": 32, "pose": 32}
_COLORS = ("#55708F", "#C9B458", "#C9B458", "#C9B458")


@dataclass(frozen=True, eq=False)
class Data:
    """Scans ``[pose, vertex, 3]`` with ``parts`` and bones' transforms ``[pose, bone, 3, 4]``; the template."""

    scans: Floats
    faces: Any
    parts: Any
    canonical: Floats
    transforms: Floats
    template: Floats
    template_faces: Any
    weights: Floats

    def scan(self, pose: int) -> Mesh:
        return Mesh(self.scans[pose], self.faces)


def made(folder: Path) -> Data:
    """The data, from the folder where they are there."""
    path = folder / "skirt.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(path, **vars(_make()))
    return Data(**np.load(path))


def _make() -> Data:
    fine, coarse = (
        ClothedBody(body=AnnyBody(topology=skin), outfits=("skirt",), detail=1)
        for skin in ("notoes", "notoes_collapse10pc")
    )
    dressed, poses, canonical = ClothedModel(fine), draw_poses(PoseRecipe(), range(_SEEN + _UNSEEN)), _canonical()
    parameters = dressed.draw_identity(generator(0, Stream.IDENTITY, 0), 0)
    begun = time.process_time()
    scans = dressed.vertices(parameters, poses)
    print(f"{len(scans)} scans of {scans.shape[1]} vertices: {time.process_time() - begun:.0f} CPU s", flush=True)
    still, rest = (ClothedModel(recipe.model_copy(update={"method": "skinned"})) for recipe in (fine, coarse))
    rest_of_scans, rest_of_template = (its.vertices(parameters, canonical)[0].astype(float) for its in (still, rest))
    bare = load_body(AnnyBody(topology="makehuman"))
    rig = bare.rig(parameters[:-2], JOINTS)
    assert rig is not None
    nearest = cKDTree(bare.vertices(parameters[:-2], canonical)[0, :BODY_VERTICES]).query(rest_of_template)[1]
    weights = scipy.sparse.csr_array(rig.weights[nearest])
    template, template_faces, kept = simplify(
        rest_of_template, rest.faces(parameters), weights, _POINTS, name="the template"
    )
    transforms = _relative(rig.transforms(poses.world()), rig.transforms(canonical.world()))
    faces, parts = dressed.faces(parameters), dressed.part_labels(parameters)
    return Data(scans, faces, parts, rest_of_scans, transforms, template, template_faces, kept.toarray())


def _canonical() -> Poses:
    """The T-pose, hips turned outwards by 15 degrees."""
    degrees = np.zeros((1, len(JOINTS), 3))
    degrees[0, [JOINTS.index("left_hip"), JOINTS.index("right_hip")], 2] = 15, -15
    return Poses(JOINTS, PARENTS, np.radians(degrees))


def _relative(posed: Floats, canonical: Floats) -> Floats:
    """Transforms [pose, bone, 3, 4] from the canonical pose, for those from rest."""
    back = canonical[..., :3].swapaxes(-1, -2)
    turns = posed[..., :3] @ back
    return np.concatenate([turns, posed[..., 3:] - turns @ canonical[..., 3:]], axis=-1)


class Subject:
    """An avatar of the data, with what its steps need."""

    def __init__(self, data: Data, normalisation: str) -> None:
        self.data, template = data, Mesh(data.template, data.template_faces)
        self.transforms = torch.from_numpy(data.transforms).float()
        views, weights = Views.of([data.template]), torch.from_numpy(data.weights).float()
        normals = vertex_normals(data.template, data.template_faces)
        places = views.places(data.template)[..., :2]
        own = [torch.from_numpy(np.asarray(its, np.float32)) for its in (data.template, normals, data.weights, places)]
        torch.manual_seed(0)
        self.network = PointAvatar([CanonicalPoints(*own)], normalisation=normalisation, **_SIZES)
        self._edges = Edges.of(data.template_faces, len(data.template))
        self._maps = PositionMaps(views, template, weights, size=_SIZES["map_size"])

    def posed(self, frames: list[int]) -> Avatar:
        transforms = self.transforms[frames]
        found: Avatar = self.network(self._maps(transforms), transforms, [0] * len(frames))
        return found

    def train(self, steps: int, *, roughness: float) -> None:
        """Take steps on the seen poses, the normals counting from half-time on."""
        random, network = np.random.default_rng(0), self.network.train()
        sampled = [Surface.sampled(self.data.scan(pose), 20_000, seed=pose) for pose in range(_SEEN)]
        shared = [each for name, each in network.named_parameters() if name != "features"]
        optimizer = torch.optim.Adam(shared, lr=1e-3)
        optimizer.add_param_group({"params": [network.features], "lr": 2e-3})
        begun = time.process_time()
        for step in range(steps):
            frames = random.choice(_SEEN, _BATCH, replace=False).tolist()
            scans = [_some(sampled[frame], random) for frame in frames]
            loss, parts = avatar_loss(
                self.posed(frames),
                scans,
                normals=1e-6 if step < steps / 2 else 1.0,
                edges=[self._edges] * _BATCH,
                roughness=roughness,
            )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            if step % 50 == 49:
                told = " ".join(f"{name} {value.item():.3g}" for name, value in parts.items())
                print(f"{step + 1}: {loss.item():.3f} {told}, {time.process_time() - begun:.0f} CPU s", flush=True)


def _some(surface: Surface, random: np.random.Generator) -> Scan:
    chosen = random.choice(len(surface.points), _SCAN_POINTS, replace=False)
    return Scan(*(torch.from_numpy(its[chosen]).float() for its in (surface.points, surface.normals)))


@torch.no_grad()
def report(subject: Subject) -> None:
    """The table: template and skinning, with correction, with displacement; seen and unseen poses."""
    subject.network.eval()
    print("poses | stage | to model | to scan | plane | normal | Hausdorff | Chamfer 1e-5 | cosine | corresponding")
    for kind, poses in (("seen", range(_UNSEEN)), ("unseen", range(_SEEN, _SEEN + _UNSEEN))):
        avatars = [subject.posed([pose]) for pose in poses]
        for stage in ("template + skinning", "+ correction", "+ displacement"):
            _told(subject.data, kind, stage, poses, avatars)


def _told(data: Data, kind: str, stage: str, poses: range, avatars: list[Avatar]) -> None:
    meshes = [Mesh(_points(avatar, stage), data.template_faces) for avatar in avatars]
    scores = [
        score(
            mesh,
            avatar.normals.numpy() if stage == "+ displacement" else vertex_normals(mesh.vertices, mesh.faces),
            data.scan(pose),
            parts=data.parts,
        )
        for mesh, avatar, pose in zip(meshes, avatars, poses, strict=True)
    ]
    footprints = Footprints.of(meshes[0].vertices, data.scan(poses[0]))
    away = [footprints.distances(its.vertices, data.scans[pose]) for its, pose in zip(meshes, poses, strict=True)]
    means = np.mean([astuple(its)[:7] for its in scores], axis=0) * [1, 1, 1, 1, 1, 1e5, 1]
    print(kind, "|", stage, "|", " | ".join(f"{its:.3g}" for its in [*means, 1000 * np.mean(away[1:])]), flush=True)
    for part in range(int(data.parts.max()) + 1):
        own = np.nanmean([its.parts[part] for its in scores if part in its.parts], axis=0)
        print("   part", part, "|", " | ".join(f"{its:.3g}" for its in own), flush=True)


def _points(avatar: Avatar, stage: str) -> Floats:
    points = {"template + skinning": avatar.skinned, "+ correction": avatar.points - avatar.displacements}
    return points.get(stage, avatar.points).double().numpy()


@torch.no_grad()
def picture(subject: Subject, path: Path) -> None:
    """Unseen poses: the scan, and the avatar in three stages."""
    data, rows = subject.data, list[Row]()
    for pose in range(_SEEN, _SEEN + 5):
        avatar = subject.posed([pose])
        stages = [_points(avatar, stage) for stage in ("template + skinning", "+ correction", "+ displacement")]
        meshes = [data.scan(pose), *(Mesh(its, data.template_faces) for its in stages)]
        panels = [
            Panel(Mesh(standing(mesh.vertices), mesh.faces), np.tile(to_rgb(color), (len(mesh.vertices), 1)))
            for mesh, color in zip(meshes, _COLORS, strict=True)
        ]
        rows.append(Row(f"unseen pose {pose}", panels))
    columns = ["scan", "template, skinned", "+ correction", "+ displacement"]
    mesh_grid(rows, path, columns=columns, title="Poses that were not trained on", one_scale=False, size=(260, 290))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where scans are kept")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--normalisation", choices=["group", "batch"], default="group")
    parser.add_argument("--roughness", type=float, default=100.0, help="its weight; 0: the paper's loss")
    parser.add_argument("--picture", type=Path, help="PNG to write")
    given = parser.parse_args()
    its_subject = Subject(made(given.folder), given.normalisation)
    its_subject.train(given.steps, roughness=given.roughness)
    report(its_subject)
    if given.picture:
        picture(its_subject, given.picture)
