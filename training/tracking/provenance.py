"""RUN/provenance.json: what a training noted of its software, machine and data before it began."""

from pathlib import Path
from typing import Any

from pydantic import ConfigDict, TypeAdapter
from typing_extensions import TypedDict

from datagen.common.json_files import read_json_if_whole

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
