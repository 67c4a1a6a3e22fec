"""Assets: what data was made from, by name, licence and hash."""

import hashlib
from pathlib import Path

import pytest

from datagen.common.assets import file_asset
from datagen.common.errors import BodyError


def test_a_file_is_known_by_its_bytes(tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(b"content")
    asset = file_asset(tmp_path / "a.npz", licence="mine")
    assert asset.name == "a.npz" and asset.version == f"sha256:{hashlib.sha256(b'content').hexdigest()}"


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    for place in (tmp_path / "none.npz", tmp_path):
        with pytest.raises(BodyError, match=f"{place}.* cannot be read .*name another in the recipe"):
            file_asset(place, licence="mine")
