"""docker-compose.yml as the tests see it: variables at their defaults (or as given), merged, as plain data."""

import re
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]
RAY_SERVICES = ("ray-head", "ray-worker", "client")

Service = dict[str, Any]


def load(name: str = "docker-compose.yml", **variables: str) -> dict[str, Any]:
    """Read a Compose file of this project.

    Only the form ``${NAME:-default}`` is understood, any other is an error: every setting of the file has a default.
    """
    text = (ROOT / name).read_text()
    text = re.sub(r"\$\{(\w+):-([^}]*)\}", lambda match: variables.get(match[1], match[2]), text)
    if "${" in text:
        raise ValueError(f"{name} has a variable without a default: {text[text.index('${') :][:40]!r}")
    content: dict[str, Any] = yaml.safe_load(text)
    return content


def services(**variables: str) -> dict[str, Service]:
    found: dict[str, Service] = load(**variables)["services"]
    return found


def option(command: list[str], flag: str) -> str:
    """The value of ``--flag=value`` or ``--flag value`` in a command."""
    for position, argument in enumerate(command):
        if argument == flag:
            return command[position + 1]
        if argument.startswith(f"{flag}="):
            return argument.partition("=")[2]
    raise KeyError(f"{flag} is not in {command}")
