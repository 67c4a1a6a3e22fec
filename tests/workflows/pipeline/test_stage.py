"""Stages: done once, done again when what they depend on changes or their outputs are gone."""

from pathlib import Path

import pytest

from workflows.pipeline.stage import Stage, run_stage


def test_skipping(tmp_path: Path) -> None:
    output, log = tmp_path / "output", []

    def stage(depends_on: object) -> Stage:
        return Stage("make", depends_on, intact=output.exists, work=lambda: (output.touch(), log.append("work")))

    def run(depends_on: object) -> bool:
        return run_stage(stage(depends_on), out=tmp_path, before=lambda: log.append("before"))

    assert run({"a": 1}) and log == ["before", "work"]
    assert not run({"a": 1}), "finished before"
    assert run({"a": 2}), "it depends on something else now"
    output.unlink()
    assert run({"a": 2}), "its output is gone"
    assert len(log) == 6


def test_a_stage_that_fails_is_due_again(tmp_path: Path) -> None:
    def fail() -> None:
        raise RuntimeError

    for _ in range(2):
        try:
            run_stage(Stage("make", 1, intact=lambda: True, work=fail), out=tmp_path, before=lambda: None)
        except RuntimeError:
            continue
        raise AssertionError("it was skipped although it never finished")


@pytest.mark.parametrize(
    "mark", [b"", b"{ torn", b"null", b"[1]", b"{}", b'{"fingerprint": 1}', b"\xff", b"[" * 5000 + b"]" * 5000]
)
def test_a_damaged_mark_means_due(tmp_path: Path, mark: bytes) -> None:
    stage = Stage("make", 1, intact=lambda: True, work=lambda: None)
    assert run_stage(stage, out=tmp_path, before=lambda: None)
    (tmp_path / "stages" / "make.json").write_bytes(mark)
    assert run_stage(stage, out=tmp_path, before=lambda: None)
    assert not run_stage(stage, out=tmp_path, before=lambda: None), "it is whole again"
