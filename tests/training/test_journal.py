"""The journal: whole lines only, no gaps, no duplicates."""

from pathlib import Path

from training.journal import Journal, journal_from, read_journal


def test_lines_come_back(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "m.jsonl")
    journal.write(1, {"loss": 0.5})
    journal.write(2, {"loss": 0.25, "rate": 1.0})
    journal.close()
    rows = read_journal(tmp_path / "m.jsonl")
    assert [(row["step"], row["loss"]) for row in rows] == [(1, 0.5), (2, 0.25)]
    assert rows[0]["time"] <= rows[1]["time"]


def test_a_resumed_run_does_not_write_steps_twice(tmp_path: Path) -> None:
    for first, last in ((1, 6), (4, 9)):
        journal = Journal(tmp_path / "m.jsonl")
        for step in range(first, last):
            journal.write(step, {"loss": float(step)})
        journal.close()
    assert [row["step"] for row in read_journal(tmp_path / "m.jsonl")] == list(range(1, 9))


def test_a_torn_last_line_is_dropped_and_written_again(tmp_path: Path) -> None:
    path = tmp_path / "m.jsonl"
    path.write_text('{"step": 1, "time": 0, "loss": 1}\n{"step": 2, "ti')
    assert [row["step"] for row in read_journal(path)] == [1]
    journal = Journal(path)
    journal.write(2, {"loss": 2.0})
    journal.close()
    assert [row["step"] for row in read_journal(path)] == [1, 2]


def test_reading_from_an_offset_goes_on_where_it_was(tmp_path: Path) -> None:
    path = tmp_path / "m.jsonl"
    journal = Journal(path)
    journal.write(1, {"loss": 1.0})
    (offset, _), = journal_from(path, 0)  # fmt: skip
    journal.write(2, {"loss": 2.0})
    assert [row["step"] for _, row in journal_from(path, offset)] == [2]
    assert list(journal_from(tmp_path / "none.jsonl", 0)) == []
