"""Scans of one's own: a .npz file of registered meshes, the body below them, and its poses, as a subject."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from datagen.common.errors import RecipeError, reason_of
from datagen.common.files import sha256_of
from datagen.common.npz import FAULTS, read_arrays
from datagen.mesh.rig import Rig
from datagen.poses import Poses
from datagen.poses.pose_files import read_pose_file
from training.avatar.body import CanonicalBody, canonical_body
from training.avatar.subject import Subject, posed_by

_LARGEST_GAP = 0.1
"""Metres: half of a body's vertices lie nearer to its scan, or one of the two is another person's, pose's or unit's."""
_CHECKED = 5  # scans of each file that are held against the body
_UNSEEN = 7  # one scan of so many is not learned from, where the file does not say which: the last ones
_DOCUMENTED = "docs/avatar.md says what such a file holds"
_SHAPES: dict[str, tuple[str, str]] = {
    "scans": ("fiu", "frame v 3"), "faces": ("iu", "f 3"), "parts": ("iu", "v"), "seen": ("b", "frame"),
    "translations": ("fiu", "frame 3"), "body_vertices": ("fiu", "b 3"), "body_faces": ("iu", "g 3"),
    "body_weights": ("fiu", "b joint"), "body_joints": ("fiu", "joint 3"),
}  # fmt: skip
_OPTIONAL = {"parts", "seen", "translations"}


def read_person(path: Path) -> Subject:
    """Read scans of a person in one outfit, named after the file.

    Where the person stands and which way they face says nothing about how the clothes lie, so both are undone: the root
    joint of every scan is in its place, turned as at rest.

    Parameters
    ----------
    path
        A .npz of arrays, lengths in metres, the body at rest Y up and facing +Z:

        ======================  =====================  ==============================================================
        ``scans``               [frame, v, 3]          vertices of each scan; those of one number correspond
        ``faces``               [f, 3]                 triangles of the scans, which look outwards
        ``poses``               [frame, joint, 3]      axis-angle in radians, relative to the parent
        ``joints``, ``parents``  [joint]               names and parents; without parents where the names are SMPL's
        ``translations``        [frame, 3]             of the root joint from its place at rest (default 0)
        ``body_vertices``       [b, 3]                 the body without clothes, at rest
        ``body_faces``          [g, 3]                 its triangles
        ``body_weights``        [b, joint]             its skinning weights; those of a vertex sum to one
        ``body_joints``         [joint, 3]             places at rest about which the joints turn
        ``parts``               [v]                    0 skin that is the body's own, from 1 on layers of cloth (1)
        ``seen``                [frame]                which scans are learned from (all but the last seventh)
        ======================  =====================  ==============================================================

    Raises
    ------
    RecipeError
        It is no such file, or the body is not where the scans are.
    """
    source, poses = person_source(path), read_pose_file(path)
    arrays = _arrays(path, poses)
    scans, places = arrays["scans"].astype(np.float64), arrays["body_joints"].astype(np.float64)
    upright, rotations = _at_home(scans, poses, places[0], arrays.get("translations"))
    body = _body(arrays, poses)
    transforms = posed_by(body, rotations, poses.joints, poses.parents)
    found = Subject(
        name=path.stem,
        source=source,
        body=body,
        scans=upright.astype(np.float32),
        faces=arrays["faces"].astype(np.int64),
        parts=arrays.get("parts", np.ones(scans.shape[1])).astype(np.int64),
        transforms=transforms,
        rotations=rotations.astype(np.float32),
        is_seen=arrays.get("seen", np.arange(len(scans)) < len(scans) - max(1, len(scans) // _UNSEEN)),
    )
    _require_near(path, found)
    return found


def person_source(path: Path) -> str:
    """The sha256 of a file of scans (RecipeError where there is none)."""
    if not path.is_file():
        raise RecipeError(f"no file of scans at {str(path)!r}. {_DOCUMENTED}")
    return sha256_of(path)


def _arrays(path: Path, poses: Poses) -> dict[str, NDArray[Any]]:
    """The arrays of the file but for the poses; what cannot be is refused."""
    try:
        arrays = read_arrays(path, tuple(_SHAPES))
    except FAULTS as error:
        raise RecipeError(f"{path} is no .npz file of plain arrays ({reason_of(error)}). {_DOCUMENTED}") from error
    sizes = {"frame": len(poses), "joint": len(poses.joints)}
    for name, (kinds, axes) in _SHAPES.items():
        if name in arrays:
            _require_shape(path, name, arrays[name], kinds, axes.split(), sizes)
        elif name not in _OPTIONAL:
            raise RecipeError(f"{path} has no array {name!r}. {_DOCUMENTED}")
    _require_values(path, arrays, poses)
    return arrays


def _require_shape(
    path: Path, name: str, array: NDArray[Any], kinds: str, axes: list[str], sizes: dict[str, int]
) -> None:
    """``sizes``: of the axes so far, to which an array adds those that it is the first to have."""
    fits = array.dtype.kind in kinds and array.ndim == len(axes) and array.size > 0
    for axis, length in zip(axes, array.shape, strict=False):
        wanted = int(axis) if axis.isdigit() else sizes.setdefault(axis, length)
        fits = fits and length == wanted
    if not fits:
        shape = ", ".join(str(sizes.get(axis, axis)) for axis in axes)
        kind = {"b": "true or false", "iu": "whole numbers", "fiu": "numbers"}[kinds]
        raise RecipeError(
            f"{path}: {name!r} has shape {list(array.shape)} and type {array.dtype}; it must be {kind} [{shape}], "
            f"which is [{', '.join(axes)}]. {_DOCUMENTED}"
        )


def _require_values(path: Path, arrays: dict[str, NDArray[Any]], poses: Poses) -> None:
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise RecipeError(f"{path}: {name!r} holds what is no finite number. Leave such scans out")
    for faces, vertices in (("faces", arrays["scans"].shape[1]), ("body_faces", len(arrays["body_vertices"]))):
        if arrays[faces].min() < 0 or arrays[faces].max() >= vertices:
            raise RecipeError(
                f"{path}: {faces!r} goes from {arrays[faces].min()} to {arrays[faces].max()}, but there are "
                f"{vertices:,} vertices. Count from 0"
            )
    weights = arrays["body_weights"]
    if weights.min() < 0 or np.abs(weights.sum(axis=1) - 1).max() > 1e-3:
        raise RecipeError(f"{path}: 'body_weights' must be 0 or more, and those of a vertex sum to one. {_DOCUMENTED}")
    if "parts" in arrays and not 0 < arrays["parts"].max() < 100:
        raise RecipeError(f"{path}: 'parts' must be 0 for skin and from 1 on for cloth, of which there must be some")
    if "parts" in arrays and arrays["parts"].min() < 0:
        raise RecipeError(f"{path}: 'parts' holds {arrays['parts'].min()}; skin is 0, cloth from 1 on")
    if poses.parents[0] != -1 or -1 in poses.parents[1:]:
        raise RecipeError(f"{path}: 'parents' must have one root, which comes first. {_DOCUMENTED}")
    if len(poses) < 2 or not arrays.get("seen", np.ones(1, bool)).any():
        raise RecipeError(f"{path}: an avatar needs two scans or more, and some that are learned from ('seen')")


def _at_home(
    scans: NDArray[np.float64], poses: Poses, root: NDArray[np.float64], translations: NDArray[Any] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Scans and rotations without the root's own: each scan turned back about the root joint, and put there."""
    moved = scans - root - (0 if translations is None else translations[:, None])
    turns = Rotation.from_rotvec(poses.rotations[:, 0]).as_matrix()
    rotations = poses.rotations.copy()
    rotations[:, 0] = 0
    return moved @ turns + root, rotations


