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
from datagen.mesh.geometry import Mesh
from datagen.mesh.rig import Rig, skinned
from datagen.poses import Poses
from datagen.poses.pose_files import MAKE_ONE, read_pose_file
from training.avatar.body import CanonicalBody, canonical_body
from training.avatar.subject import Subject, posed_by

_LARGEST_GAP = 0.1
"""Metres: half of a body's vertices lie nearer to its scan, or one of the two is another person's, pose's or unit's."""
_CHECKED = 500  # vertices of the body that every scan is held against
_LARGEST = 1e3  # metres; what is further is no person
_UNSEEN = 7  # one scan of so many is not learned from, where the file does not say which: the last ones
_OFF_ONE = 1e-3  # that weights may sum to more or less than one
_FEWEST, _MOST_PARTS = 2, 99
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
    source, poses = person_source(path), _poses(path)
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
    _require_outwards(path, found)
    _require_near(path, found)
    return found


def person_source(path: Path) -> str:
    """The sha256 of a file of scans (RecipeError where there is none)."""
    if not path.is_file():
        raise RecipeError(f"no file of scans at {str(path)!r}. {_DOCUMENTED}")
    return sha256_of(path)


def _poses(path: Path) -> Poses:
    try:
        return read_pose_file(path)
    except RecipeError as error:
        raise RecipeError(str(error).replace(MAKE_ONE, _DOCUMENTED)) from error


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
    wanted = [int(axis) if axis.isdigit() else sizes.get(axis) for axis in axes]
    lengths = [length if known is None else known for known, length in zip(wanted, array.shape, strict=False)]
    if array.dtype.kind in kinds and array.size and array.shape == tuple(lengths) and len(lengths) == len(axes):
        sizes.update((axis, length) for axis, length in zip(axes, lengths, strict=True) if not axis.isdigit())
        return
    shape = ", ".join(axis if length is None else str(length) for axis, length in zip(axes, wanted, strict=True))
    kind = {"b": "true or false", "iu": "whole numbers", "fiu": "numbers"}[kinds]
    raise RecipeError(
        f"{path}: {name!r} has shape {list(array.shape)} and type {array.dtype}; it must be {kind} [{shape}], which is "
        f"[{', '.join(axes)}]. {_DOCUMENTED}"
    )


def _require_values(path: Path, arrays: dict[str, NDArray[Any]], poses: Poses) -> None:
    for name, array in arrays.items():
        strange = np.argwhere(~(np.abs(array.astype(np.float64)) <= _LARGEST))
        if array.dtype.kind == "f" and len(strange):
            place = tuple(strange[0].tolist())
            raise RecipeError(
                f"{path}: {name!r} holds {array[place]} at {list(place)}; numbers up to {_LARGEST:,.0f} are read, in "
                f"metres. {_DOCUMENTED}"
            )
    for faces, vertices in (("faces", arrays["scans"].shape[1]), ("body_faces", len(arrays["body_vertices"]))):
        if arrays[faces].min() < 0 or arrays[faces].max() >= vertices:
            raise RecipeError(
                f"{path}: {faces!r} goes from {arrays[faces].min()} to {arrays[faces].max()}, but there are "
                f"{vertices:,} vertices. Count from 0"
            )
    sums, least = arrays["body_weights"].sum(axis=1), arrays["body_weights"].min(axis=1)
    wrong = np.flatnonzero((np.abs(sums - 1) > _OFF_ONE) | (least < 0))
    if len(wrong):
        raise RecipeError(
            f"{path}: 'body_weights' of vertex {wrong[0]} go down to {least[wrong[0]]:.3g} and sum to "
            f"{sums[wrong[0]]:.3g}; they must be 0 or more, and sum to one. {_DOCUMENTED}"
        )
    if "parts" in arrays:
        _require_parts(path, arrays["parts"], arrays["faces"])
    if poses.parents[0] != -1 or -1 in poses.parents[1:]:
        raise RecipeError(f"{path}: 'parents' must have one root, which comes first. {_DOCUMENTED}")
    seen = arrays.get("seen", np.arange(len(poses)) > 0)
    if seen.sum() < _FEWEST:
        raise RecipeError(
            f"{path}: {seen.sum()} of {len(poses)} scans are learned from, {_FEWEST} are the fewest. Add scans, or let "
            "'seen' say so of more"
        )


def _require_parts(path: Path, parts: NDArray[Any], faces: NDArray[Any]) -> None:
    most = int(parts.max())
    if not (parts.min() >= 0 and 0 < most <= _MOST_PARTS):
        raise RecipeError(
            f"{path}: 'parts' goes from {parts.min()} to {most}; skin is 0, cloth from 1 to {_MOST_PARTS}, and there "
            "must be some"
        )
    whole = parts[faces[(parts[faces] == parts[faces[:, :1]]).all(axis=1), 0]]
    missing = sorted(set(range(1, most + 1)) - set(whole.tolist()))
    if missing:
        raise RecipeError(
            f"{path}: no triangle of 'faces' lies in part {missing[0]} of 'parts' with all three corners. Number parts "
            f"from 1 to {most} without gaps"
        )


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


def _require_outwards(path: Path, subject: Subject) -> None:
    """Triangles that look inwards would say that all around the person is inside."""
    scan, label = subject.scan(0), subject.parts[subject.faces]
    meshes = {"'body_faces'": Mesh(subject.body.vertices, subject.body.faces)}
    for part in range(1, int(subject.parts.max()) + 1):
        meshes[f"'faces' of part {part}"] = Mesh(scan.vertices, subject.faces[(label == part).all(axis=1)])
    for name, mesh in meshes.items():
        first, second, third = (mesh.vertices[mesh.faces] - mesh.vertices[mesh.faces].mean(axis=(0, 1))).swapaxes(0, 1)
        volume = float((first * np.cross(second, third)).sum() / 6)
        if volume <= 0:
            raise RecipeError(
                f"{path}: {name} enclose {1000 * volume:.3g} litres, so they look inwards or have no area. Turn them "
                "round: faces[:, ::-1]"
            )


def _require_near(path: Path, subject: Subject) -> None:
    """A body that is not in its scans would be learned from without a word."""
    body = subject.body
    some = np.linspace(0, len(body.vertices) - 1, min(_CHECKED, len(body.vertices))).astype(int)
    posed = skinned(body.vertices[some], body.weights[some], subject.transforms.astype(np.float64))
    for frame, places in enumerate(posed):
        gap = float(np.median(cKDTree(subject.scans[frame]).query(places)[0]))
        if gap > _LARGEST_GAP:
            raise RecipeError(
                f"{path}: the body in pose {frame} lies {100 * gap:.0f} cm from scan {frame} (the median of its "
                "vertices). Are both in metres, 'poses' relative to the parent, 'translations' those of the root, "
                f"'joints' in the weights' order? {_DOCUMENTED}"
            )
