"""From a dataset of dressed people, or files of scans, to the folders of outfits: body, scans, field, points."""

import logging
from collections.abc import Iterator, Sequence
from itertools import chain, count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from datagen.bodies import load_body
from datagen.bodies.clothed.model import ClothedModel
from datagen.common.errors import BodyError, CheckpointError, RecipeError, UnsafeFileError
from datagen.common.seeding import Stream, generator
from datagen.mesh.geometry import Mesh
from datagen.poses import Poses
from datagen.recipe import ClothedBody
from datagen.store import Dataset, open_dataset
from training.avatar.body import canonical_body
from training.avatar.diffusion import SkinningField, diffused_skinning
from training.avatar.occupancy import HIDDEN_DEPTH, FrameSamples, frame_samples, hand_samples, surface_points
from training.avatar.outfit import OccupancySamples, Outfit, SurfaceSamples
from training.avatar.solid import Solid
from training.avatar.subject import Subject, posed_by
from training.avatar.template import pose_condition
from training.checkpoints.weights import read_header
from workflows.avatar.person_file import person_source, read_person
from workflows.avatar.recipe import AvatarWorkflow, FieldRecipe, ScanRecipe
from workflows.pipeline.progress import bar
from workflows.pipeline.run_folder import AvatarFolder
from workflows.pipeline.tasks import TaskRunner

log = logging.getLogger(__name__)

MADE = ("subject", "field", "samples", "surfaces")
"""What is made of an outfit before its template is learned, by the names of :class:`training.avatar.outfit.Outfit`."""
_HAND_POINTS = 5_000


def make_outfits(recipe: AvatarWorkflow, folder: AvatarFolder, tasks: TaskRunner) -> None:
    """Make the folders of all outfits; a file that is there already was finished, and is kept."""
    for subject in _subjects(recipe, folder):
        outfit = Outfit(folder.outfits / subject.name)
        if not is_of(outfit, subject.source):
            for name in MADE:
                getattr(outfit, name).path.unlink(missing_ok=True)
            subject.save(outfit.subject.path)
        if not outfit.field.is_sound:
            _field(recipe.field, subject).save(outfit.field.path)
        if not (outfit.samples.is_sound and outfit.surfaces.is_sound):
            draw_points(recipe.scans, outfit, subject, tasks)


def sources(recipe: AvatarWorkflow, folder: AvatarFolder) -> dict[str, str]:
    """The outfits of a recipe by name, and where the scans of each are from (:class:`Subject`)."""
    if recipe.people:
        return {path.stem: _source(path, Outfit(folder.outfits / path.stem)) for path in map(Path, recipe.people)}
    dataset = open_dataset(folder.data)
    return dict.fromkeys(wearers(dataset), dataset.uuid)


def _subjects(recipe: AvatarWorkflow, folder: AvatarFolder) -> Iterator[Subject]:
    if not recipe.people:
        yield from subjects_of(open_dataset(folder.data))
        return
    for path in bar([Path(its) for its in recipe.people], total=len(recipe.people), what="read scans", unit="file"):
        outfit = Outfit(folder.outfits / path.stem)
        yield outfit.subject.load() if is_of(outfit, _source(path, outfit)) else read_person(path)


def require_people(recipe: AvatarWorkflow, folder: AvatarFolder, *, fresh: bool) -> None:
    """Refuse files of scans that cannot be learned from, before anything is made, or removed for a ``fresh`` start.

    Raises
    ------
    RecipeError
        A file is missing, is no such file, has other joints than the first, too few scans, or is not the one that the
        folder's outfit was made of.
    """
    joints: list[Sequence[str]] = []
    for path in map(Path, recipe.people):
        outfit = Outfit(folder.outfits / path.stem)
        kept = None if fresh else _header(outfit)
        if kept and kept["source"] != _source(path, outfit):
            raise RecipeError(
                f"{path} is not the file that {outfit.path} was made of. Put that one back, choose another --out, or "
                "add --fresh to start over"
            )
        subject = None if kept else read_person(path)
        joints.append(tuple(kept["bones"]["names"]) if kept else subject.body.names if subject else ())
        if joints[-1] != joints[0]:
            raise RecipeError(
                f"{path} has other joints than {recipe.people[0]}: people that are learned together have the same ones"
            )
        if subject and len(subject.seen) < recipe.template.batch:
            raise RecipeError(
                f"{path} has {len(subject.seen)} scans to learn from, fewer than template.batch, "
                f"{recipe.template.batch}. Lower that by --set template.batch={len(subject.seen)}"
            )


