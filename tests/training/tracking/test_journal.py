"""The journal: whole lines only, no gaps, no duplicates."""

from pathlib import Path

import pytest
import torch
from torch import nn

from datagen.common.errors import StorageError, UnsafeFileError
from tests.support.disk import small_disk
from training.networks import NETWORKS
from training.tracking.journal import Journal, coefficient_metrics, journal_from, read_journal


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


@pytest.mark.parametrize(
    "line",
    [
        b"garbage", b"null", b"[1]", b"\xff\xfe", bytes(100), b'{"time": 1}', b'{"step": "x"}', b'{"step": -1}',
        b'{"step": 2, "loss": "low"}', b'{"step": 1' + b"0" * 30 + b"}", b'{"step": 2, "time": 1e300}', b"[" * 5000,
        b'{"step": 2, "loss": {}}', b'{"step": true}',
    ],
)  # fmt: skip
def test_a_line_of_garbage_is_left_out_with_one_warning(
    tmp_path: Path, line: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "m.jsonl"
    path.write_bytes(b'{"step": 1, "time": 0}\n' + (line + b"\n") * 2 + b'{"step": 3, "time": 0}\n')
    assert [row["step"] for row in read_journal(path)] == [1, 3]
    journal = Journal(path)
    journal.write(4, {"loss": 1.0})
    journal.close()
    assert [row["step"] for row in read_journal(path)] == [1, 3, 4] and len(caplog.messages) == 1


def test_a_long_torn_end_is_dropped(tmp_path: Path) -> None:
    path = tmp_path / "m.jsonl"
    for whole in (b"", b'{"step": 1, "time": 0}\n'):
        path.write_bytes(whole + bytes(200_000))
        Journal(path).close()
        assert path.read_bytes() == whole


def test_what_has_no_lines_is_not_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "m.jsonl"
    with path.open("wb") as file:
        file.write(b'{"step": 1, "time": 0}\n')
        file.truncate(2**40)  # a terabyte without a line's end
    assert [row["step"] for row in read_journal(path)] == [1]
    Journal(path).close()
    assert path.stat().st_size == len(b'{"step": 1, "time": 0}\n')


def test_a_journal_elsewhere_is_neither_read_nor_written(tmp_path: Path) -> None:
    other, path = tmp_path / "other", tmp_path / "run" / "m.jsonl"
    other.write_bytes(b'{"step": 1, "time": 0}\ntorn')
    path.parent.mkdir()
    path.symlink_to(other)
    for opened in (read_journal, Journal):
        with pytest.raises(UnsafeFileError, match="link that leads out of it"):
            opened(path)
    assert other.read_bytes().endswith(b"torn")


def test_reading_from_an_offset_goes_on_where_it_was(tmp_path: Path) -> None:
    path = tmp_path / "m.jsonl"
    journal = Journal(path)
    journal.write(1, {"loss": 1.0})
    (offset, _), = journal_from(path, 0)  # fmt: skip
    journal.write(2, {"loss": 2.0})
    assert [row["step"] for _, row in journal_from(path, offset)] == [2]
    assert list(journal_from(tmp_path / "none.jsonl", 0)) == []


def test_a_line_is_there_for_others_at_once(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "m.jsonl")
    journal.write(1, {"loss": 1.0})
    journal.sync()
    assert len(read_journal(tmp_path / "m.jsonl")) == 1
    journal.close()


def test_a_full_disk_is_one_error_and_no_torn_line_stays(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", kibibytes=100) as disk:
        journal = Journal(disk / "m.jsonl")
        with pytest.raises(StorageError, match=r"could not write .*m\.jsonl: No space left on device"):
            for step in range(10_000):
                journal.write(step, {"loss": 0.1234567})
        journal.close()
        whole = read_journal(disk / "m.jsonl")
        journal = Journal(disk / "m.jsonl")
        assert journal.next_step == len(whole) and (disk / "m.jsonl").read_bytes().endswith(b"\n")
        journal.close()


def test_coefficients_under_the_names_of_their_curves() -> None:
    network = NETWORKS["dsffnet"](encoder_widths=(4, 4, 4), decoder_widths=(4, 4, 4))
    with torch.no_grad():
        network.get_parameter("decoder.block1.norm2.alpha").fill_(0.5)
    found = coefficient_metrics(network)
    assert found["modulation/alpha/block1.norm2"] == 0.5 and found["modulation/beta/block3.norm1"] == 0.0
    assert len(found) == 12
    assert coefficient_metrics(nn.ModuleDict({"module": network})["module"]) == found
    assert coefficient_metrics(nn.Linear(2, 2)) == {}


def test_a_link_to_what_is_not_there_yet_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "metrics.jsonl").symlink_to(tmp_path / "victim")
    with pytest.raises(UnsafeFileError, match="link"):
        Journal(tmp_path / "run" / "metrics.jsonl")
    assert not (tmp_path / "victim").exists()
