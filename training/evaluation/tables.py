"""Rows -> the summary table, and the paper's Tables 1, 2 and 3 with its own numbers beside ours; definitions to each.

How tables are written (Markdown, HTML, CSV) is in :mod:`training.evaluation.tables`.
"""

import csv as csv_module
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from training.evaluation import paper_numbers as paper
from training.evaluation.measure import NO_OPS, POSE_TYPES
from training.evaluation.results import Row, inert
from training.evaluation.statistics import BOOTSTRAP, differences, interval, spread_over, values_of
from training.evaluation.timing import Inference
from training.reports.blocks import cell_of
from training.reports.markup import plain

Lines = list[list[str]]

THEIRS = "paper"
"""What the cell begins with that marks a line as a paper's own numbers."""

STYLE = """\
table.results {border-collapse: collapse; margin: 1.5em 0}
table.results {font: 14px/1.4 system-ui, sans-serif; font-variant-numeric: tabular-nums}
table.results caption {caption-side: top; text-align: left; font-weight: 600; padding: 0 0 .5em}
table.results th, table.results td {padding: .25em .8em; text-align: right; white-space: nowrap; font-weight: 400}
table.results th[scope=row], table.results .words {text-align: left}
table.results thead th {border-bottom: 1.5px solid #333; font-weight: 600}
table.results tbody tr {border-bottom: 1px solid #e4e4e4}
table.results tr.theirs {color: #767676; font-style: italic}
table.results strong {font-weight: 700}
"""
"""A page's style sheet for :func:`html`."""

_NUMBER = re.compile(r"\d[\d,]*(\.\d+)?")
_BEGINS_AS_NUMBER = re.compile(r"[+-]?\d[\d,.]*( |$)")
_NO_OP = "unchanged"


def markdown(lines: Lines) -> str:
    """A Markdown table, aligned so that it also reads well as plain text."""
    lines = [[_safe(cell) for cell in line] for line in lines]
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


def _safe(cell: str) -> str:
    """A cell whose text, within the marks around the whole of it, is no Markdown."""
    its = cell_of(cell)
    return f"{its.stars}{plain(its.text)}{its.stars}"


def emphasised(lines: Lines) -> Lines:
    """The same for :func:`markdown`, with the best of each column bold and a paper's lines in italics."""
    best = _best(lines)
    return [lines[0], *([_marked(lines, row, place, best) for place in range(len(lines[0]))] for row in _rows(lines))]


def html(lines: Lines, *, caption: str = "") -> str:
    """An HTML table (a fragment, see `STYLE`): the best of each column in <strong>, a paper's lines grey italics."""
    heading = "".join(f'<th scope="col"{_words(lines, i)}>{escape(cell)}</th>' for i, cell in enumerate(lines[0]))
    best = _best(lines)
    body = "\n".join(_html_line(lines, row, best) for row in _rows(lines))
    title = f"<caption>{escape(caption)}</caption>\n" if caption else ""
    return (
        f'<table class="results">\n{title}<thead>\n<tr>{heading}</tr>\n</thead>\n<tbody>\n{body}\n</tbody>\n</table>\n'
    )


def csv(lines: Lines) -> str:
    """The cells as CSV, as they are printed."""
    text = io.StringIO()
    csv_module.writer(text, lineterminator="\n").writerows([inert(cell) for cell in line] for line in lines)
    return text.getvalue()


def is_theirs(line: Sequence[str]) -> bool:
    """Whether a line holds a paper's own numbers."""
    return any(cell.startswith(THEIRS) for cell in line)


def _rows(lines: Lines) -> range:
    return range(1, len(lines))


def _marked(lines: Lines, row: int, place: int, best: set[tuple[int, int]]) -> str:
    cell = lines[row][place]
    mark = "*" * ((row, place) in best) * 2 + "*" * is_theirs(lines[row])
    return f"{mark}{cell}{mark}" if cell else cell


def _html_line(lines: Lines, row: int, best: set[tuple[int, int]]) -> str:
    cells = [f"<strong>{escape(c)}</strong>" if (row, i) in best else escape(c) for i, c in enumerate(lines[row])]
    others = "".join(f"<td{_words(lines, i)}>{cell}</td>" for i, cell in enumerate(cells) if i)
    kind = ' class="theirs"' if is_theirs(lines[row]) else ""
    return f'<tr{kind}><th scope="row">{cells[0]}</th>{others}</tr>'


def _words(lines: Lines, place: int) -> str:
    """Columns of words, unlike those of numbers, begin at the left."""
    is_words = not any(_BEGINS_AS_NUMBER.match(lines[row][place]) for row in _rows(lines))
    return ' class="words"' if is_words else ""