def _source(path: Path, outfit: Outfit) -> str:
    """What a file of scans is known by; of one that is gone, as the outfit that was made of it says."""
    kept = None if path.is_file() else _header(outfit)
    return kept["source"] if kept else person_source(path)


def is_of(outfit: Outfit, source: str) -> bool:
    """Whether an outfit's scans are there, whole, and from a source."""
    kept = _header(outfit)
    return kept is not None and bool(kept.get("source") == source)


def _header(outfit: Outfit) -> Any:
    """What the file of an outfit's scans says of itself; None where there is none, or it is damaged."""
    try:
        return read_header(outfit.subject.path)
    except (CheckpointError, UnsafeFileError):
        return None


def subjects_of(dataset: Dataset) -> Iterator[Subject]:
    """The people of a dataset's evaluation split, by the names of :func:`wearers`."""
    body = load_body(dataset.recipe.body)
    assert isinstance(body, ClothedModel)
    joints, parents = tuple(dataset.attributes["joints"]), tuple(dataset.attributes["joint_parents"])
    for name, identity in wearers(dataset).items():
        rig, vertices, faces = body.undressed(dataset.parameters(identity), joints)
        canonical = canonical_body(rig, vertices, faces, joints, parents)
        poses = dataset.grid.poses_of(identity)
        rotations, labels = dataset.rotations()[poses], dataset.part(identity)
        assert labels is not None
        yield Subject(
            name=name,
            source=dataset.uuid,
            body=canonical,
            scans=np.asarray(dataset.vertices(identity, poses), np.float32),
            faces=dataset.faces(identity).astype(np.int64),
            parts=labels.astype(np.int64),
            transforms=posed_by(canonical, rotations, joints, parents),
            rotations=rotations.astype(np.float32),
            is_seen=np.isin(poses, dataset.grid.poses("seen")),
        )


def wearers(dataset: Dataset) -> dict[str, int]:
    """The identities of the evaluation split, each by the name of the outfit; a second one in it gets a number."""
    recipe, found = dataset.recipe.body, dict[str, int]()
    assert isinstance(recipe, ClothedBody)
    for identity in dataset.identities("evaluation"):
        outfit = recipe.outfits[int(dataset.parameters(identity)[-2])]
        numbered = (f"{outfit}-{number}" for number in count(2))
        found[next(name for name in chain([outfit], numbered) if name not in found)] = identity
    return found


def can_be_draped_again(dataset: Dataset) -> bool:
    """Whether the clothes of a dataset's people are simulated, and as they would be now by the body's assets."""
    body = dataset.recipe.body
    if not isinstance(body, ClothedBody) or body.method != "draped":
        return False
    stored = {(its["name"], its["version"]) for its in dataset.attributes["body"]["assets"]}
    try:
        changed = {(its.name, its.version) for its in load_body(body).assets} - stored
    except BodyError as error:  # a garment's file is gone, say
        changed = {(str(error), "")}
    if changed:
        log.warning(
            "%s is draped otherwise now: no row of the simulation's own error (%s)", dataset.url, sorted(changed)
        )
    return not changed


def draped_finer(dataset: Dataset, identity: int, frames: Sequence[int]) -> NDArray[np.float32]:
    """Scans [frame, vertex, 3] of an identity by twice as many stations, steps at each, and steps to settle.

    How far these are from the dataset's is the simulation's own error, which no avatar can be judged below.
    """
    recipe = dataset.recipe.body
    assert isinstance(recipe, ClothedBody)
    steps = {name: 2 * getattr(recipe.solver, name) for name in ("frames", "substeps", "settle")}
    finer = load_body(recipe.model_copy(update={"solver": recipe.solver.model_copy(update=steps)}))
    rotations = dataset.rotations()[dataset.grid.poses_of(identity)[list(frames)]]
    joints, parents = tuple(dataset.attributes["joints"]), tuple(dataset.attributes["joint_parents"])
    return finer.vertices(dataset.parameters(identity), Poses(joints, parents, rotations))


