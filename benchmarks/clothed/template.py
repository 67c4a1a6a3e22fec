"""Stage 1 of FITE on one person in a skirt: the field, canonical points, the template. Times are CPU seconds.

python -m benchmarks.clothed.template field
python -m benchmarks.clothed.template roots
python -m benchmarks.clothed.template template FOLDER [--steps 1250]
python -m benchmarks.clothed.template skin docs/images/skin.png
python -m benchmarks.clothed.template rest
"""

import argparse
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from datagen.bodies import load_body
from datagen.bodies.anny.model import AnnyModel
from datagen.bodies.clothed.model import ClothedModel, body_faces
from datagen.bodies.skinning import skin
from datagen.common.seeding import Stream, generator
from datagen.mesh.geometry import Mesh, vertex_normals
from datagen.mesh.rig import skinned
from datagen.poses import JOINTS, PARENTS, Poses, draw_poses
from datagen.recipe import AnnyBody, ClothedBody, PoseRecipe
from datagen.recipe.clothed import OUTFITS
from training.avatar.body import CanonicalBody, canonical_body
from training.avatar.diffusion import SkinningField, ThinPlate, diffused_skinning, thin_plate
from training.avatar.occupancy import FrameSamples, frame_samples, hand_samples
from training.avatar.roots import Roots, TransformField, canonical_roots, fold_over, starting_bones
from training.avatar.solid import Solid
from training.avatar.template import (
    Template,
    extract_template,
    near_surface_iou,
    plainest_pose,
    pose_condition,
    template_loss,
)
from training.engine.optimization.muon import Muon
from training.networks.template import OccupancyTemplate
from training.viz.mesh_grid import Panel, Row, mesh_grid

_PERSON = (0.5, 0.7, 0.5, 0.5, 0.5, 0.5)
_BODY_VERTICES = 13_380
_BANDS = (0.0, 0.05, 0.15, 0.3)  # metres from the skin
_DRAWN = 1500  # points near the surface of a scan; an eighth as many anywhere
_TEMPLATE, _SCAN = (0.33, 0.56, 0.6), (0.78, 0.66, 0.58)
_EVERY = 250  # steps between two measurements


@contextmanager
def timed(what: str) -> Iterator[None]:
    begun = time.process_time()
    yield
    print(f"{what}: {time.process_time() - begun:.1f} CPU s", flush=True)


@dataclass(frozen=True)
class Subject:
    """A person in an outfit, or bare, whose garments are draped or skinned."""

    outfit: str = "skirt"
    method: str = "draped"

    @cached_property
    def body(self) -> CanonicalBody:
        """With hips turned outwards."""
        return _canonical(np.array(_PERSON), np.pi / 12)

    def resting(self) -> CanonicalBody:
        """The person in the T-pose."""
        return _canonical(np.array(_PERSON), 0.0)

    def scans(self, poses: Poses) -> list[list[Mesh]]:
        """The whole body and the parts of the outfit in each pose."""
        outfits = () if self.outfit == "bare" else (self.outfit,)
        model = load_body(ClothedBody(outfits=outfits or ("skirt",), method=self.method))
        assert isinstance(model, ClothedModel)
        parameters = np.array([*_PERSON, 0, 1.0])
        bodies = skin(model.person(tuple(parameters.tolist())).body, model.world_rotations(poses))
        found = [[Mesh(body, body_faces())] for body in bodies]
        if outfits:
            labels, faces = model.part_labels(parameters), model.faces(parameters)
            for scan, posed in zip(found, model.vertices(parameters, poses), strict=True):
                parts = [faces[(labels[faces] == part).all(axis=1)] for part in range(1, labels.max() + 1)]
                scan.extend(Mesh(posed, part) for part in parts)
        return found


def _anny() -> AnnyModel:
    model = load_body(AnnyBody(topology="makehuman"))
    assert isinstance(model, AnnyModel)
    return model


def _canonical(person: NDArray[np.float64], spread: float) -> CanonicalBody:
    model = _anny()
    rig = model.rig(person, JOINTS)
    rig = replace(rig, weights=rig.weights[:_BODY_VERTICES])
    vertices = model.rest(person).vertices[:_BODY_VERTICES]
    return canonical_body(rig, vertices, body_faces(), JOINTS, PARENTS, spread=spread)


