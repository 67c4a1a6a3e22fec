"""Tables: what they say of rows, the paper's numbers beside ours, and how they are written."""

import math
import re
from typing import Any

import numpy as np
import pytest

from training.evaluation import paper_numbers as paper
from training.evaluation.document import Cell, Table, table_markdown
from training.evaluation.evaluate import NO_OPS, Row
from training.evaluation.statistics import BOOTSTRAP, interval, mean_and_interval
from training.evaluation.tables import emphasised, mean_of, report, summary, table_1, table_2, table_3
from training.evaluation.timing import Inference
from training.recipes.networks import CORENET3D, DSFFNET, NPT


def row(method: str, pose_type: str, triple: int, pmd: float) -> Row:
    return Row(method, pose_type, triple, 0, 0, 1, 1, pmd, pmd, 0.1, 0.2, 3.0, 0.04, 5.0, pmd)


def rows_of(pmd: dict[str, float]) -> list[Row]:
    """Nine triples of each pose type for each method, PMD around a mean and greater for unseen poses."""
    return [
        row(method, pose_type, triple, 1e-4 * (mean + shift + 0.1 * (triple % 3 - 1)))
        for method, mean in pmd.items()
        for pose_type, shift in (("seen", 0), ("unseen", 2))
        for triple in range(9)
    ]


HERE: Any = {"here": "H", "emd_points": 615}


def as_dicts(table: Table) -> list[dict[str, str]]:
    heading, *lines = [[cell.text for cell in line] for line in table.cells]
    return [dict(zip(heading, line, strict=True)) for line in lines]


def bold(table: Table) -> set[str]:
    return {cell.text for line in emphasised(table).cells for cell in line if cell.bold}


COSTS = {
    "NPT": Inference(6_054_941, 23_661.2, 0.21, 0.2, 0.25, 615, 369, 20, 1, "cpu", 0.22),
    "DSFFNet": Inference(9_371_023, 36_616.0, 0.1, 0.09, 0.13, 615, 369, 20, 1, "cpu", 0.11),
    "mine": Inference(1, 0.5, 0.001, 0.001, 0.002, 615, 369, 20, 1, "cpu", 0.001),
}


def test_the_summary_means_what_it_says() -> None:
    rows = [row("DSFFNet", "seen", 0, 1e-4), row("DSFFNet", "seen", 1, 3e-4), row("target unchanged", "seen", 0, 5e-2)]
    assert mean_of(rows, method="DSFFNet", pose_type="seen", field="pmd") == pytest.approx(2e-4)
    lines = summary(rows).lines
    assert lines[1] == ["seen", "DSFFNet", "2.00", "2.00", "2.00", "1000.00", "200.00", "3.0", "0.040", "5.0"]
    assert [line[1] for line in lines[1:]] == ["DSFFNet", "target unchanged"]
    text = report(rows, title="T", about="A.", emd_points=64)
    assert "2 with seen poses" in text and "assignment (exact) of 64 vertices" in text
    assert re.search(r"PMD x1e-4 on seen poses, 95 % intervals .*: DSFFNet 1.00 to 3.00\.", text) and BOOTSTRAP in text
    widths = {len(line) for line in table_markdown(summary(rows)).splitlines()}
    assert len(widths) == 1, "columns line up"


def test_a_method_that_diverged_stays_in_the_table() -> None:
    rows = [*rows_of({"NPT": 3}), row("DSFFNet", "unseen", 0, math.nan), row("DSFFNet", "unseen", 1, 1e-4)]
    assert ["unseen", "DSFFNet", "nan", "nan"] in [list(line[:4]) for line in summary(rows).lines]
    found = as_dicts(table_1(rows, **HERE))
    assert [line["unseen PMD"] for line in found if line["numbers"] == "ours"] == ["5.00", "nan"]
    assert "nan" not in bold(table_1(rows, **HERE))


def test_table_1_shows_ours_and_below_it_theirs_in_the_papers_order() -> None:
    rows = rows_of({"DSFFNet": 1, "NPT": 5, "mine": 4, "target unchanged": 90, "3D-CoreNet": 3})
    found = as_dicts(table_1(rows, **HERE))
    assert [(line["method"], line["numbers"]) for line in found] == [
        (name, numbers) for name in ("NPT", "3D-CoreNet", "DSFFNet") for numbers in ("ours", "paper, SMPL")
    ] + [("mine", "ours"), ("target unchanged", "no-op")]
    assert found[0] | {"seen PMD": "5.00", "seen CD": "1000.00", "seen EMD": "200.00", "unseen PMD": "7.00"} == found[0]
    theirs = found[5]
    assert list(theirs.values())[2:8] == ["0.57", "1.37", "13.40", "1.78", "2.18", "21.44"]
    assert theirs["minus DSFFNet's, 95 %"] == ""
    animals = as_dicts(table_1(rows, data="SMAL", **HERE))[1]
    assert (animals["numbers"], animals["seen PMD"], animals["unseen EMD"]) == ("paper, SMAL", "50.67", "162.48")


def test_spread_is_the_methods_own_interval_and_the_paired_difference() -> None:
    found = {
        line["method"]: line
        for line in as_dicts(table_1(rows_of({"DSFFNet": 1, "NPT": 5}), **HERE))
        if line["numbers"] == "ours"
    }
    low, high = (float(end) for end in found["NPT"]["unseen PMD, 95 %"].split(" to "))
    assert 6.9 <= low < 7 < high <= 7.1
    # the same triples are hard for both, so the difference is known to the digit although the means are not
    assert found["NPT"]["minus DSFFNet's, 95 %"] == "+4.00 (+4.00 to +4.00)"
    assert found["DSFFNet"]["minus DSFFNet's, 95 %"] == ""
    alone = as_dicts(table_1(rows_of({"NPT": 5, "mine": 2}), **HERE))
    assert alone[-1]["minus NPT's, 95 %"] == "-3.00 (-3.00 to -3.00)", "without DSFFNet the first stands for it"