def _field(recipe: FieldRecipe, subject: Subject) -> SkinningField:
    what = f"field of {subject.name}"

    def progress(points: range) -> Iterator[int]:
        yield from bar(points, total=len(points), what=what, unit="block")

    return diffused_skinning(subject.body, **recipe.model_dump(), progress=progress)


def draw_points(recipe: ScanRecipe, outfit: Outfit, subject: Subject, tasks: TaskRunner) -> None:
    """Write the points of all scans of an outfit whose body, scans and field are there."""
    frames = len(subject.scans)
    arguments = [(str(outfit.path), frame, recipe.around, recipe.surface) for frame in range(frames)]
    found: list[DrawnFrame] = list(
        bar(
            tasks.frames(draw_frame, arguments, what=f"points of {outfit.name}"),
            total=frames,
            what=f"points of {outfit.name}",
            unit="scan",
        )
    )
    found.sort(key=lambda drawn: drawn.frame)  # tasks end in any order
    _, around, points, normals = zip(*found, strict=True)
    least = min(len(its) for its in points)
    SurfaceSamples(*(torch.stack([its[:least] for its in each]) for each in (points, normals))).save(
        outfit.surfaces.path
    )
    samples = FrameSamples(*(torch.stack(each) for each in zip(*around, strict=True)))
    hands, inside = hand_samples(generator(0, Stream.AUGMENTATION), subject.body, _HAND_POINTS)
    OccupancySamples(
        **samples._asdict(),
        conditions=pose_condition(subject.rotations.astype(np.float64)),
        is_seen=torch.from_numpy(subject.is_seen),
        hand_points=hands,
        hand_inside=inside,
    ).save(outfit.samples.path)


class DrawnFrame(NamedTuple):
    """Points around the scan of a frame, and points [n, 3] with normals [n, 3] of its outer surface."""

    frame: int
    around: FrameSamples
    points: torch.Tensor
    normals: torch.Tensor


def draw_frame(place: str, frame: int, around: int, surface: int) -> DrawnFrame:
    """Draw the points of a frame, a function of the outfit and the frame; a task."""
    outfit = Outfit(Path(place))
    subject, random = outfit.subject.load(), generator(0, Stream.AUGMENTATION, frame + 1)
    scan = solid_parts(subject, frame)
    transforms = subject.transforms[frame].astype(np.float64)
    samples = frame_samples(
        random, scan, body=subject.body, field=outfit.field.load(), transforms=transforms, count=around
    )
    points, normals = surface_points(random, scan, surface)
    return DrawnFrame(frame, samples, torch.from_numpy(points).float(), torch.from_numpy(normals).float())


def solid_parts(subject: Subject, frame: int) -> list[Mesh]:
    """A scan as the posed body and the parts of the outfit, each a mesh of its own."""
    garments = [_part(subject, frame, part) for part in range(1, int(subject.parts.max()) + 1)]
    return [subject.posed(frame), *garments]


def _part(subject: Subject, frame: int, part: int) -> Mesh:
    own: NDArray[Any] = np.flatnonzero(subject.parts == part)
    faces = subject.faces[(subject.parts[subject.faces] == part).all(axis=1)]
    return Mesh(subject.scans[frame][own].astype(np.float64), np.searchsorted(own, faces))


def outer_scan(subject: Subject, frame: int) -> Mesh:
    """A scan's mesh without triangles that lie deeper than 4 mm within another part, as those of legs in a skirt."""
    scan, owner = subject.scan(frame), subject.parts[subject.faces[:, 0]]
    middles = scan.vertices[scan.faces].mean(axis=1)
    hidden = np.zeros(len(owner), bool)
    for part, mesh in enumerate(solid_parts(subject, frame)):
        others = np.flatnonzero(owner != part)
        hidden[others] |= Solid(mesh.vertices, mesh.faces).depth(middles[others]) > HIDDEN_DEPTH
    return Mesh(scan.vertices, scan.faces[~hidden])
