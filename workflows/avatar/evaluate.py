"""What an avatar reaches on seen and unseen poses: a table of its stages and of what does without it, and pictures."""

import csv
import io
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import nn

from datagen.common.arrays import Floats
from datagen.common.errors import CheckpointError, RecipeError
from datagen.common.files import write_atomically
from datagen.mesh.geometry import Mesh, vertex_normals
from datagen.mesh.parts import part_colors, part_name
from datagen.mesh.rig import skinned
from datagen.store import Dataset, open_dataset
from training.avatar.metrics import Footprints, Surface, score
from training.avatar.outfit import outfits_in
from training.avatar.subject import Subject
from training.avatar.wardrobe import Posed, Wardrobe
from training.checkpoints.checkpoint import recipe_of, require_checkpoint
from training.recipes.networks import AvatarRecipe
from training.tracking.record import update_record
from training.viz.mesh_grid import Panel, Row, mesh_grid, standing
from training.viz.style import error_colors
from workflows.avatar.outfits import can_be_draped_again, draped_finer, outer_scan, wearers
from workflows.avatar.recipe import AvatarEvaluation, AvatarWorkflow
from workflows.avatar.runs import trained
from workflows.pipeline.progress import bar
from workflows.pipeline.run_folder import AvatarFolder
from workflows.pipeline.stage import recorded

KINDS = ("seen", "unseen")
COLUMNS = {
    "scan_to_model": "scan to model", "model_to_scan": "model to scan", "plane": "to plane", "normal_angle": "normals",
    "hausdorff": "Hausdorff", "chamfer": "Chamfer, 1e-5", "cosine": "cosine", "corresponding": "corresponding",
}  # fmt: skip
_DISTANCES = ("scan_to_model", "model_to_scan", "plane", "normal_angle")
_AVATAR, _CORRECTED, _SKINNED = "avatar", "template + correction", "template + skinning"
_FLOOR = "simulation, finer steps"
_ERROR_LIMIT = 0.03  # metres, at the dark end of the pictures' error colours
_USUAL = 16  # seen poses that the mean displacement is a mean over


_Meshed = tuple[Mesh, Floats]
"""A mesh, and normals at its vertices."""


@dataclass(frozen=True)
class Measured:
    """A method on an outfit and a kind of poses: the means over frames by column, and by part of the scan."""

    outfit: str
    kind: str
    method: str
    values: Mapping[str, float]
    parts: Mapping[int, Mapping[str, float]]


def evaluate_avatar(given: AvatarWorkflow, folder: AvatarFolder) -> None:
    """Measure and draw an avatar that was learned, and record it: tables.md, rows.csv, figures/examples.png."""
    recipe, out = given.evaluation, folder.evaluation
    parameters = recipe.model_dump(mode="json")
    with recorded(out.path, kind="evaluate", name="evaluate", parent=folder.path, parameters=parameters):
        wardrobe, network = learned_avatar(folder)
        dataset = open_dataset(folder.data) if given.data else None
        rows = list(_measured(recipe, wardrobe, network, dataset))
        write_atomically(out.rows, _csv(rows).encode())
        _draw(recipe, wardrobe, network, out.examples)
        write_atomically(out.tables, markdown(rows).encode())
        shown = ["tables.md", "rows.csv", "figures"]
        metrics = {f"plane_{row.kind}/{row.outfit}": row.values["plane"] for row in rows if row.method == _AVATAR}
        update_record(out.path, artifacts=shown, metrics=metrics)
        shown = [f"{out.path.name}/{name}" for name in shown]
        update_record(folder.path, metrics=metrics, artifacts=["recipe.yaml", *shown])


def require_avatar(folder: AvatarFolder) -> None:
    """Refuse a folder that holds no recipe of an avatar (RecipeError)."""
    folder.require_kind()
    if not folder.recipe.exists():
        raise RecipeError(
            f"{folder.path} is no folder of an avatar. Make one: dsffnet avatar train --out {folder.path}"
        )


