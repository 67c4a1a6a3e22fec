"""The files of an outfit's folder come back as they were written, and others are refused in one line."""

from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.common.errors import CheckpointError
from tests.support.shapes.outfits import drawn_outfit, stockinged
from training.avatar.outfit import OccupancySamples, Outfit, SurfaceSamples, outfits_in
from training.avatar.subject import Subject, posed_by


def test_a_subject_comes_back_as_it_was(tmp_path: Path) -> None:
    subject = stockinged()
    subject.save(tmp_path / "new" / "subject.safetensors")
    found = Subject.load(tmp_path / "new" / "subject.safetensors")
    for name in ("scans", "faces", "parts", "transforms", "rotations", "is_seen"):
        assert np.array_equal(getattr(found, name), getattr(subject, name))
    assert found.name == "stocking" and vars(found.body).keys() == vars(subject.body).keys()
    assert found.body.names == subject.body.names and found.body.drivers == subject.body.drivers
    assert np.array_equal(found.body.weights, subject.body.weights)
    assert found.seen == [0, 1, 2] and found.unseen == [3]
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["subject.safetensors"], "nothing half written stays"


def test_transforms_are_those_of_the_poses() -> None:
    from tests.support.shapes.canonical import posed_leg

    leg = posed_leg()
    found = posed_by(leg.body, leg.poses.rotations, leg.poses.joints, leg.poses.parents)
    assert np.allclose(found, leg.transforms, atol=1e-6)


def test_the_folder_of_an_outfit(tmp_path: Path) -> None:
    outfit = drawn_outfit(tmp_path)
    assert [its.name for its in outfits_in(tmp_path)] == ["stocking"]
    samples, surfaces = outfit.samples.load(), outfit.surfaces.load()
    assert samples.count == 450 and samples.seen == [0, 1, 2] and samples.unseen == [3]
    assert samples.frame(1, np.array([4, 2])).roots.shape == (2, 3, 3)
    assert surfaces.points.shape == surfaces.normals.shape == (4, 800, 3)
    assert torch.allclose(surfaces.normals.norm(dim=2), torch.ones(()), atol=1e-4)
    before = Outfit.fingerprint(outfit.samples, outfit.surfaces)
    SurfaceSamples(surfaces.points + 1, surfaces.normals).save(outfit.surfaces.path)
    assert Outfit.fingerprint(outfit.samples, outfit.surfaces) != before
    many = [outfit.samples] * 70
    assert Outfit.fingerprint(*many) != Outfit.fingerprint(*many[:-1], outfit.surfaces), "however many files there are"
    assert outfit.field.is_sound and not Outfit(tmp_path / "nothing").field.is_sound
    outfit.field.path.write_bytes(outfit.field.path.read_bytes()[:100])
    assert not outfit.field.is_sound


def test_what_was_read_off_samples_is_not_kept_with_them(tmp_path: Path) -> None:
    """Once the frames to learn from were asked for, they lie beside the fields."""
    path = drawn_outfit(tmp_path).samples.path
    samples, content = OccupancySamples.load(path), path.read_bytes()
    assert samples.seen == [0, 1, 2] and samples.unseen == [3]
    samples.save(path)
    assert path.read_bytes() == content


def test_what_is_not_there_or_something_else_is_one_line(tmp_path: Path) -> None:
    outfit = drawn_outfit(tmp_path)
    with pytest.raises(CheckpointError, match=r"holds no outfits. Make them: dsffnet avatar train"):
        outfits_in(tmp_path / "elsewhere")
    with pytest.raises(CheckpointError, match="no scans of a person"):
        Subject.load(outfit.field.path)
    with pytest.raises(CheckpointError, match="not roots, valid, inside"):
        OccupancySamples.load(outfit.surfaces.path)
    outfit.samples.path.unlink()
    with pytest.raises(CheckpointError, match=r"samples.safetensors is missing. Make it: dsffnet avatar train"):
        Outfit.fingerprint(outfit.samples)
    outfit.surfaces.path.write_bytes(outfit.surfaces.path.read_bytes()[:-7])
    with pytest.raises(CheckpointError, match="cannot be read as weights"):
        outfit.surfaces.load()
