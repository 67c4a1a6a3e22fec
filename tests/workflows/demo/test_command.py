"""``dsffnet demo`` before any page: a port that is taken, and a command line that stays light."""

import socket
import subprocess
import sys
import time

import pytest

from workflows.cli import main as cli
from workflows.cli.demo import saying_what_it_does
from workflows.demo.bodies import ANIMALS_MISSING


def test_a_port_that_is_taken_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(SystemExit) as ended:
            cli.main(["demo", "--port", str(port)])
    said = capsys.readouterr().err
    assert ended.value.code == 1 and said.count("\n") == 1
    assert f"port {port} of 127.0.0.1 cannot be used" in said and f"dsffnet demo --port {port + 1}" in said


@pytest.mark.parametrize("port", ["65535", "99999"])
def test_the_other_port_that_is_named_is_one(port: str, monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(socket.socket, "bind", lambda *_: (_ for _ in ()).throw(OverflowError("0-65535")))
    with pytest.raises(SystemExit):
        cli.main(["demo", "--port", port])
    assert capsys.readouterr().err.endswith("Another: dsffnet demo --port 8080\n")


def test_weights_that_are_not_there_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["demo", "--port", "0", "--model", "no-such-run"])
    assert "these come along: animals" in capsys.readouterr().err


def test_animals_come_by_a_command_that_there_is() -> None:
    command = ANIMALS_MISSING.split("`")[1].split()
    assert command[0] == "dsffnet" and cli.parsed(command[1:]).kind == "animals"


def test_other_commands_do_not_import_it() -> None:
    look = "import sys; from workflows.cli.main import parsed; parsed(['demo']); print('viser' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True).stdout == "False\n"


def test_long_work_is_not_silent(capsys: pytest.CaptureFixture[str]) -> None:
    with saying_what_it_does(seconds=0.02) as say:
        say("reading people")
        time.sleep(0.3)
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "reading people ..." and said[1].startswith("still reading people: 0 s")
    time.sleep(0.1)
    assert not capsys.readouterr().out
