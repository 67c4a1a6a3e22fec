"""RUN/provenance.json: what a training noted of its software, machine and data before it began."""

import json
import os
import platform
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, TypeAdapter
from typing_extensions import TypedDict

from datagen.common.assets import git
from datagen.common.files import read_json_if_whole, write_atomically

FILE = "provenance.json"


class Provenance(TypedDict, total=False):
    """What is noted; :func:`training.inference.domain_check.noted` says what ``seen`` holds."""

    __pydantic_config__ = ConfigDict(strict=True)  # type: ignore[misc]

    dataset: dict[str, str]
    seen: dict[str, Any] | None
    data_provenance: dict[str, Any]
    python: str
    torch: str
    machine: str
    hardware: dict[str, str]
    git_commit: str


_PROVENANCE = TypeAdapter(Provenance)


def provenance_of(run: Path) -> Provenance:
    """What a training noted; empty where it noted nothing or, with a warning, where that is unreadable."""
    return read_json_if_whole(run, FILE, _PROVENANCE) or Provenance()


def write_run_head(run: Path, recipe: dict[str, Any], **about: Any) -> None:
    """Write RUN/recipe.yaml (what is trained) and RUN/provenance.json (with what, on what data: ``about``)."""
    import torch
    import yaml

    write_atomically(run / "recipe.yaml", yaml.safe_dump(recipe, sort_keys=False).encode())
    provenance = {
        **about,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "machine": f"{platform.machine()} {platform.system()}",
        "hardware": this_machine(),
        "git_commit": this_commit(),
    }
    write_atomically(run / FILE, json.dumps(provenance, indent=1).encode())


def this_machine() -> dict[str, str]:
    """Processor, memory, system and GPUs of this machine, for people; no name that would tell whose it is."""
    import psutil  # a registered model, which reads the notes of others, comes without it

    facts = {
        "processor": f"{_processor()}, {cores()} cores",
        "memory": f"{psutil.virtual_memory().total / 2**30:.0f} GiB",
        "GPU": _gpus(),
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
    }
    return {name: fact for name, fact in facts.items() if fact}


@cache
def this_commit() -> str:
    """The commit of the code that is running, and whether files differ from it; "unknown" for an installed copy."""
    commit = git("rev-parse", "HEAD")
    if not commit:
        return "unknown"
    return f"{commit} with local changes" if git("status", "--porcelain", "--untracked-files=no") else commit


def _processor() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _gpus() -> str:
    import torch

    if not torch.cuda.is_available():
        return ""
    names = [torch.cuda.get_device_name(place) for place in range(torch.cuda.device_count())]
    return ", ".join(f"{names.count(name)} x {name}" for name in dict.fromkeys(names))
