"""Rows -> the summary table, and the paper's Tables 1, 2 and 3 with its own numbers beside ours; with definitions."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import PurePosixPath

import numpy as np

from datagen.store import Dataset
from training.evaluation import paper_numbers as paper
from training.evaluation.document import Line, Table, Text, cell_of, document_markdown, plain, with_best
from training.evaluation.measure import CONTROLS, NO_OPS, POSE_TYPES, SKINNED
from training.evaluation.results import Dressed, Row, is_dressed
from training.evaluation.statistics import BOOTSTRAP, differences, interval, spread_over, values_of
from training.evaluation.timing import Inference
from training.objectives import PMD_UNIT
from training.recipes.networks import DSFFNET

THEIRS = "paper"
"""What the cell begins with that marks a line as a paper's own numbers."""

DEFINITIONS = """\
- **PMD** point-wise mesh distance: mean over vertices and coordinates of (output - truth)^2 in the normalised box
  (each mesh centred and divided by half its longest box edge), times 1e4. **PMD re-centred**: after moving the
  output's box onto the truth's. **PMD by area**: vertices count by the area of their faces, not each alike.
- **CD** Chamfer distance: mean squared distance to the nearest vertex, output to truth plus truth to output, times 1e4.
- **EMD** earth mover's distance: mean distance under the best one-to-one assignment (exact) of {points} vertices, the
  same in both meshes, times 1e3.
- **mm** mean Euclidean error of a vertex in millimetres, at the target identity's own size.
- **edge** mean |output edge / true edge - 1|. **normal** mean angle between face normals, in degrees.
- *target unchanged* and *source unchanged* are no-op baselines: what doing nothing would score. The second knows
  more than the network: that source and target list corresponding vertices in one order, as they do in this data."""

DRESSED = f"""\
- **skin mm**, **garment mm**: mm over the vertices of dressed targets that are skin, and those that are garments. By
  part, each is measured as a mesh of its own, in the whole target's box.
  *{SKINNED}* is a control: the target moved to the source's pose by its own rig, exact but for what cloth does."""


@dataclass(frozen=True)
class Column:
    """A column of the table: heading, the field of :class:`Row` that it averages, factor and decimals."""

    heading: str
    field: str
    factor: float
    decimals: int


COLUMNS = (
    Column("PMD x1e-4", "pmd", 1 / PMD_UNIT, 2),
    Column("PMD re-centred", "pmd_recentred", 1 / PMD_UNIT, 2),
    Column("PMD by area", "pmd_by_area", 1 / PMD_UNIT, 2),
    Column("CD x1e-4", "chamfer", 1e4, 2),
    Column("EMD x1e-3", "earth_mover", 1e3, 2),
    Column("mm", "millimetres", 1.0, 1),
    Column("edge", "edge_ratio", 1.0, 3),
    Column("normal", "normal_degrees", 1.0, 1),
)

DRESSED_COLUMNS = (Column("skin mm", "skin_millimetres", 1.0, 1), Column("garment mm", "garment_millimetres", 1.0, 1))
PARTS = ("skin", "garment")


def columns_of(part: str) -> list[Column]:
    """The columns of a part of dressed targets."""
    own = {field.name for field in fields(Dressed)}
    named = [replace(column, field=f"{part}_{column.field}") for column in COLUMNS]
    return [column for column in named if column.field in own]


def methods_of(rows: Iterable[Row]) -> list[str]:
    """Methods in the rows: trained ones first, then the no-op baselines."""
    names = dict.fromkeys(row.method for row in rows)
    place = {name: number for number, name in enumerate(CONTROLS, 1)}
    return sorted(names, key=lambda name: (place.get(name, 0), name))


def mean_of(rows: Iterable[Row], *, method: str, pose_type: str, field: str) -> float:
    """Mean of a metric over the triples of one pose type; NaN where there are none."""
    values = list(values_of(rows, method=method, pose_type=pose_type, field=field).values())
    return float(np.mean(values)) if values else float("nan")


