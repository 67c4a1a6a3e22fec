"""Records: those that a process has begun and not ended can all be ended at once."""

from pathlib import Path

import pytest

from training.tracking import record
from training.tracking.record import begin_record, end_record, fail_begun, read_record


def test_what_has_begun_and_not_ended_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record, "_begun", set())
    places = {name: tmp_path / name for name in ("ended", "going", "removed")}
    for name, place in places.items():
        place.mkdir()
        begin_record(place, name=name, kind="train", parent=None, parameters={})
    end_record(places["ended"], "FINISHED")
    (places["removed"] / "record.json").unlink()
    fail_begun()
    ended, going = (read_record(places[name]) for name in ("ended", "going"))
    assert ended is not None and ended.status == "FINISHED"
    assert going is not None and going.status == "FAILED" and going.ended is not None
    assert not (places["removed"] / "record.json").exists()
    end_record(places["going"], "KILLED")
    assert read_record(places["going"]) == going, "by the interruption that follows"
    assert begin_record(places["going"], name="going", kind="train", parent=None, parameters={}).status == "RUNNING"
    end_record(places["going"], "FINISHED")
    again = read_record(places["going"])
    assert again is not None and again.status == "FINISHED"
