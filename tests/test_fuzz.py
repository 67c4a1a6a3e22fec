"""Whatever is read may be damaged or hostile: a few cases of each family here, thousands in ``make fuzz``.

A case that fails is one again by ``python -m tests.fuzz --case FAMILY:SEED``. See tests/fuzz.
"""

import contextlib
import os
import shutil
import socket
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from datagen.common.errors import DatasetError
from tests.fuzz import watch
from tests.fuzz.runner import Runner, Verdict
from tests.fuzz.specimens import Specimens
from tests.fuzz.structures import SECRET_NAME
from tests.fuzz.targets import FAMILIES, Family, Read, Target

QUICK, MANY = 12, 160
"""Cases of each family: in the default suite, and in the slow one."""


@pytest.fixture(scope="module")
def specimens(tmp_path_factory: pytest.TempPathFactory, _pristine: Path) -> Specimens:
    return Specimens(tmp_path_factory.mktemp("specimens"), dataset=_pristine)


@pytest.fixture
def runner(specimens: Specimens, tmp_path: Path) -> Runner:
    return Runner(tmp_path, specimens)


def failures(verdicts: list[Verdict]) -> str:
    return "\n".join(str(verdict) for verdict in verdicts if verdict.findings)


@pytest.mark.parametrize("family", [name for name, each in FAMILIES.items() if any(t.is_quick for t in each.targets)])
def test_what_is_damaged_or_hostile_is_read_whole_or_refused_in_one_line(runner: Runner, family: str) -> None:
    found = failures([runner.run(family, seed, quick=True) for seed in range(QUICK)])
    assert not found, found


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("family", FAMILIES)
def test_many_cases_of(runner: Runner, family: str) -> None:
    found = failures([runner.run(family, seed) for seed in range(1000, 1000 + MANY)])
    assert not found, found


def _raising(error: BaseException) -> Read:
    def read(tree: Path) -> str | None:
        raise error

    return read


def _canary(tree: Path) -> Path:
    return tree.parent.parent / "canary"


def _remove_the_canary(tree: Path) -> None:
    shutil.rmtree(_canary(tree))


def _follow_a_link(tree: Path) -> None:
    (tree.parent / "link").symlink_to(_canary(tree) / "secret.txt")
    (tree.parent / "link").read_bytes()


def _read_and_pass_over(tree: Path) -> None:
    with contextlib.suppress(BaseException):
        (_canary(tree) / "secret.txt").read_text()


def _fail_with(text: str) -> Read:
    def read(tree: Path) -> str | None:
        sys.stderr.write(text)
        sys.exit(1)

    return read


MISDEEDS: dict[str, tuple[Read, str]] = {
    "another exception": (_raising(KeyError("x")), "KeyError"),
    "no memory": (_raising(MemoryError()), "MemoryError"),
    "memory as the only bound": (_raising(DatasetError("Unable to allocate 9 TiB")), "memory was the only bound"),
    "another status": (_raising(SystemExit(3)), "status 3"),
    "no line": (_fail_with(""), "0 lines"),
    "two lines": (_fail_with("error: one\nerror: two\n"), "2 lines"),
    "a traceback": (_fail_with("Traceback (most recent call last):\nerror: one\n"), "traceback"),
    "control characters": (_fail_with("error: \x1b[2J\n"), "control characters"),
    "removed": (_remove_the_canary, "changes what is outside"),
    "written": (lambda tree: str((_canary(tree) / "made").write_text("x")), "changes what is outside"),
    "read": (lambda tree: (_canary(tree) / "secret.txt").read_text(), "reads what is outside"),
    "read by a link": (_follow_a_link, "reads what is outside"),
    "read and passed over": (_read_and_pass_over, "reads what is outside"),
    "listed": (lambda tree: str(os.listdir(_canary(tree))), "reads what is outside"),
    "told": (lambda tree: print(os.environ[SECRET_NAME]), "secret"),
    "started": (lambda tree: str(os.system("true")), "starts a process"),
    "asked": (lambda tree: str(socket.getaddrinfo("localhost", 9)), "asks a server"),
    "memory": (lambda tree: str(np.ones(watch.MEMORY // 4).sum()), "memory rose"),
    "time": (lambda tree: time.sleep(60), "no end"),
    "another content": (lambda tree: "another", "not what was stored"),
}


@pytest.mark.parametrize("misdeed", MISDEEDS)
def test_the_fuzzer_sees(runner: Runner, monkeypatch: pytest.MonkeyPatch, misdeed: str) -> None:
    read, expected = MISDEEDS[misdeed]
    calls: list[Path] = []

    def well_at_first(tree: Path) -> str | None:
        """The undamaged tree must be read with success."""
        calls.append(tree)
        return read(tree) if len(calls) > 1 else "stored"

    monkeypatch.setattr(watch, "WALL_SECONDS", 0.2)
    monkeypatch.setitem(FAMILIES, "own", Family("plain", "mesh.obj", (Target("own", well_at_first),)))
    verdict = runner.run("own", 0)  # its hashes are not made to fit
    assert "hashes" not in " ".join(verdict.damage)
    assert any(expected in finding.what for finding in verdict.findings), str(verdict)


def test_a_case_is_the_same_again(runner: Runner) -> None:
    first, again = (runner.run("mesh", 7, quick=True) for _ in range(2))
    assert (first.damage, first.target) == (again.damage, again.target)
