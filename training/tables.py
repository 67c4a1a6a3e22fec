"""Rows -> the summary table, with the definition of every column beside it."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from training.evaluation import POSE_TYPES, Row

DEFINITIONS = """\
- **PMD** point-wise mesh distance: mean over vertices and coordinates of (output - truth)^2 in the normalised box
  (each mesh centred and divided by half its longest box edge), times 1e4. **PMD re-centred**: after moving the
  output's box onto the truth's.
- **CD** Chamfer distance: mean squared distance to the nearest vertex, output to truth plus truth to output, times 1e4.
- **EMD** earth mover's distance: mean distance under the best one-to-one assignment (exact) of {points} vertices, the
  same in both meshes, times 1e3.
- **mm** mean Euclidean error of a vertex in millimetres, at the target identity's own size.
- **edge** mean |output edge / true edge - 1|. **normal** mean angle between face normals, in degrees.
- *target unchanged* and *source unchanged* are no-op baselines: what doing nothing would score. The second knows
  more than the network: that source and target list corresponding vertices in one order, as they do in this data."""


@dataclass(frozen=True)
class Column:
    """A column of the table: heading, the field of :class:`Row` that it averages, factor and decimals."""

    heading: str
    field: str
    factor: float
    decimals: int


COLUMNS = (
    Column("PMD x1e-4", "pmd", 1e4, 2),
    Column("PMD re-centred", "pmd_recentred", 1e4, 2),
    Column("CD x1e-4", "chamfer", 1e4, 2),
    Column("EMD x1e-3", "earth_mover", 1e3, 2),
    Column("mm", "millimetres", 1.0, 1),
    Column("edge", "edge_ratio", 1.0, 3),
    Column("normal", "normal_degrees", 1.0, 1),
)


def methods_of(rows: Iterable[Row]) -> list[str]:
    """Methods in the rows: trained ones first, then the no-op baselines."""
    names = dict.fromkeys(row.method for row in rows)
    return sorted(names, key=lambda name: (name.endswith("unchanged"), name == "source unchanged", name))


def mean_of(rows: Iterable[Row], *, method: str, pose_type: str, field: str) -> float:
    """Mean of a metric over the triples of one pose type; NaN where there are none."""
    values = [getattr(row, field) for row in rows if row.method == method and row.pose_type == pose_type]
    return float(np.mean(values)) if values else float("nan")


def summary(rows: list[Row]) -> list[list[str]]:
    """Heading line and one line for each method and pose type, as text."""
    lines = [["poses", "method", *(column.heading for column in COLUMNS)]]
    for pose_type in POSE_TYPES:
        for method in methods_of(rows):
            values = [mean_of(rows, method=method, pose_type=pose_type, field=column.field) for column in COLUMNS]
            if not np.isnan(values[0]):
                cells = [f"{v * c.factor:.{c.decimals}f}" for v, c in zip(values, COLUMNS, strict=True)]
                lines.append([pose_type, method, *cells])
    return lines


def markdown(lines: list[list[str]]) -> str:
    """A Markdown table, aligned so that it also reads well as plain text."""
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    left = {0, 1}
    texts = [
        "| "
        + " | ".join(c.ljust(w) if i in left else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True)))
        + " |"
        for line in lines
    ]
    rule = "|" + "|".join("-" * (w + 2) if i in left else "-" * (w + 1) + ":" for i, w in enumerate(widths)) + "|"
    return "\n".join([texts[0], rule, *texts[1:]])


def report(rows: list[Row], *, title: str, about: str, emd_points: int) -> str:
    """The table as a Markdown document with its definitions; ``about`` says what was measured on what."""
    counts = {t: len({row.triple for row in rows if row.pose_type == t}) for t in POSE_TYPES}
    triples = ", ".join(f"{count} with {pose_type} poses" for pose_type, count in counts.items() if count)
    return (
        f"# {title}\n\n{about} New identities; fixed triples: {triples}. Lower is better in every column.\n\n"
        f"{markdown(summary(rows))}\n\n{DEFINITIONS.format(points=emd_points)}\n"
    )
