"""The DSFFNet paper's own numbers (Tables 1, 2 and 3), to be shown beside ours and marked as theirs, never mixed in.

They are of other data: SMPL bodies of 6,890 vertices (16 identities x 400 poses learned, 14 new identities evaluated)
and SMAL animals of 3,889 (24 x 300, 16 new), after 200 epochs. The paper does not state on how many points its EMD is.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from training.recipes.networks import (
    CORENET3D,
    DSFFNET,
    NPT,
    WITHOUT_EDGE_LOSS,
    WITHOUT_FUSION,
    WITHOUT_TARGET_SIDE,
)

PaperData = Literal["SMPL", "SMAL"]
"""Humans and animals of the paper."""

INFERENCE_DEVICE = "RTX 3080"
"""The GPU that the paper's inference times are of."""


@dataclass(frozen=True)
class Scores:
    """Means over evaluation triples in the paper's units: PMD x1e-4, CD x1e-4 (box^2), EMD x1e-3 (box)."""

    pmd: float
    chamfer: float
    earth_mover: float


@dataclass(frozen=True)
class SeenUnseen:
    """Scores of new identities in poses of the training, and in new poses."""

    seen: Scores
    unseen: Scores


@dataclass(frozen=True)
class Cost:
    """Size of the weights in KB, and seconds for one pair on `INFERENCE_DEVICE`."""

    kilobytes: float
    seconds: float


TABLE_1: Mapping[PaperData, Mapping[str, SeenUnseen]] = {
    "SMPL": {
        NPT: SeenUnseen(Scores(2.39, 10.61, 49.02), Scores(8.60, 38.72, 198.18)),
        CORENET3D: SeenUnseen(Scores(1.13, 3.24, 23.76), Scores(4.45, 14.34, 96.64)),
        DSFFNET: SeenUnseen(Scores(0.57, 1.37, 13.40), Scores(1.78, 2.18, 21.44)),
    },
    "SMAL": {
        NPT: SeenUnseen(Scores(50.67, 153.97, 106.89), Scores(70.28, 212.39, 162.48)),
        CORENET3D: SeenUnseen(Scores(18.86, 48.72, 83.25), Scores(25.53, 75.78, 132.54)),
        DSFFNET: SeenUnseen(Scores(11.32, 19.52, 41.73), Scores(17.96, 43.29, 72.46)),
    },
}
"""Table 1 by data and method."""

TABLE_2: Mapping[str, Cost] = {
    NPT: Cost(23668, 0.0071),
    CORENET3D: Cost(95647, 0.0152),
    DSFFNET: Cost(36631, 0.0076),
}
"""Table 2 by method."""

TABLE_3: Mapping[str, SeenUnseen] = {
    DSFFNET: TABLE_1["SMPL"][DSFFNET],
    WITHOUT_FUSION: SeenUnseen(Scores(7.28, 21.23, 119.77), Scores(10.72, 49.52, 227.83)),
    WITHOUT_TARGET_SIDE: SeenUnseen(Scores(2.14, 8.33, 34.13), Scores(4.07, 18.93, 83.31)),
    WITHOUT_EDGE_LOSS: SeenUnseen(Scores(0.91, 3.67, 22.49), Scores(2.12, 7.82, 42.63)),
}
"""Table 3 (SMPL) by ablation, the full DSFFNet first."""