def _body(arrays: dict[str, NDArray[Any]], poses: Poses) -> CanonicalBody:
    bones = len(poses.joints)
    weights = arrays["body_weights"].astype(np.float64)
    rig = Rig(
        names=poses.joints,
        parents=poses.parents,
        drivers=tuple(range(bones)),
        corrections=np.tile(np.eye(3), (bones, 1, 1)),
        weights=(weights / weights.sum(axis=1, keepdims=True)).astype(np.float32),
        joints=arrays["body_joints"].astype(np.float32),
    )
    vertices = arrays["body_vertices"].astype(np.float64)
    return canonical_body(rig, vertices, arrays["body_faces"], poses.joints, poses.parents)


def _require_near(path: Path, subject: Subject) -> None:
    """A body that is not in its scans would be learned from without a word."""
    for frame in np.unique(np.linspace(0, len(subject.scans) - 1, _CHECKED).astype(int)).tolist():
        posed = subject.posed(frame).vertices
        gap = float(np.median(cKDTree(subject.scans[frame]).query(posed)[0]))
        if gap > _LARGEST_GAP:
            raise RecipeError(
                f"{path}: the body in pose {frame} lies {100 * gap:.0f} cm from scan {frame} (the median of its "
                "vertices). Are both in metres, 'poses' relative to the parent, 'translations' those of the root, "
                f"'joints' in the weights' order? {_DOCUMENTED}"
            )