def field(centres: int) -> None:
    """Reproduction of centres, error at the skin, fold-over by distance from the body in two poses."""
    body = Subject().body
    with timed(f"spline of {centres} points of the skin"):
        plate = thin_plate(body, centres=centres)
    away, nearest = cKDTree(body.vertices).query(plate.centres)
    on_skin = away < 1e-9
    error = np.abs(plate.weights(plate.centres[on_skin]) - body.weights[nearest[on_skin]])
    print(f"{len(plate.centres)} centres; error there at most {error.max():.1e}, mean {error.mean():.1e}")
    with timed("spline and grid"):
        found = diffused_skinning(body, centres=centres)
    print(f"grid {list(found.grid.shape)}")
    on_grid = found.weights(torch.from_numpy(body.vertices).float()).numpy()
    for what, weights in (("spline", plate.weights(body.vertices)), ("grid", on_grid)):
        variation = np.abs(weights - body.weights)[~_hands(body)].sum(axis=1).mean() / 2
        print(f"total variation at the skin without hands, {what}: {variation:.3f}")
    _print_slopes(body, plate)
    for name, pose in _postures().items():
        _print_fold_over(name, body, found, _transforms(body, pose)[0])


def _print_slopes(body: CanonicalBody, plate: ThinPlate) -> None:
    """How weights change along the skin and across it, at vertices that are seen, hands left out."""
    normals = vertex_normals(body.vertices, body.faces)
    shown = Solid(body.vertices, body.faces).seen(body.vertices, normals) & ~_hands(body)
    points, normals = body.vertices[shown][::5], normals[shown][::5]
    steps = 0.002 * np.eye(3)
    slopes = np.stack([(plate.weights(points + step) - plate.weights(points - step)) / 0.004 for step in steps], axis=2)
    across = np.einsum("vbi,vi->vb", slopes, normals)
    along = np.linalg.norm(slopes - across[..., None] * normals[:, None], axis=2)
    print(f"slope across the skin over that along it: {np.abs(across).mean() / along.mean():.2f}")


def _print_fold_over(name: str, body: CanonicalBody, found: SkinningField, transforms: Tensor) -> None:
    cells = found.cells().reshape(-1, 3).float()
    depth = Solid(body.vertices, body.faces).depth(cells.numpy())
    folded = fold_over(TransformField.of(found, transforms), cells).numpy()
    outside = [folded[(-depth > low) & (-depth <= high)].mean() for low, high in pairwise(_BANDS)]
    print(f"{name}: fold-over outside 0-5 / 5-15 / 15-30 cm", " / ".join(f"{share:.1%}" for share in outside))
    print(f"  within 5 cm on both sides of the skin {folded[np.abs(depth) <= _BANDS[1]].mean():.1%}")


def roots(poses: int) -> None:
    """Roots of body and skinned garments in NPT's poses: whether found, and whether where a point comes from.

    Of the body, of its vertices and of its surface: vertices lie close at toes and in the face.
    """
    subject, drawn = Subject("skirt", "skinned"), draw_poses(PoseRecipe(), range(poses))
    body, transforms = subject.body, _transforms(subject.body, drawn)
    weights, bones = diffused_skinning(body), starting_bones(body)
    print("starts from", ", ".join(body.names[bone] for bone in bones))
    seen = Solid(body.vertices, body.faces).seen(body.vertices, vertex_normals(body.vertices, body.faces))
    shown = torch.from_numpy(seen & ~_hands(body))
    areas = _areas(body)[shown]
    areas /= areas.sum()
    by_own = skinned(body.vertices, body.weights, transforms.numpy())
    canonical, garments = torch.from_numpy(body.vertices).float(), _own_canonical(subject)
    for number, scan in enumerate(subject.scans(drawn)):
        moved = TransformField.of(weights, transforms[number])
        for what, places in (("as the model poses it", scan[0].vertices), ("by its canonical weights", by_own[number])):
            with timed(f"pose {number}, body {what}"):
                found = canonical_roots(moved, torch.from_numpy(places).float(), transforms[number], bones)
            away = _away(found, canonical)[shown]
            a_root, true = found.valid.any(dim=1)[shown], away < 0.01
            for of, share in (("vertices", torch.full_like(areas, 1 / len(areas))), ("the surface", areas)):
                print(f"  of {of}: a root {share[a_root].sum():.2%}, true place within 1 cm {share[true].sum():.2%}")
        for part, mesh in zip(("shirt", "skirt"), scan[1:], strict=True):
            used = np.unique(mesh.faces)
            found = canonical_roots(moved, torch.from_numpy(mesh.vertices[used]).float(), transforms[number], bones)
            away = 1000 * _away(found, torch.from_numpy(garments[used]).float())
            a_root = found.valid.any(dim=1).float().mean()
            spread = f"{away.median():.1f} mm (median), {away.quantile(0.9):.1f} mm (90 %)"
            print(f"  {part}: a root {a_root:.2%}, canonical place within {spread}")