def learned_avatar(folder: AvatarFolder) -> tuple[Wardrobe, nn.Module]:
    """The outfits of a folder, and the network that was trained on them.

    Raises
    ------
    CheckpointError
        It was not trained yet, or a file is damaged.
    """
    recipe = recipe_of(require_checkpoint(folder.run.path, "result"))
    if not isinstance(recipe.network, AvatarRecipe):
        raise CheckpointError(f"{folder.run.path} holds weights of {recipe.network.name!r}, not of an avatar")
    wardrobe = Wardrobe.of(outfits_in(folder.outfits), recipe.network)
    return wardrobe, trained(recipe, folder.outfits, folder.run, section="avatar")


def _measured(
    recipe: AvatarEvaluation, wardrobe: Wardrobe, network: nn.Module, dataset: Dataset | None
) -> Iterator[Measured]:
    frames = {
        (number, kind): list(getattr(subject, kind))[: recipe.frames]
        for number, subject in enumerate(wardrobe.subjects)
        for kind in KINDS
    }
    usual = [_usual_displacement(wardrobe, network, number) for number in range(len(wardrobe.subjects))]
    again = dataset is not None and can_be_draped_again(dataset)
    plainest = [_plainest(subject) for subject in wardrobe.subjects]
    marked = [_footprints(wardrobe, network, number, plainest[number], its) for number, its in enumerate(usual)]
    with bar(total=sum(len(its) for its in frames.values()), what="evaluate", unit="frame") as shown:
        for (number, kind), its in frames.items():
            subject, footprints = wardrobe.subjects[number], marked[number]
            scores: dict[str, list[Any]] = defaultdict(list)
            away: dict[str, list[float]] = defaultdict(list)
            for frame in its:
                scan = outer_scan(subject, frame)
                meshes = _methods(wardrobe, network, number, frame, usual[number])
                if dataset and kind == "unseen" and again:
                    meshes[_FLOOR], footprints[_FLOOR] = _draped_again(dataset, subject, frame, scan)
                for method, (mesh, normals) in meshes.items():
                    found = score(mesh, normals, scan, samples=recipe.samples, parts=subject.parts)
                    scores[method].append(found)
                    if frame != plainest[number]:
                        away[method].append(1000 * footprints[method].distances(mesh.vertices, scan.vertices).mean())
                shown.update()
            for method, its_scores in scores.items():
                yield _means(
                    subject.name, kind, method, its_scores, corresponding=float(np.mean(away[method] or np.nan))
                )


def _plainest(subject: Subject) -> int:
    """The seen pose that turns joints least."""
    turned = np.abs(subject.rotations[:, 1:]).sum(axis=(1, 2))
    return min(subject.seen, key=lambda frame: float(turned[frame]))


def _footprints(
    wardrobe: Wardrobe, network: nn.Module, number: int, plainest: int, usual: Floats
) -> dict[str, Footprints]:
    """Where on the cloth the vertices of each method lie in the plainest pose, which itself says nothing of sliding."""
    scan = outer_scan(wardrobe.subjects[number], plainest)
    meshes = _methods(wardrobe, network, number, plainest, usual)
    return {method: Footprints.of(mesh.vertices, scan) for method, (mesh, _) in meshes.items()}


def _draped_again(dataset: Dataset, subject: Subject, frame: int, scan: Mesh) -> tuple[_Meshed, Footprints]:
    """What the simulation says by finer steps, without what is hidden in the scan; its vertices are the scan's."""
    (finer,) = draped_finer(dataset, wearers(dataset)[subject.name], [frame])
    kept, faces = np.unique(scan.faces, return_inverse=True)
    mesh = Mesh(finer[kept].astype(np.float64), faces.reshape(-1, 3))
    own = Footprints(np.repeat(kept[:, None], 3, axis=1), np.tile([1.0, 0, 0], (len(kept), 1)))
    return (mesh, vertex_normals(mesh.vertices, mesh.faces)), own


