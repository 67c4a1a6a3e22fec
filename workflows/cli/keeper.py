"""Run a command of several processes and end all of them when standard input ends.

    python -m workflows.cli.keeper COMMAND ...

Whoever starts this gives it a session of its own and a pipe. The pipe ends when that process closes it and, SIGKILL
included, when that process dies. What the command leaves running when it ends by itself is ended too.
"""

import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress

_END_SECONDS = 5.0


def keep(command: list[str]) -> int:
    """Return the command's exit status; where standard input ends first, this process is killed with its group."""
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the group's; the command was started before and does not inherit it
    threading.Thread(target=_end_group_with_input, args=(process,), daemon=True).start()
    status = process.wait()
    os.killpg(0, signal.SIGTERM)
    return status


def _end_group_with_input(process: "subprocess.Popen[bytes]") -> None:
    while os.read(0, 4096):  # not by sys.stdin, whose lock would be held when the interpreter ends
        pass
    os.killpg(0, signal.SIGTERM)
    with suppress(subprocess.TimeoutExpired):
        process.wait(_END_SECONDS)
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(keep(sys.argv[1:]))