def _areas(body: CanonicalBody) -> Tensor:
    """The area [n] around each vertex of a body, a third of its triangles'."""
    corners = body.vertices[body.faces]
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return torch.from_numpy(np.bincount(body.faces.ravel(), np.repeat(doubled / 6, 3), len(body.vertices)))


def _away(found: Roots, canonical: Tensor) -> Tensor:
    """Distance [n] of the nearest root to the canonical place [n, 3]; infinite without one."""
    return (found.points - canonical[:, None]).norm(dim=2).where(found.valid, torch.inf).amin(dim=1)


def _own_canonical(subject: Subject) -> NDArray[np.float64]:
    """The canonical place of every vertex of a person in skinned clothes, by the garments' own weights."""
    hips = np.zeros((1, len(JOINTS), 3))
    hips[0, [JOINTS.index("left_hip"), JOINTS.index("right_hip")], 2] = np.pi / 12, -np.pi / 12
    return subject.scans(Poses(JOINTS, PARENTS, hips))[0][1].vertices.astype(np.float64)


@dataclass(frozen=True)
class Run:
    """A template learned at reduced size."""

    seen: int
    unseen: int
    steps: int
    width: int

    def train(self, subject: Subject, samples: FrameSamples, conditions: Tensor) -> OccupancyTemplate:
        torch.manual_seed(0)
        random, body = np.random.default_rng(0), subject.body.vertices
        hands = hand_samples(random, subject.body, 4000)
        centre, radius = (body.min(axis=0) + body.max(axis=0)) / 2, float(np.ptp(body, axis=0).max() / 2)
        network = OccupancyTemplate(centre=centre.tolist(), radius=radius, width=self.width)
        muon = Muon(network.parameters(), lr=0.004, betas=(0.9, 0.999), eps=1e-8, weight_decay=0.0)
        falling = torch.optim.lr_scheduler.CosineAnnealingLR(muon, self.steps)
        for step in range(self.steps):
            if step % _EVERY == 0:
                self.measure(step, network, samples, conditions)
            rows, points = random.choice(self.seen, 4, replace=False), random.choice(samples.inside.shape[1], 700)
            near_hands = torch.from_numpy(random.choice(4000, 300))
            batch = FrameSamples(*(each[:, torch.from_numpy(points)] for each in _some(samples, rows)))
            loss = template_loss(network, batch, conditions[rows], (hands[0][near_hands], hands[1][near_hands]))
            muon.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            muon.step()
            falling.step()
        self.measure(self.steps, network, samples, conditions)
        return network

    def measure(self, step: int, network: OccupancyTemplate, samples: FrameSamples, conditions: Tensor) -> None:
        halves = range(self.seen), range(self.seen, self.seen + self.unseen)
        seen, unseen = (near_surface_iou(network, _some(samples, rows), conditions[list(rows)]) for rows in halves)
        print(f"step {step}: near-surface IoU seen {seen:.3f}, unseen {unseen:.3f}", flush=True)


def template(run: Run, subject: Subject, folder: Path) -> None:
    """Learn, measure and draw a template."""
    folder.mkdir(parents=True, exist_ok=True)
    poses = draw_poses(PoseRecipe(), range(run.seen + run.unseen))
    with timed("field"):
        weights = diffused_skinning(subject.body, margin=0.25)
    samples, conditions = _samples(subject, poses, weights), pose_condition(poses.rotations)
    with timed(f"{run.steps} steps"):
        network = run.train(subject, samples, conditions)
    with timed("surface"):
        made = extract_template(network, plainest_pose(conditions[: run.seen]), weights)
    made.save(folder / f"{subject.outfit}.safetensors")
    measure_template(subject.body, made)
    draw_template(subject, made, poses[run.seen : run.seen + 3], folder / f"{subject.outfit}.png")


