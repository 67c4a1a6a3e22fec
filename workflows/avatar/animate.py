"""An avatar on its way through poses: one animated GLB, a picture of some frames."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.common.errors import MeshError, RecipeError
from datagen.mesh.files import read_mesh_file
from datagen.mesh.formats.glb_export import built_draft
from datagen.mesh.formats.surface import Material, Surface
from datagen.mesh.geometry import Mesh
from datagen.mesh.limits import FRAME_LIMIT
from datagen.mesh.sequences import frames_of
from datagen.poses import Poses, draw_poses
from datagen.poses.pose_files import read_pose_file
from datagen.recipe import PoseRecipe
from training.avatar.subject import posed_by
from training.inference.pose_reading import read_poses
from training.viz.mesh_grid import Panel, Row, mesh_grid, standing
from workflows.avatar.evaluate import learned_avatar, require_avatar
from workflows.avatar.recipe import load_avatar
from workflows.pipeline.progress import bar
from workflows.pipeline.run_folder import AvatarFolder
from workflows.pretrained import own_weights

_ON_THE_WAY = 12  # frames from one pose to the next
_COLOR = "#C9B458"
_SHOWN = 10


def animate(
    folder: AvatarFolder, outfit: str | None, poses: Poses, out: Path, *, frames_per_second: float, picture: Path | None
) -> None:
    """Write the avatar in an outfit, in poses one after another, as one animated GLB.

    Parameters
    ----------
    outfit
        Its name; None where there is one.
    poses
        Over any joints: those that a body does not have follow their parents.
    picture
        A PNG of ten of the frames; None: none.

    Raises
    ------
    RecipeError
        There is no such outfit.
    MeshError
        More than 2,000 poses, or ``out`` is no .glb.
    CheckpointError
        The avatar was not trained yet.
    """
    if out.suffix.lower() != ".glb":
        raise MeshError(f"{out}: an animation is a .glb file, not {out.suffix!r}")
    if len(poses) > FRAME_LIMIT:
        raise MeshError(f"{len(poses):,} poses are more than {FRAME_LIMIT:,}: an animated GLB of so many plays nowhere")
    wardrobe, network = learned_avatar(folder)
    number = _number([subject.name for subject in wardrobe.subjects], outfit, folder)
    subject, faces = wardrobe.subjects[number], wardrobe.templates[number].faces.numpy()
    driven = [name for name in subject.body.drivers if name]
    if not set(driven) & set(poses.joints):
        raise RecipeError(
            f"the poses turn {', '.join(poses.joints[:3])}, ..., none of which {subject.name} has "
            f"({', '.join(driven[:3])}, ...). Give poses over its joints: --poses FILE.npz"
        )
    transforms = posed_by(subject.body, poses.rotations, poses.joints, poses.parents)
    kept = set(np.linspace(0, len(poses) - 1, _SHOWN).astype(int).tolist())
    shown = dict[int, NDArray[np.float64]]()

    def frames() -> Iterator[NDArray[np.float64]]:
        posed = wardrobe.animated(network, number, transforms)
        for frame, its in enumerate(bar(posed, total=len(poses), what="animate", unit="frame")):
            vertices = np.asarray(its.mesh.vertices, np.float64)
            if frame in kept:
                shown[frame] = vertices
            yield vertices

    count = len(wardrobe.templates[number].vertices)
    draft, _ = built_draft(_surface(faces, subject.name), count, subject.name)
    draft.animated(frames(), out, frames_per_second=frames_per_second)
    if picture:
        panels = [Panel(Mesh(standing(shown[place]), faces), to_rgb(_COLOR), f"frame {place}") for place in shown]
        half = (len(panels) + 1) // 2
        rows = [Row("", panels[start : start + half]) for start in range(0, len(panels), half)]
        mesh_grid(rows, picture, columns=[""] * half, title=subject.name)


def poses_of(folder: AvatarFolder, file: Path | None, source: Path | None = None, *, count: int, seed: int) -> Poses:
    """The poses of a file, or those that people are in, or a walk through random ones that the avatar learned from.

    ``source``: a mesh, a folder or a pattern of frames; poses are read off them by the weights ``human`` or
    ``dressed``, whichever read the first one best.

    Raises
    ------
    RecipeError
        The file holds no poses; the folder holds no recipe; both are named.
    MeshError
        A mesh cannot be read, or is no person.
    """
    require_avatar(folder)
    if file and source:
        raise RecipeError("--poses and --source both say what to play: name one")
    if file:
        return read_pose_file(file)
    if source:
        files = [source] if source.is_file() else frames_of(source)
        meshes = (read_mesh_file(each).mesh for each in bar(files, total=len(files), what="read poses", unit="mesh"))
        return Poses(*read_poses([own_weights("human"), own_weights("dressed")], meshes))
    data = load_avatar(str(folder.recipe)).data
    recipe = data.poses if data else PoseRecipe()
    drawn = draw_poses(PoseRecipe(distribution=recipe.distribution, seed=recipe.seed + 1 + seed), range(count))
    return Poses(drawn.joints, drawn.parents, _walk(drawn.rotations))


def _walk(stations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotations [frame, joint, 3] on the way from each station [station, joint, 3] to the next."""
    shape, ends = stations.shape[1:], [Rotation.from_rotvec(its) for its in stations]
    found = [stations[0]]
    for begin, end in pairwise(ends):
        for step in range(1, _ON_THE_WAY + 1):
            share = step / _ON_THE_WAY
            moment = begin * (begin.inv() * end) ** (share * share * (3 - 2 * share))
            found.append(moment.as_rotvec().reshape(shape))
    return np.stack(found)


def _number(names: list[str], outfit: str | None, folder: AvatarFolder) -> int:
    if outfit in names:
        return names.index(outfit)
    if outfit is None and len(names) == 1:
        return 0
    asked = "choose one of them with --outfit" if outfit is None else f"there is no outfit {outfit!r} in it"
    raise RecipeError(f"{folder.path} has the outfits {', '.join(names)}: {asked}")


def _surface(faces: NDArray[np.int64], name: str) -> Surface:
    red, green, blue = to_rgb(_COLOR)
    corners = faces.ravel().astype(np.int64)
    material = Material(name, (red, green, blue, 1.0))
    of = np.zeros(len(faces), np.int64)
    return Surface(corners, np.full(len(faces), 3), material_of=of, materials=(material,))
