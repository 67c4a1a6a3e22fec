"""Frames of a sequence smoothed along time while they pass, holding no more of them than one window.

A Savitzky-Golay filter fits a parabola to every vertex's path over a window: a limb that swings keeps its arc, where a
plain average would cut the corner and shorten the limb. The result is that of ``scipy.signal.savgol_filter`` over the
whole sequence (``mode="interp"``: the first and last frames lie on the parabola of the first and last window).
"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from datagen.common.arrays import Floats

_DEGREE = 2


def smoothed(frames: Iterable[Floats], window: int) -> Iterator[Floats]:
    """Smooth vertex paths over ``window`` frames.

    Parameters
    ----------
    frames
        Vertices [n, 3] of each frame, any unit, evenly spaced in time.
    window
        Frames that a parabola is fitted to; an even number counts as the next odd one, and 3 or less smooth nothing.

    Yields
    ------
    array [n, 3]
        As many frames as came in, in their order.
    """
    window += 1 - window % 2
    if window <= _DEGREE + 1:
        yield from frames
        return
    held: deque[Floats] = deque(maxlen=window)
    for frame in frames:
        was_full = len(held) == window
        held.append(frame)
        if was_full:
            yield _fitted(held, window // 2)
        elif len(held) == window:
            yield from (_fitted(held, place) for place in range(window // 2 + 1))
    rest = range(window // 2 + 1, window) if len(held) == window else range(len(held))
    yield from (_fitted(held, place) for place in rest)


def _fitted(frames: Sequence[Floats], place: int) -> Floats:
    """The frame at ``place`` on the parabolas through all ``frames``."""
    if len(frames) <= _DEGREE + 1:
        return frames[place]
    from scipy.signal import savgol_coeffs  # a quarter of a second, which a single mesh need not wait for

    weights = savgol_coeffs(len(frames), _DEGREE, pos=place, use="dot")
    return np.asarray(sum(weight * frame for weight, frame in zip(weights, frames, strict=True)))
