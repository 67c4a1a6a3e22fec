"""The benchmarks run: on a GPU machine there is no time to find out that they do not."""

import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from benchmarks.networks import gpu
from benchmarks.networks.running import backward, gradient, random_meshes, relative, step, with_every_branch
from training.networks.dsffnet import DSFFNet

ROOT = Path(__file__).parents[2]
BARE = """
import runpy, sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in sys.argv[1].split(","):
            raise ModuleNotFoundError(f"{name} is not on this machine")
sys.meta_path.insert(0, Absent())
del sys.argv[0]
runpy.run_module("benchmarks.networks.gpu", run_name="__main__", alter_sys=True)
"""
ABSENT = "anny,blake3,google_crc32c,matplotlib,mlflow,numcodecs,pandas,pydantic,ray,safetensors,smplx,trimesh,yaml,zarr"
TINY = ["--device", "cpu", "--vertices", "60", "--batches", "2", "--narrow"]


def run(*arguments: str, timeout: float = 280) -> str:
    done = subprocess.run(
        [sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=timeout, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def differences(line: str) -> list[float]:
    return [float(number) for number in re.findall(r"\d\.\de[-+]\d\d", line)]


def line_of(printed: str, *words: str) -> str:
    found = [line for line in printed.splitlines() if line.split()[: len(words)] == list(words)]
    assert len(found) == 1, printed
    return found[0]


def test_the_gpu_benchmark_runs_where_there_is_torch_and_little_else() -> None:
    printed = run("-c", BARE, ABSENT, *TINY, "--no-compile")
    assert "compiled" not in printed
    largest, pmd, slope = differences(line_of(printed, "fast", "on", "cpu", "and", "literal"))
    assert 0 < largest < 1e-5 and 0 < pmd < 1e-10 and 0 < slope < 1e-4
    assert differences(line_of(printed, "fast", "in", "bfloat16"))[0] > 1e-4
    assert "called" in line_of(printed, "fast", "bfloat16")
    assert 0 < differences(line_of(printed, "forward", "fast", "float32"))[0] < 1e-5
    assert 0 < differences(line_of(printed, "step", "fast", "float32"))[0] < 1e-4


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_gpu_benchmark_measures_the_compiled_form_too() -> None:
    printed = run("-c", BARE, ABSENT, *TINY, "--precisions", "float32", timeout=850)
    assert "called" in line_of(printed, "compiled", "float32")
    assert 0 < differences(line_of(printed, "forward", "compiled", "float32"))[0] < 1e-5
    assert 0 < differences(line_of(printed, "step", "compiled", "float32"))[0] < 1e-4


def test_what_fails_is_said_and_the_rest_goes_on(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def exhausted(*_: object) -> None:
        raise torch.OutOfMemoryError("too large")

    def broken(*_: object) -> None:
        raise RuntimeError("no such kernel\nand more")

    monkeypatch.setattr(sys, "argv", ["gpu", *TINY, "--no-compile", "--precisions", "float32"])
    monkeypatch.setattr(gpu, "gradient", exhausted)
    monkeypatch.setattr(gpu, "single_pair", broken)
    assert gpu.main() == 1
    printed = capsys.readouterr().out
    assert line_of(printed, "step", "fast").endswith("out of memory")
    assert line_of(printed, "fast", "float32").endswith("failed: RuntimeError: no such kernel")
    assert "x)" in line_of(printed, "forward", "fast")


def test_nothing_is_begun_after_the_minutes_that_were_given(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["gpu", *TINY, "--no-compile", "--precisions", "float32", "--minutes", "0"])
    assert gpu.main() == 0
    printed = capsys.readouterr().out
    assert line_of(printed, "step", "literal").endswith("left out: the minutes are up")


def test_the_network_benchmark_says_how_far_forms_are_apart_and_what_the_losses_take() -> None:
    printed = run("-m", "benchmarks.networks.forms", "--quick", "--threads", "1")
    exact, rounded = differences(line_of(printed, "forward"))
    assert 0 < exact < 1e-5 < rounded
    exact, rounded = differences(line_of(printed, "step"))
    assert 0 < exact < 1e-3 < rounded
    share = re.search(r"([\d.]+)% of the step of fast,", line_of(printed, "losses"))
    assert share and 0 < float(share[1]) < 50


def test_the_memory_of_a_step_is_measured_in_a_process_of_its_own() -> None:
    mebibytes = float(run("-m", "benchmarks.networks.forms", "--memory", "fast", "--vertices", "60"))
    weights = 9_371_023 * 4 / 2**20
    assert weights / 8 < mebibytes < 40 * weights  # gradients, some of which are there before; kernels differ


def test_a_step_leaves_no_gradients_and_differences_are_seen() -> None:
    cpu = torch.device("cpu")
    network, meshes = DSFFNet(encoder_widths=(8, 8, 8), decoder_widths=(8, 8, 8)), random_meshes(2, 20, cpu)
    assert network.decoder.block1.norm1.alpha == 0 and with_every_branch(network).decoder.block1.norm1.alpha > 0
    first = gradient(network, "float32", meshes)
    assert relative(first, first) == 0 and all(own.grad is None for own in network.parameters())
    backward(network, "float32", meshes)
    assert network.decoder.out.weight.grad is not None
    step(network, "float32", torch.optim.SGD(network.parameters(), lr=0.1), meshes)
    assert all(own.grad is None for own in network.parameters())
    assert relative(gradient(network, "float32", meshes), first) > 1e-6


@pytest.mark.parametrize("module", sorted((ROOT / "benchmarks").rglob("[a-z]*.py")), ids=lambda path: path.stem)
def test_every_benchmark_finds_what_it_imports(module: Path) -> None:
    importlib.import_module(".".join(module.relative_to(ROOT).with_suffix("").parts))