def summary(rows: Sequence[Row]) -> Table:
    """One line for each method and pose type, as text."""
    dressed = [row for row in rows if is_dressed(row)]
    apart = DRESSED_COLUMNS if dressed else ()
    lines = [["poses", "method", *(column.heading for column in (*COLUMNS, *apart))]]
    for pose_type in POSE_TYPES:
        for method in methods_of(rows):
            if any((row.method, row.pose_type) == (method, pose_type) for row in rows):
                means = [_mean(rows, method, pose_type, column) for column in COLUMNS]
                means += [_mean(dressed, method, pose_type, column) for column in apart]
                lines.append([pose_type, method, *means])
    return Table(lines)


def by_part(rows: Sequence[Row]) -> Table:
    """One line for each method, pose type and part of dressed targets, as text."""
    dressed = [row for row in rows if is_dressed(row)]
    lines = [["poses", "part", "method", *(column.heading for column in columns_of(PARTS[0]))]]
    for pose_type in POSE_TYPES:
        for part in PARTS:
            for method in methods_of(row for row in dressed if row.pose_type == pose_type):
                means = [_mean(dressed, method, pose_type, column) for column in columns_of(part)]
                lines.append([pose_type, part, method, *means])
    return Table(lines)


def emphasised(table: Table) -> Table:
    """Return the table with the best of each column bold and a paper's lines in italics.

    The best of ours and of theirs, of seen and of unseen poses are searched apart; no-ops take no part.
    """
    lines = with_best(table.lines, columns=range(1, len(table.lines[0])), group=lambda line: _contest(table, line))
    return replace(table, lines=[[replace(c, italic=_is_theirs(line)) for c in line] for line in lines])


def _contest(table: Table, line: Line) -> tuple[bool, str] | None:
    cells, headings = ([cell_of(cell).text for cell in each] for each in (line, table.lines[0]))
    of_what = [cell for heading, cell in zip(headings, cells, strict=True) if heading in ("poses", "part")]
    return None if set(CONTROLS) & set(cells) else (_is_theirs(line), " ".join(of_what))


def _is_theirs(line: Line) -> bool:
    return any(cell_of(cell).text.startswith(THEIRS) for cell in line)


def about_weights(steps: Mapping[str, int], dataset: Dataset) -> str:
    """What was measured on what, as markup for :func:`results`; ``steps`` of each method's training."""
    told = ", ".join(f"{step:,}{f' ({plain(name)})' if len(steps) > 1 else ''}" for name, step in steps.items())
    return f"Weights of step {told} on {plain(PurePosixPath(dataset.url).name)} ({dataset.uuid})."


def results(rows: Sequence[Row], *, about: str, emd_points: int) -> tuple[Text | Table, ...]:
    """The summary with what must be known to read it; ``about`` (markup) says what was measured on what."""
    dressed = any(map(is_dressed, rows))
    counts = {t: len({row.triple for row in rows if row.pose_type == t}) for t in POSE_TYPES}
    triples = ", ".join(f"{count} with {pose_type} poses" for pose_type, count in counts.items() if count)
    return (
        Text(f"{about} New identities; fixed triples: {triples}. Lower is better in every column."),
        summary(rows),
        *([by_part(rows)] if dressed else []),
        Text(spread(rows)),
        Text(DEFINITIONS.format(points=emd_points) + (f"\n{DRESSED}" if dressed else "")),
    )


def report(rows: Sequence[Row], *, title: str, about: str, emd_points: int) -> str:
    """:func:`results` as a Markdown document."""
    return document_markdown(title, results(rows, about=about, emd_points=emd_points))


def spread(rows: Sequence[Row]) -> str:
    """One line: the 95 % interval of each method's mean PMD, on unseen poses where there are any."""
    pose_type = spread_over(rows)
    found = {method: _interval(_pmd(rows, method, pose_type)) for method in methods_of(rows)}
    parts = [f"{plain(method)} {low_to_high}" for method, low_to_high in found.items() if low_to_high]
    if not parts:
        return "Too few triples for an interval of the mean."
    return f"PMD x1e-4 on {pose_type} poses, 95 % intervals of the mean ({BOOTSTRAP}): {'; '.join(parts)}."


