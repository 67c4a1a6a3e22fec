"""What the labels of dressed bodies mean to people: names and colours of skin and garments, the same wherever shown."""

import numpy as np
from numpy.typing import NDArray

_COLORS = np.array([(217, 169, 138), (85, 112, 143), (201, 180, 88), (143, 78, 78)], np.uint8)


def part_name(part: int) -> str:
    """Name of a label: ``skin`` is 0, ``garment 1`` the innermost part of an outfit."""
    return f"garment {part}" if part else "skin"


def part_colors(labels: NDArray[np.integer]) -> NDArray[np.uint8]:
    """Colours sRGB [label, 3] of labels [label]; those of garments come again from the fourth on."""
    return _COLORS[np.where(labels > 0, 1 + (labels - 1) % (len(_COLORS) - 1), 0)]
