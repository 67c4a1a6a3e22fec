"""The ``dsffnet`` command and the workflow scripts as processes of their own."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def command(
    *arguments: object, script: str = "dsffnet", folder: Path = ROOT, **environment: str
) -> subprocess.CompletedProcess[str]:
    start = ["-m", "workflows"] if script == "dsffnet" else [str(ROOT / "workflows" / script)]
    return subprocess.run(
        [sys.executable, *start, *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=120,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        check=False,
    )


def fails(result: subprocess.CompletedProcess[str], status: int, *says: str) -> None:
    """One line on standard error that begins with ``error:``, the status, and no traceback."""
    assert result.returncode == status, result.stderr
    errors = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and "Traceback" not in result.stderr, result.stderr
    for text in says:
        assert text in errors[0]