def _best(lines: Lines) -> set[tuple[int, int]]:
    """(row, column) of the lowest numbers of each column, ours and theirs apart, poses apart, no-ops left out.

    A column in which all are equal has no best.
    """
    found: set[tuple[int, int]] = set()
    for group in _groups(lines):
        for place in range(1, len(lines[0])):
            numbers = np.array([_number(lines[row][place]) for row in group])
            if len(np.unique(numbers[np.isfinite(numbers)])) > 1:
                found |= {(group[at], place) for at in np.flatnonzero(numbers == np.nanmin(numbers)).tolist()}
    return found


def _groups(lines: Lines) -> list[list[int]]:
    groups: dict[tuple[bool, str], list[int]] = {}
    for row in _rows(lines):
        if not any(cell.endswith(_NO_OP) for cell in lines[row]):
            of = lines[row][0] if lines[0][0] == "poses" else ""
            groups.setdefault((is_theirs(lines[row]), of), []).append(row)
    return list(groups.values())


def _number(cell: str) -> float:
    return float(cell.replace(",", "")) if _NUMBER.fullmatch(cell) else float("nan")


__all__ = [
    "COLUMNS",
    "DEFINITIONS",
    "STYLE",
    "Column",
    "csv",
    "emphasised",
    "html",
    "markdown",
    "mean_of",
    "methods_of",
    "note_1",
    "note_2",
    "note_3",
    "report",
    "spread",
    "summary",
    "table_1",
    "table_2",
    "table_3",
]

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
    values = list(values_of(rows, method=method, pose_type=pose_type, field=field).values())
    return float(np.mean(values)) if values else float("nan")


def summary(rows: Sequence[Row]) -> Lines:
    """Heading line and one line for each method and pose type, as text."""
    lines = [["poses", "method", *(column.heading for column in COLUMNS)]]
    for pose_type in POSE_TYPES:
        for method in methods_of(rows):
            if any((row.method, row.pose_type) == (method, pose_type) for row in rows):
                lines.append([pose_type, method, *(_mean(rows, method, pose_type, column) for column in COLUMNS)])
    return lines


def report(rows: list[Row], *, title: str, about: str, emd_points: int) -> str:
    """The table as a Markdown document with its definitions; ``about`` says what was measured on what."""
    counts = {t: len({row.triple for row in rows if row.pose_type == t}) for t in POSE_TYPES}
    triples = ", ".join(f"{count} with {pose_type} poses" for pose_type, count in counts.items() if count)
    return (
        f"# {title}\n\n{about} New identities; fixed triples: {triples}. Lower is better in every column.\n\n"
        f"{markdown(summary(rows))}\n\n{spread(rows)}\n\n{DEFINITIONS.format(points=emd_points)}\n"
    )


def spread(rows: Sequence[Row]) -> str:
    """One line: the 95 % interval of each method's mean PMD, on unseen poses where there are any."""
    pose_type = spread_over(rows)
    found = {method: _interval(_pmd(rows, method, pose_type)) for method in methods_of(rows)}
    parts = [f"{plain(method)} {low_to_high}" for method, low_to_high in found.items() if low_to_high]
    return (
        f"PMD x1e-4 on {pose_type} poses, 95 % intervals of the mean ({BOOTSTRAP}): {'; '.join(parts)}."
        if parts
        else "Too few triples for an interval of the mean."
    )


def table_1(rows: Sequence[Row], *, data: paper.PaperData = "SMPL") -> Lines:
    """The paper's Table 1: PMD, CD, EMD of each method on seen and unseen poses, ours and, marked, theirs below.

    The last two columns say what differences of PMD on unseen poses mean: the 95 % interval of the method's mean, and
    its mean difference to DSFFNet (or the first method) over the same triples with the interval of that.

    Parameters
    ----------
    rows
        Of :func:`training.evaluation.evaluate.evaluate`; no-op baselines come last.
    data
        Which of the paper's data theirs is of: humans (SMPL) or animals (SMAL).
    """
    return _comparison(rows, methods_of(rows), paper.TABLE_1[data], label=f"{THEIRS}, {data}")


def note_1(*, data: paper.PaperData = "SMPL", here: str, emd_points: int) -> str:
    """What stands under Table 1: units, and that theirs is of other data; ``here``: what ours was measured on."""
    meshes = {"SMPL": "SMPL humans of 6,890 vertices, 16 x 400", "SMAL": "SMAL animals of 3,889 vertices, 24 x 300"}
    return (
        f"{_UNITS.format(points=emd_points)} Ours: {here}. Lines marked '{THEIRS}' are the paper's own numbers on "
        f"other data ({meshes[data]} meshes learned for 200 epochs; EMD of an unstated number of points): bodies, "
        "vertex counts and training budget differ, so that they stand here for orientation, not as a target. Some of "
        "its EMD exceed sqrt(3 PMD), which no EMD over the vertices of the PMD can."
    )