def _methods(wardrobe: Wardrobe, network: nn.Module, number: int, frame: int, usual: Floats) -> dict[str, _Meshed]:
    """What each method makes of a frame: a mesh, and normals at its vertices."""
    subject = wardrobe.subjects[number]
    transforms = subject.transforms[frame].astype(np.float64)
    (posed,) = wardrobe.posed(network, [(number, frame)])
    bare = skinned(subject.body.vertices, subject.body.weights, transforms[None])[0]
    displaced = {"mean displacement": usual}
    for near in wardrobe.posed(network, [(number, its) for its in _nearest_seen(wardrobe, number, frame)]):
        displaced["nearest training pose"] = _canonical(wardrobe, number, near)
    meshes = {
        "minimal body": Mesh(bare, subject.body.faces),
        _SKINNED: wardrobe.surface(number, posed.skinned),
        _CORRECTED: wardrobe.surface(number, posed.corrected),
    }
    turn = _blended(wardrobe, number, transforms)
    for name, by in displaced.items():
        meshes[name] = wardrobe.surface(number, posed.corrected + (turn @ by[..., None])[..., 0])
    found: dict[str, _Meshed] = {
        name: (mesh, vertex_normals(mesh.vertices, mesh.faces)) for name, mesh in meshes.items()
    }
    return found | {_AVATAR: (posed.mesh, posed.normals)}


def _usual_displacement(wardrobe: Wardrobe, network: nn.Module, number: int) -> NDArray[np.float64]:
    """The mean over seen poses of the avatar's displacements [n, 3], in the canonical pose."""
    rows = [(number, frame) for frame in wardrobe.subjects[number].seen[:_USUAL]]
    found = [_canonical(wardrobe, number, its) for its in wardrobe.posed(network, rows)]
    return np.asarray(np.mean(found, axis=0), np.float64)


def _canonical(wardrobe: Wardrobe, number: int, posed: Posed) -> NDArray[np.float64]:
    """An avatar's displacements [n, 3] turned back to the canonical pose."""
    displacements = posed.points - posed.corrected
    return np.asarray(np.linalg.solve(_blended(wardrobe, number, posed.transforms), displacements[..., None])[..., 0])


def _blended(wardrobe: Wardrobe, number: int, transforms: Floats) -> NDArray[np.float64]:
    """How each point [n, 3, 3] of a template is turned."""
    weights = wardrobe.templates[number].weights.double().numpy()
    turns = np.asarray(transforms, np.float64)[..., :3].reshape(len(transforms), 9)
    return np.asarray((weights @ turns).reshape(-1, 3, 3))


def _nearest_seen(wardrobe: Wardrobe, number: int, frame: int) -> list[int]:
    """The seen frame, another one, whose joints' rotations are nearest on the whole; none where it is the only one."""
    subject = wardrobe.subjects[number]
    others = [each for each in subject.seen if each != frame]
    turns = Rotation.from_rotvec(subject.rotations[:, 1:].reshape(-1, 3)).as_matrix()
    turns = turns.reshape(len(subject.rotations), -1)
    away = ((turns[others] - turns[frame]) ** 2).sum(axis=1)
    return [others[place] for place in away.argsort(kind="stable")[:1]]


def _means(outfit: str, kind: str, method: str, scores: list[Any], *, corresponding: float) -> Measured:
    measured = [name for name in COLUMNS if name != "corresponding"]
    values = {name: float(np.mean([getattr(its, name) for its in scores])) for name in measured}
    values["corresponding"] = corresponding
    parts = sorted({part for its in scores for part in its.parts})
    by_part = {}
    for part in parts:
        means = np.nanmean([its.parts[part] for its in scores if part in its.parts], axis=0)
        by_part[part] = dict(zip(_DISTANCES, means.tolist(), strict=True))
    return Measured(outfit, kind, method, values, by_part)