def measure_template(body: CanonicalBody, made: Template) -> None:
    """One piece or more, and how far from the body."""
    distance = Solid(made.vertices.numpy(), made.faces.numpy()).depth(body.vertices[~_hands(body)])
    away = 1000 * np.abs(distance)
    print(f"{len(made.vertices)} vertices, Euler characteristic {made.euler_characteristic}")
    print(f"the canonical body without hands lies {away.mean():.1f} mm from it, 95 % {np.percentile(away, 95):.1f} mm")


def draw_template(subject: Subject, made: Template, poses: Poses, path: Path) -> None:
    """The template in the canonical pose from two sides, and skinned into poses beside their scans."""
    still, faces, body = made.vertices.numpy(), made.faces.numpy(), subject.body
    posed = skinned(still, made.weights.numpy(), body.transforms(poses.world(), JOINTS))
    shown = [Panel(Mesh(each, faces), _TEMPLATE) for each in (still, _from_the_side(still), *posed)]
    beside = [Panel(Mesh(each, body.faces), _SCAN) for each in (body.vertices, _from_the_side(body.vertices))]
    beside += [Panel(_joined(scan), _SCAN) for scan in subject.scans(poses)]
    columns = ["canonical", "from the side", *(f"unseen pose {number + 1}" for number in range(len(poses)))]
    rows = [Row("template,\nskinned", shown), Row("body,\nscans", beside)]
    mesh_grid(rows, path, columns=columns, title=f"The template of a person ({subject.outfit})", one_scale=True)


def draw_skinning(path: Path) -> None:
    """Shirt and skirt around a resting person by weights of the nearest vertex of the skin, and by diffused ones."""
    subject = Subject()
    body = subject.body
    resting = subject.scans(Poses(JOINTS, PARENTS, np.zeros((1, len(JOINTS), 3))))[0]
    garment = _joined(resting[1:])
    used, numbers = np.unique(garment.faces, return_inverse=True)
    faces, vertices = numbers.reshape(-1, 3), garment.vertices[used].astype(np.float64)
    rest = subject.resting()
    nearest = rest.weights[cKDTree(rest.vertices).query(vertices)[1]]
    colors, rows = np.random.default_rng(4).uniform(0.15, 0.9, (len(body.names), 3)), []
    for label, weights in (("of the\nnearest\nvertex", nearest), ("diffused", thin_plate(rest).weights(vertices))):
        panels = [_dressed(rest.vertices, vertices, faces, weights @ colors, body.faces)]
        for pose in _postures().values():
            moved = rest.transforms(pose.world(), JOINTS)
            posed = (skinned(its, w, moved)[0] for its, w in ((rest.vertices, rest.weights), (vertices, weights)))
            panels.append(_dressed(*posed, faces, weights @ colors, body.faces))
        rows.append(Row(label, panels))
    title = "A shirt and a skirt on a person's bones; colours are skinning weights"
    mesh_grid(rows, path, columns=["at rest", *_postures()], title=title, one_scale=True, size=(330, 330))


def around_rest() -> None:
    """How far nine tenths of a mesh lie from a person at rest at most, as shares of the person's extent.

    Garments of the outfits at rest, other people at rest, and the person in other poses: what `dsffnet skin` warns by.
    """
    body = Subject().resting()
    solid, extent = Solid(body.vertices, body.faces), float(np.ptp(body.vertices, axis=0).max())

    def say(what: str, vertices: NDArray[np.floating]) -> None:
        print(f"{what}: {np.quantile(np.abs(solid.depth(vertices)), 0.9) / extent:.3f}", flush=True)

    for outfit in OUTFITS:
        resting = Subject(outfit, "skinned").scans(_pose({}))[0]
        for number, part in enumerate(resting[1:], 1):
            say(f"{outfit}, part {number}", part.vertices[np.unique(part.faces)])
    for number in range(6):
        other = _canonical(_anny().draw_identity(generator(99, Stream.IDENTITY, number), number), 0.0).vertices
        say(f"another person, {np.ptp(other, axis=0).max() / extent:.2f} times as large", other)
    lowered = {f"arms lowered by {angle}": _arms(-angle) for angle in (10, 20, 45, 70)}
    bent = _pose({"left_knee": (40, 0, 0), "right_knee": (40, 0, 0)})
    several = draw_poses(PoseRecipe(), range(4))
    drawn = {f"pose {n} of NPT": replace(several, rotations=several.rotations[n : n + 1]) for n in range(4)}
    for what, pose in (lowered | {"knees bent by 40": bent} | _postures() | drawn).items():
        say(what, skinned(body.vertices, body.weights, body.transforms(pose.world(), JOINTS))[0])