def test_tables_of_seen_poses_alone_have_their_spread_there() -> None:
    seen = [each for each in rows_of({"DSFFNet": 1, "NPT": 5}) if each.pose_type == "seen"]
    line = as_dicts(table_1(seen, **HERE))[0]
    assert line["unseen PMD"] == "-" and line["seen PMD, 95 %"]


def test_table_2_has_sizes_and_times_with_theirs_on_their_gpu() -> None:
    found = as_dicts(table_2(COSTS))
    numbers = ["ours", "paper, RTX 3080"]
    both = [(name, each) for name in ("NPT", "DSFFNet") for each in numbers]
    assert [(line["method"], line["numbers"]) for line in found] == [*both, ("mine", "ours")]
    assert [line["size KiB"] for line in found] == ["23,661", "23,668", "36,616", "36,631", "0"]
    assert [line["mean s a pair"] for line in found] == ["0.2200", "0.0071", "0.1100", "0.0076", "0.0010"]
    assert [line["median s"] for line in found] == ["0.2100", "", "0.1000", "", "0.0010"]
    note = table_2(COSTS).notes
    assert "615 (source) and 369 (target)" in note and "on cpu with 1 thread;" in note and "RTX 3080" in note


def test_table_3_compares_ablations_with_the_papers() -> None:
    rows = rows_of({"DSFFNet": 1, "w/o L_edge": 2, "DSFFNet w/o FFAdaIN": 4, "target unchanged": 90})
    found = as_dicts(table_3(rows, **HERE))
    names = [line["method"] for line in found if line["numbers"] == "ours"]
    assert names == ["DSFFNet", "DSFFNet w/o FFAdaIN", "w/o L_edge"]
    assert [line["unseen PMD"] for line in found] == ["3.00", "1.78", "6.00", "10.72", "4.00", "2.12"]
    assert found[0]["unseen edge"] == "0.040" and found[1]["unseen edge"] == ""


@pytest.mark.parametrize("table", [table_1, table_3])
def test_notes_say_units_points_and_that_the_data_differ(table: Any) -> None:
    note = table(rows_of({"DSFFNet": 1}), **HERE).notes
    for words in ("1e-4", "1e-3", "over 615 vertices", "Ours: H.", "other data", "6,890", "bootstrap", "budget differ"):
        assert words in note
    assert "3,889" in table_1(rows_of({"NPT": 1}), data="SMAL", **HERE).notes


def test_the_papers_numbers_keep_the_bound_where_they_are_said_to_and_sizes_fit_the_parameters() -> None:
    every = {name: scores for table in (*paper.TABLE_1.values(), paper.TABLE_3) for name, scores in table.items()}
    for scores in every.values():
        for its in (scores.seen, scores.unseen):
            assert its.chamfer <= 6 * its.pmd, "CD <= 6 PMD holds of the paper's, as of any"
            assert its.pmd > 0 and scores.seen.pmd < scores.unseen.pmd
    baselines = [paper.TABLE_1["SMPL"][name] for name in (NPT, CORENET3D)]
    assert all(its.seen.earth_mover * 1e-3 > math.sqrt(3e-4 * its.seen.pmd) for its in baselines)
    parameters = {NPT: 6_054_941, CORENET3D: 24_461_447, DSFFNET: 9_371_023}
    for name, cost in paper.TABLE_2.items():
        assert cost.kilobytes == pytest.approx(parameters[name] * 4 / 1024, rel=2e-3)


def test_the_interval_is_of_the_mean_narrows_with_more_values_and_is_the_same_each_time() -> None:
    random, hits = np.random.default_rng(1), 0
    for _ in range(200):
        low, high = interval(random.normal(3, 1, 50).tolist()) or (9, 9)
        hits += low <= 3 <= high
    assert 0.88 <= hits / 200 <= 0.99, "nineteen times in twenty"
    assert interval([1.0]) is None and interval([2.0, 2.0]) == (2.0, 2.0)
    mean, low, high = mean_and_interval([1.0, 3.0] * 5)
    assert mean == 2 and high - low == pytest.approx(2 * 1.96 / math.sqrt(10), rel=0.15), "the normal approximation"
    assert mean_and_interval([4.0]) == (4.0, 4.0, 4.0) and math.isnan(mean_and_interval([])[0])


def test_the_best_of_ours_and_of_theirs_of_seen_and_of_unseen_are_apart_and_no_op_is_one() -> None:
    lines = table_1(rows_of({"DSFFNet": 1, "NPT": 5, "target unchanged": 0}), **HERE)
    assert {"1.00", "3.00", "0.57", "21.44"} <= bold(lines) and not {"5.00", "2.39", "0.00", "2.00"} & bold(lines)
    assert "200.00" not in bold(lines), "EMD of both: what is equal has no best"
    both = bold(summary(rows_of({"DSFFNet": 1, "NPT": 5})))
    assert {"1.00", "3.00"} <= both and not {"5.00", "7.00"} & both


def test_theirs_are_in_italics_in_markdown_that_lines_up() -> None:
    table = emphasised(table_1(rows_of({"DSFFNet": 1, "NPT": 5}), **HERE))
    assert Cell("0.57", bold=True, italic=True) in table.cells[-1]
    text = table_markdown(table)
    assert "**1.00**" in text and "***0.57***" in text and "*2.39*" in text and " 5.00 " in text
    assert len({len(line) for line in text.splitlines()}) == 1


def test_no_ops_are_those_of_the_evaluation() -> None:
    assert all(name.endswith("unchanged") for name in NO_OPS), "tables tell them by it"