def table_2(inference: Mapping[str, Inference]) -> Lines:
    """The paper's Table 2: size of the weights in float32 and time of one pair, ours and, marked, theirs below."""
    lines = [["method", "numbers", "size KiB", "parameters", "mean s a pair", "median s", "fastest to slowest"]]
    for name in _in_papers_order(inference):
        its = inference[name]
        mean = f"{its.mean:.4f}" if its.mean == its.mean else "-"  # not in a file of an earlier version
        cells = [f"{its.kilobytes:,.0f}", f"{its.parameters:,}", mean, f"{its.seconds:.4f}"]
        lines.append([name, "ours", *cells, f"{its.fastest:.4f} to {its.slowest:.4f}"])
        if name in paper.TABLE_2:
            theirs = paper.TABLE_2[name]
            label = f"{THEIRS}, {paper.INFERENCE_DEVICE}"
            lines.append([name, label, f"{theirs.kilobytes:,.0f}", "", f"{theirs.seconds:.4f}", "", ""])
    return lines


def note_2(inference: Mapping[str, Inference]) -> str:
    """What stands under Table 2: on what ours was measured, and that theirs is of another machine."""
    its = next(iter(inference.values()))
    threads = f"{its.threads} thread{'s' if its.threads > 1 else ''}"
    return (
        f"Ours: mean and median of {its.rounds} rounds in which the networks took turns, on one pair of "
        f"{its.source_vertices:,} (source) and {its.target_vertices:,} (target) vertices in float32 on "
        f"{its.device} with {threads}; weights loaded, kernels warm. Lines marked "
        f" '{THEIRS}' are the paper's own, on an {paper.INFERENCE_DEVICE} GPU: "
        "another machine, so that only the order and the ratios of times can be compared."
    )


def table_3(rows: Sequence[Row]) -> Lines:
    """The paper's Table 3: DSFFNet and its ablations, ours and, marked, theirs (SMPL) below; columns as Table 1's.

    One column is added, the edge-length error on unseen poses, which is what the edge loss is for.
    """
    methods = [method for method in methods_of(rows) if method not in NO_OPS]
    return _comparison(rows, methods, paper.TABLE_3, label=f"{THEIRS}, SMPL", more=("edge_ratio",))


def note_3(*, here: str, emd_points: int) -> str:
    """What stands under Table 3."""
    return note_1(here=here, emd_points=emd_points)


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
) -> Lines:
    """Heading and lines of Tables 1 and 3; ``more``: further fields, on the pose type of the spread."""
    pose_type, reference = spread_over(rows), _reference(methods)
    shown = [(its, name) for its in POSE_TYPES for name in _PAPERS_COLUMNS] + [(pose_type, name) for name in more]
    columns = [(its, next(column for column in COLUMNS if column.field == name)) for its, name in shown]
    headings = [f"{its} {column.heading.split()[0]}" for its, column in columns]
    spreads = [f"{pose_type} PMD, 95 %", f"minus {reference}'s, 95 %"]
    lines = [["method", "numbers", *headings, *spreads]]
    for method in _in_papers_order(methods):
        cells = [_mean(rows, method, its, column) for its, column in columns]
        cells += [_interval(_pmd(rows, method, pose_type)), _difference(rows, method, reference, pose_type)]
        lines.append([method, "no-op" if method in NO_OPS else "ours", *cells])
        if _short(method) in theirs:
            lines.append([method, label, *_cells(theirs[_short(method)]), *[""] * (len(more) + 2)])
    return lines


def _cells(scores: paper.SeenUnseen) -> list[str]:
    return [f"{getattr(its, name):.2f}" for its in (scores.seen, scores.unseen) for name in _PAPERS_COLUMNS]


def _short(method: str) -> str:
    """An ablation's name as the paper has it, without the network's."""
    return method.removeprefix(f"{paper.DSFFNET} ")


def _in_papers_order(methods: Iterable[str]) -> list[str]:
    known = [*paper.TABLE_2, *paper.TABLE_3]
    place = {name: known.index(_short(name)) if _short(name) in known else len(known) for name in methods}
    return sorted(place, key=lambda name: (name in NO_OPS, place[name]))


def _reference(methods: Sequence[str]) -> str:
    return paper.DSFFNET if paper.DSFFNET in methods else methods[0]


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