def markdown(rows: list[Measured]) -> str:
    """Tables for people: one an outfit, and one of the avatar by part."""
    lines = [
        "# What the avatar reaches",
        "",
        "Means over poses. Millimetres, but normals in degrees; Chamfer and cosine as FITE's released "
        "code defines them (half sums, over the diagonal of the box). Corresponding: how far vertices are from the "
        "places on the cloth that they lie on in the plainest seen pose. Surfaces of the template are smoothed where a "
        "pose tears it.",
    ]
    if any(row.method == _FLOOR for row in rows):
        lines[-1] += (
            " The last row of unseen poses is the simulation's own error: the same poses draped by twice as many "
            "stations and steps."
        )
    for outfit in dict.fromkeys(row.outfit for row in rows):
        own = [row for row in rows if row.outfit == outfit]
        lines += ["", f"## {outfit}", "", *_head(["poses", "method"], list(COLUMNS.values()))]
        lines += [_line(row.kind, row.method, row.values) for row in own]
        lines += ["", *_head(["poses", "part"], [COLUMNS[name] for name in _DISTANCES])]
        for row in own:
            if row.method == _AVATAR:
                lines += [_line(row.kind, part_name(part), its) for part, its in row.parts.items()]
    return "\n".join([*lines, ""])


def _head(words: list[str], numbers: list[str]) -> list[str]:
    return [f"| {' | '.join([*words, *numbers])} |", "|" + "---|" * len(words) + "---:|" * len(numbers)]


def _line(kind: str, what: str, values: Mapping[str, float]) -> str:
    shown = {"chamfer": lambda value: f"{1e5 * value:.1f}", "cosine": lambda value: f"{value:.3f}"}
    words = [shown.get(name, lambda value: f"{value:.1f}")(value) for name, value in values.items()]
    return f"| {kind} | {what} | {' | '.join(words)} |"


def _csv(rows: list[Measured]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["outfit", "poses", "method", "part", *COLUMNS])
    for row in rows:
        writer.writerow([row.outfit, row.kind, row.method, "all", *row.values.values()])
        for part, its in row.parts.items():
            own = [its.get(name, "") for name in COLUMNS]
            writer.writerow([row.outfit, row.kind, row.method, part_name(part), *own])
    return text.getvalue()


def _draw(recipe: AvatarEvaluation, wardrobe: Wardrobe, network: nn.Module, path: Path) -> None:
    """Unseen poses (seen ones where there are no others): scan, template, avatar, and how far that is from the scan."""
    rows = list[Row]()
    for number, subject in enumerate(wardrobe.subjects):
        for frame in (subject.unseen or subject.seen)[: recipe.examples]:
            (posed,) = wardrobe.posed(network, [(number, frame)])
            rows.append(Row(subject.name, _panels(wardrobe, number, frame, posed)))
    columns = ["scan", _SKINNED, _AVATAR, f"error, dark: {100 * _ERROR_LIMIT:g} cm"]
    is_new = all(subject.unseen for subject in wardrobe.subjects)
    title = "Poses that were not learned from" if is_new else "Poses, of some outfits learned from"
    mesh_grid(rows, path, columns=columns, title=title, one_scale=False, size=(260, 290))


def _panels(wardrobe: Wardrobe, number: int, frame: int, posed: Posed) -> list[Panel | str]:
    subject, faces = wardrobe.subjects[number], posed.mesh.faces
    scan, plain = subject.scan(frame), to_rgb("#C9B458")
    away = Surface.sampled(outer_scan(subject, frame), 20_000).distances(posed.mesh.vertices)
    avatar = Mesh(standing(posed.mesh.vertices), faces)
    return [
        Panel(Mesh(standing(scan.vertices), scan.faces), part_colors(subject.parts) / 255),
        Panel(Mesh(standing(wardrobe.surface(number, posed.skinned).vertices), faces), plain),
        Panel(avatar, plain),
        Panel(avatar, error_colors(away, _ERROR_LIMIT), f"mean {1000 * away.mean():.1f} mm"),
    ]
