"""Which geometries of a file are posed together: those that a person names, or all where they make one body."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import MeshError, NotOneBodyError
from datagen.common.printable import nearest

CHOOSE = "--source-geometry NAME or --target-geometry NAME (again for more)"
_REACH = 0.1  # of the longest edge of any box: geometries that are nearer than this belong together
_FLAT, _PLATE = 1e-3, 0.03  # of its own longest edge: what is flatter is ground or background, or a plate, which may be
_ROD = 0.05  # of its own longest edge: what is no wider is neither
_MOST = 1_000
_NAMED = 12  # in a message


def require_known_names(wanted: Sequence[str], there: Iterable[str], path: Path, *, what: str) -> None:
    """Refuse a name that is none of a file's (MeshError)."""
    known = list(dict.fromkeys(there))
    for name in wanted:
        if name not in known:
            raise MeshError(f"{path} has no {what} {name!r}{nearest(name, known)}; it has {listed(known) or 'none'}")


def require_few(names: Sequence[str], path: Path) -> None:
    """Refuse more than 1,000 geometries (MeshError), before anything is computed of each."""
    if len(names) > _MOST:
        raise MeshError(f"{path} holds {len(names):,} geometries: {listed(names)}. Choose with {CHOOSE}")


def require_one_body(extents: Mapping[str, NDArray[np.float64]], path: Path) -> None:
    """Refuse geometries, by least and greatest coordinates [2, 3] of each, that do not make one body.

    They do where each is near another one, which is near another one, and so on, and none is flat and larger than all
    others together.

    Raises
    ------
    NotOneBodyError
        Some are apart from the others, or one is the ground below them.
    """
    if len(extents) < 2:
        return
    names, boxes = list(extents), np.array(list(extents.values()))
    apart = [name for name, is_near in zip(names, _together(boxes), strict=True) if not is_near]
    ground = [name for place, name in enumerate(names) if _is_ground(boxes, place)]
    if apart or ground:
        what = f"flat and larger than the others: {listed(ground)}" if ground else f"apart: {listed(apart)}"
        raise NotOneBodyError(
            f"{path} holds {len(names)} geometries, {listed(names)}, which do not make one body ({what}). "
            f"Choose with {CHOOSE}"
        )


def listed(names: Iterable[str]) -> str:
    """Names for a message: the first ones, and how many more there are."""
    known = list(names)
    more = [f"and {len(known) - _NAMED} more"] if len(known) > _NAMED else []
    return ", ".join([*map(repr, known[:_NAMED]), *more])


def _together(boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which boxes [n, 2, 3] hang together with the largest, over others or not."""
    edges = np.ptp(boxes, axis=1).max(axis=1)
    low, high = boxes[:, 0] - _REACH * edges.max() / 2, boxes[:, 1] + _REACH * edges.max() / 2
    near = np.logical_and(low[:, None] <= high, high[:, None] >= low).all(axis=2)
    found = near[edges.argmax()]
    while (wider := near[found].any(axis=0)).sum() > found.sum():
        found = wider
    return np.asarray(found)


def _is_ground(boxes: NDArray[np.float64], place: int) -> bool:
    size, others = np.ptp(boxes[place], axis=0), np.delete(boxes, place, axis=0)
    low, high = others[:, 0].min(axis=0), others[:, 1].max(axis=0)
    thin, (thick, wide, long) = int(size.argmin()), np.sort(size)
    if long <= (high - low).max() or wide <= _ROD * long:
        return False
    under, over = boxes[place][:, thin]
    is_at_its_end = low[thin] >= under or high[thin] <= over
    stands_on_it = is_at_its_end and high[thin] - low[thin] >= 0.5 * (high - low).max()
    return bool(thick <= (_PLATE if stands_on_it else _FLAT) * long)