def _arms(angle: int) -> Poses:
    return _pose({"left_shoulder": (0, 0, angle), "right_shoulder": (0, 0, -angle)})


def _dressed(
    body: NDArray[np.floating],
    garment: NDArray[np.floating],
    faces: NDArray[np.integer],
    colors: NDArray[np.floating],
    body_faces: NDArray[np.integer],
) -> Panel:
    both = Mesh(np.concatenate([garment, body]), np.concatenate([faces, body_faces + len(garment)]))
    return Panel(both, np.concatenate([colors, np.tile(_SCAN, (len(body), 1))]))


def _from_the_side(vertices: NDArray[np.floating]) -> NDArray[np.floating]:
    return vertices[:, [2, 1, 0]] * (-1, 1, 1)


def _joined(scan: list[Mesh]) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in scan)])
    faces = [mesh.faces + start for mesh, start in zip(scan, starts, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in scan]), np.concatenate(faces))


def _samples(subject: Subject, poses: Poses, weights: SkinningField) -> FrameSamples:
    with timed("scans"):
        scans = subject.scans(poses)
    body, transforms = subject.body, subject.body.transforms(poses.world(), JOINTS)
    frames = []
    with timed("roots and labels"):
        for number, scan in enumerate(scans):
            random, its = np.random.default_rng(number), transforms[number]
            frames.append(frame_samples(random, scan, body=body, field=weights, transforms=its, count=_DRAWN))
    found = FrameSamples(*(torch.stack(each) for each in zip(*frames, strict=True)))
    print(f"no root: {1 - found.valid.any(dim=2).float().mean():.1%} of points, hands counted")
    return found


def _some(samples: FrameSamples, rows: Iterable[int]) -> FrameSamples:
    return FrameSamples(*(each[list(rows)] for each in samples))


def _hands(body: CanonicalBody) -> NDArray[np.bool_]:
    return body.weights[:, body.hands].sum(axis=1) > 0.5


def _transforms(body: CanonicalBody, poses: Poses) -> Tensor:
    return torch.from_numpy(body.transforms(poses.world(), JOINTS)).float()


def _postures() -> dict[str, Poses]:
    lifted = {"left_hip": (-80, 0, 0), "left_knee": (40, 0, 0)}
    knees = {"left_knee": (85, 0, 0), "right_knee": (85, 0, 0)}
    sitting = {"left_hip": (-90, 0, 8), "right_hip": (-90, 0, -8)} | knees
    return {"leg lifted": _pose(lifted), "sitting": _pose(sitting)}


def _pose(turned: dict[str, tuple[int, int, int]]) -> Poses:
    rotations = np.zeros((1, len(JOINTS), 3))
    for joint, turn in turned.items():
        rotations[0, JOINTS.index(joint)] = np.radians(turn)
    return Poses(JOINTS, PARENTS, rotations)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["field", "roots", "template", "skin", "rest"])
    parser.add_argument("folder", nargs="?", metavar="PATH", type=Path, default=Path("build/avatar"))
    parser.add_argument("--centres", type=int, default=2500)
    parser.add_argument("--outfit", default="skirt", help="an outfit, or: bare")
    parser.add_argument("--seen", type=int, default=32)
    parser.add_argument("--unseen", type=int, default=8)
    parser.add_argument("--steps", type=int, default=1250)
    parser.add_argument("--width", type=int, default=128)
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.what == "field":
        field(given.centres)
    elif given.what == "roots":
        roots(4)
    elif given.what == "skin":
        draw_skinning(given.folder)
    elif given.what == "rest":
        around_rest()
    else:
        template(Run(given.seen, given.unseen, given.steps, given.width), Subject(given.outfit), given.folder)