def table_1(rows: Sequence[Row], *, data: paper.PaperData = "SMPL", here: str, emd_points: int) -> Table:
    """The paper's Table 1: PMD, CD, EMD of each method on seen and unseen poses, ours and, marked, theirs below.

    The last two columns say what differences of PMD on unseen poses mean: the 95 % interval of the method's mean, and
    its mean difference to DSFFNet (or the first method) over the same triples with the interval of that.

    Parameters
    ----------
    rows
        Of :func:`training.evaluation.evaluate.evaluate`; no-op baselines come last.
    data
        Which of the paper's data theirs is of: humans (SMPL) or animals (SMAL).
    here, emd_points
        What ours was measured on, in a few words, and vertices of the earth mover's distance: for the notes.
    """
    lines = _comparison(rows, methods_of(rows), paper.TABLE_1[data], label=f"{THEIRS}, {data}")
    return Table(lines, "Table 1: error on new identities", _note(data, here, emd_points))


def _note(data: paper.PaperData, here: str, emd_points: int) -> str:
    """Units, and that theirs is of other data."""
    meshes = {"SMPL": "SMPL humans of 6,890 vertices, 16 x 400", "SMAL": "SMAL animals of 3,889 vertices, 24 x 300"}
    return (
        f"{_UNITS.format(points=emd_points)} Ours: {here}. Lines marked '{THEIRS}' are the paper's own numbers on "
        f"other data ({meshes[data]} meshes learned for 200 epochs; EMD of an unstated number of points): bodies, "
        "vertex counts and training budget differ, so that they stand here for orientation, not as a target. Some of "
        "its EMD exceed sqrt(3 PMD), which no EMD over the vertices of the PMD can."
    )


def table_2(inference: Mapping[str, Inference]) -> Table:
    """The paper's Table 2: size of the weights in float32 and time of one pair, ours and, marked, theirs below."""
    lines = [["method", "numbers", "size KiB", "parameters", "mean s a pair", "median s", "fastest to slowest"]]
    for name in _in_papers_order(inference):
        measured = inference[name]
        times = [f"{measured.mean:.4f}", f"{measured.seconds:.4f}", f"{measured.fastest:.4f} to {measured.slowest:.4f}"]
        lines.append([name, "ours", f"{measured.kilobytes:,.0f}", f"{measured.parameters:,}", *times])
        if name in paper.TABLE_2:
            theirs = paper.TABLE_2[name]
            label = f"{THEIRS}, {paper.INFERENCE_DEVICE}"
            lines.append([name, label, f"{theirs.kilobytes:,.0f}", "", f"{theirs.seconds:.4f}", "", ""])
    return Table(lines, "Table 2: size, and time of one transfer", _timing_note(inference))


def _timing_note(inference: Mapping[str, Inference]) -> str:
    """On what ours was measured, and that theirs is of another machine."""
    first = next(iter(inference.values()))
    threads = f"{first.threads} thread{'s' if first.threads > 1 else ''}"
    return (
        f"Ours: mean and median of {first.rounds} rounds in which the networks took turns, on one pair of "
        f"{first.source_vertices:,} (source) and {first.target_vertices:,} (target) vertices in float32 on "
        f"{first.device} with {threads}; weights loaded, kernels warm. Lines marked "
        f" '{THEIRS}' are the paper's own, on an {paper.INFERENCE_DEVICE} GPU: "
        "another machine, so that only the order and the ratios of times can be compared."
    )


