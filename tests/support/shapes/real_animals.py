"""The CC0 animals for tests that want the real ones."""

from pathlib import Path

import pytest

from datagen.characters.cc0_animals import animal_files
from datagen.common.errors import DsffnetError


def require_animals() -> Path:
    """Their folder; the test is skipped where they are neither cached nor to be had."""
    try:
        return animal_files()[0].parent
    except DsffnetError as error:
        pytest.skip(f"no animals: {error}")
