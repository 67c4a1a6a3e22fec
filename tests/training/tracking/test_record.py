"""Records: those that a process has begun and not ended can all be ended at once."""

from pathlib import Path

from training.tracking.record import begin_record, end_record, fail_begun, read_record


def test_what_has_begun_and_not_ended_fails(tmp_path: Path) -> None:
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