def table_3(rows: Sequence[Row], *, here: str, emd_points: int) -> Table:
    """The paper's Table 3: DSFFNet and its ablations, ours and, marked, theirs (SMPL) below; columns as Table 1's.

    One column is added, the edge-length error on unseen poses, which is what the edge loss is for.
    """
    methods = [method for method in methods_of(rows) if method not in CONTROLS]
    lines = _comparison(rows, methods, paper.TABLE_3, label=f"{THEIRS}, SMPL", more=("edge_ratio",))
    return Table(lines, "Table 3: what its parts are worth", _note("SMPL", here, emd_points))


_PAPERS_COLUMNS = ("pmd", "chamfer", "earth_mover")
_PMD = COLUMNS[0]
_UNITS = (
    "PMD and CD in 1e-4 (squared units of the normalised box, half the longest box edge), EMD in 1e-3, exact over "
    f"{{points:,}} vertices; less is better. Intervals: 95 %, {BOOTSTRAP}."
)


def _comparison(
    rows: Sequence[Row],
    methods: Sequence[str],
    theirs: Mapping[str, paper.SeenUnseen],
    *,
    label: str,
    more: Sequence[str] = (),
) -> list[list[str]]:
    """Heading and lines of Tables 1 and 3; ``more``: further fields, on the pose type of the spread."""
    pose_type, reference = spread_over(rows), _reference(methods)
    shown = [(kind, name) for kind in POSE_TYPES for name in _PAPERS_COLUMNS] + [(pose_type, name) for name in more]
    columns = [(kind, next(column for column in COLUMNS if column.field == name)) for kind, name in shown]
    headings = [f"{kind} {column.heading.split()[0]}" for kind, column in columns]
    spreads = [f"{pose_type} PMD, 95 %", f"minus {reference}'s, 95 %"]
    lines = [["method", "numbers", *headings, *spreads]]
    for method in _in_papers_order(methods):
        cells = [_mean(rows, method, kind, column) for kind, column in columns]
        cells += [_interval(_pmd(rows, method, pose_type)), _difference(rows, method, reference, pose_type)]
        lines.append([method, _kind(method), *cells])
        if _short(method) in theirs:
            lines.append([method, label, *_cells(theirs[_short(method)]), *[""] * (len(more) + 2)])
    return lines


def _kind(method: str) -> str:
    return "no-op" if method in NO_OPS else "control" if method == SKINNED else "ours"


def _cells(scores: paper.SeenUnseen) -> list[str]:
    return [f"{getattr(mean, name):.2f}" for mean in (scores.seen, scores.unseen) for name in _PAPERS_COLUMNS]


def _short(method: str) -> str:
    """An ablation's name as the paper has it, without the network's."""
    return method.removeprefix(f"{DSFFNET} ")


def _in_papers_order(methods: Iterable[str]) -> list[str]:
    known = [*paper.TABLE_2, *paper.TABLE_3]
    place = {name: known.index(_short(name)) if _short(name) in known else len(known) for name in methods}
    return sorted(place, key=lambda name: (name in CONTROLS, place[name]))


def _reference(methods: Sequence[str]) -> str:
    return DSFFNET if DSFFNET in methods else methods[0]


def _mean(rows: Iterable[Row], method: str, pose_type: str, column: Column) -> str:
    values = values_of(rows, method=method, pose_type=pose_type, field=column.field)
    return f"{np.mean(list(values.values())) * column.factor:.{column.decimals}f}" if values else "-"


def _pmd(rows: Iterable[Row], method: str, pose_type: str) -> Iterable[float]:
    return values_of(rows, method=method, pose_type=pose_type, field="pmd").values()


def _difference(rows: Sequence[Row], method: str, reference: str, pose_type: str) -> str:
    found = differences(rows, method=method, reference=reference, pose_type=pose_type, field="pmd")
    if method == reference or len(found) < 2:
        return ""
    return f"{np.mean(found) * _PMD.factor:+.2f} ({_interval(found, sign='+')})"


def _interval(values: Iterable[float], *, sign: str = "") -> str:
    """The 95 % interval of a mean PMD; empty where there is none."""
    found = interval(values)
    return " to ".join(f"{end * _PMD.factor:{sign}.2f}" for end in found) if found else ""
