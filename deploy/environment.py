"""Bring .venv up to date with constraints.txt; ``make`` calls it with the interpreter that .venv is made by.

uv installs where it is on the path, else pip; what is fetched is said, and a line of progress at least every five
seconds. Without a GPU on Linux, torch comes from PyTorch's own index of CPU builds, if that answers: PyPI's brings some
3 GB of CUDA. Standard library only: nothing else is there yet.
"""

import os
import platform
import re
import shutil
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterable, Iterator
from pathlib import Path

CPU_INDEX = "https://download.pytorch.org/whl/cpu"
VENV = Path(".venv")
WHAT = ["--constraint", "constraints.txt", "--editable", ".[dev]", "--requirement", "deploy/requirements.txt"]
_SIZE = re.compile(r"^ *Downloading (?!\S+\.metadata )(\S+) \(([\d.]+) ?([kKMG]i?B)\)")  # pip: (4.3 MB), uv: (4.3MiB)
_MEGABYTES = {"kB": 1e-3, "KiB": 1.024e-3, "MB": 1.0, "MiB": 1.048576, "GB": 1e3, "GiB": 1073.741824}


def main() -> int:
    """Make or update the environment; returns the installer's exit status."""
    began, python = time.monotonic(), VENV / "bin" / "python"
    if not (VENV / ".ready").exists():
        say(f"making .venv with Python {platform.python_version()} and the packages of constraints.txt")
        if subprocess.run([sys.executable, "-m", "venv", "--clear", str(VENV)], check=False).returncode:
            say(f"{sys.executable} makes no virtual environment; on Debian and Ubuntu install python3-venv")
            return 1
    (VENV / ".ready").unlink(missing_ok=True)
    command = installer(python)
    status = followed(command)
    if status and command[0] != str(python):
        say("uv could not install them; pip tries")
        status = followed(by_pip(python))
    if status == 0 and sys.dont_write_bytecode:
        compile_packages(python)
    if status == 0:
        (VENV / ".ready").touch()
        say(f"{installed()} packages in .venv, after {time.monotonic() - began:.0f} s")
    else:
        say("the packages could not be installed; the same command resumes from what was fetched")
    return status


def compile_packages(python: Path) -> None:
    """Compile them once, where PYTHONDONTWRITEBYTECODE is set as in some containers; each command would, else."""
    say("compiling the packages, a minute or less: Python is told to keep nothing of what it compiles later")
    packages = next((VENV / "lib").glob("python3*/site-packages"))
    command = [str(python), "-m", "compileall", "-q", "-q", "-j", "0", str(packages)]
    subprocess.run(command, check=False)  # some hold templates, and code for other versions of Python


def installer(python: Path) -> list[str]:
    """The command that installs: uv, unless pip was told of other indexes, which uv does not know of."""
    asked, uv = os.environ.get("TORCH_INDEX", ""), shutil.which("uv")
    if uv and not has_own_indexes(python):
        say("uv installs; packages that it fetched before are taken from its cache")
        torch = ["--torch-backend", "cpu"] if not asked and cpu_index() else []
        torch += ["--index", asked, "--index-strategy", "unsafe-best-match"] if asked else []
        return [uv, "pip", "install", "--python", str(python), *torch, *WHAT]
    return by_pip(python)


def by_pip(python: Path) -> list[str]:
    """The command by which pip installs."""
    index = os.environ.get("TORCH_INDEX", "") or ("" if has_own_indexes(python) else cpu_index())
    if index:
        say(f"torch is looked for at {index}, too")
    # Python compiles what is imported; pip would compile everything, which is most of the time that it takes
    flags = [
        "--disable-pip-version-check",
        "--progress-bar",
        "off",
        "--no-compile",
        *(["--extra-index-url", index] if index else []),
    ]
    return [str(python), "-m", "pip", "install", *flags, *WHAT]


def has_own_indexes(python: Path) -> bool:
    """Whether pip's configuration or environment names where packages are: it is trusted alone then."""
    listed = subprocess.run([str(python), "-m", "pip", "config", "list"], capture_output=True, text=True, check=False)
    return bool(re.search(r"\.(index-url|extra-index-url|find-links|no-index)=", listed.stdout))


def cpu_index() -> str:
    """PyTorch's index of CPU builds, on Linux without a GPU, if it answers; else nothing."""
    if sys.platform != "linux" or shutil.which("nvidia-smi"):
        return ""
    try:
        with urllib.request.urlopen(f"{CPU_INDEX}/torch/", timeout=5):
            return CPU_INDEX
    except OSError:
        say(f"{CPU_INDEX} does not answer: torch comes from PyPI, with CUDA (some 3 GB)")
        return ""


def followed(command: list[str]) -> int:
    """Run an installer, and say what it fetches and how far it is; its last words if it fails."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace") as it:
        assert it.stdout is not None
        progress = Progress()
        words = list(progress.of(it.stdout))
    progress.end()
    if it.returncode:
        print("".join(words[-15:]), file=sys.stderr, end="")
    return it.returncode


class Progress:
    """A line every few seconds, as long as lines of an installer are read: what it did last, MB, packages, seconds."""

    def __init__(self, every: float = 5.0) -> None:
        self._began, self._fetched, self._megabytes, self._last = time.monotonic(), 0, 0.0, "resolving"
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._tell, args=(every,), daemon=True)
        self._thread.start()

    def of(self, lines: Iterable[str]) -> Iterator[str]:
        """Yield the lines, and note what they tell."""
        for line in lines:
            if found := _SIZE.match(line):
                self._fetched, self._megabytes = (
                    self._fetched + 1,
                    self._megabytes + float(found[2]) * _MEGABYTES[found[3]],
                )
                self._last = f"fetching {found[1].rpartition('/')[2]} ({found[2]} {found[3]})"
            elif line.startswith("Installing collected packages"):
                self._last = f"installing {line.count(',') + 1} packages"
            elif line.startswith(("Resolved ", "Prepared ", "Installed ")):  # uv
                self._last = line.strip()
            yield line

    def end(self) -> None:
        """Say no more."""
        self._ended.set()
        self._thread.join()

    def _tell(self, every: float) -> None:
        while not self._ended.wait(every):
            fetched = f"{self._fetched} files of {self._megabytes:.0f} MB fetched"
            say(f"{time.monotonic() - self._began:.0f} s, {fetched}, {installed()} installed: {self._last}")


def installed() -> int:
    """How many packages are in the environment."""
    return len(list(VENV.glob("lib/python*/site-packages/*.dist-info")))


def say(text: str) -> None:
    """One line, at once."""
    print(f"environment: {text}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
