"""Warp says nothing of devices, whichever of the modules that use it is imported first."""

import subprocess
import sys

import pytest

from tests.support.commands import ROOT


@pytest.mark.parametrize("module", ["datagen.bodies.clothed.draping", "training.avatar.solid"])
def test_nothing_is_said_when_it_begins(module: str) -> None:
    code = f"import {module}, warp; print(float(warp.ones(3, device='cpu').numpy().sum()))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("3.0\n", "")
