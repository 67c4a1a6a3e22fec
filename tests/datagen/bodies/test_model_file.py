"""Model files in SMPL's layout: found under their published names, converted, refused where they are none."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.bodies.smpl_family.model_file import KEYS, convert_model
from datagen.bodies.smpl_family.model_search import FOLDER_VARIABLE, find_model
from datagen.bodies.smpl_family.smpl import SmplModel
from datagen.common.errors import BodyError
from datagen.poses import PARENTS, draw_poses
from datagen.recipe import PoseRecipe, SmplBody
from tests.support.shapes.bodies import identity
from tests.support.shapes.models import Arrays, arrays_of, random_model, save_npz, save_pickle, tree


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_pickle_and_its_conversion_give_identical_vertices(protocol: int, tmp_path: Path) -> None:
    original = save_pickle(
        tmp_path / "basicModel_neutral_lbs_10_207_0_v1.0.0.pkl", arrays_of("smpl"), protocol=protocol
    )
    converted = convert_model(original, tmp_path / "converted" / "smpl.npz")
    with np.load(converted, allow_pickle=False) as plain:
        assert set(plain) == set(KEYS)
        assert all(np.array_equal(plain[key], arrays_of("smpl")[key]) for key in KEYS)
    poses = draw_poses(PoseRecipe(), range(4))
    bodies = [SmplModel(SmplBody(path=str(path))) for path in (original, converted)]
    betas = identity(bodies[0])
    assert np.array_equal(bodies[0].vertices(betas, poses), bodies[1].vertices(betas, poses))
    again = convert_model(converted, tmp_path / "again.npz")
    assert again.read_bytes() == converted.read_bytes()
    assert convert_model(original, converted) == converted, "the same bytes"


def test_conversion_leaves_another_file_alone(tmp_path: Path) -> None:
    (tmp_path / "licensed.npz").write_text("precious")
    with pytest.raises(BodyError, match=r"licensed\.npz is there, and another file than would be written"):
        convert_model(save_npz(tmp_path / "mine.npz", arrays_of("smpl")), tmp_path / "licensed.npz")
    assert (tmp_path / "licensed.npz").read_text() == "precious"


def test_conversion_leaves_nothing_half_done(tmp_path: Path) -> None:
    arrays = arrays_of("smpl")
    bad = save_pickle(tmp_path / "bad.pkl", {key: arrays[key] for key in KEYS if key != "weights"})
    for out in (tmp_path / "out.npz", tmp_path / "out.pkl"):
        with pytest.raises(BodyError):
            convert_model(bad, out)
    assert os.listdir(tmp_path) == ["bad.pkl"]


FILES = {
    "smpl": ["SMPL_NEUTRAL.npz", "SMPL_NEUTRAL.pkl", "smpl/models/basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl",
             "basicModel_neutral_lbs_10_207_0_v1.0.0.pkl", "smpl/neutral/model.npz"],
    "smplh": ["SMPLH_NEUTRAL.pkl", "smplh/neutral/model.npz", "body_models/smplh/SMPLH_neutral.npz"],
    "smplx": ["models/smplx/SMPLX_NEUTRAL.npz", "SMPLX_NEUTRAL.pkl"],
}  # fmt: skip


@pytest.mark.parametrize(("model", "file"), [(model, file) for model, files in FILES.items() for file in files])
def test_files_are_found_under_their_published_names(
    model: str, file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = ["SMPL_FEMALE.npz", "SMPL_MALE.pkl", "smplh/male/model.npz", "SMPLX_MALE.npz", "smal_CVPR2017.pkl",
              "basicmodel_m_lbs_10_207_0_v1.1.0.pkl", "SMPL_NEUTRAL.txt", "smplx2/female/model.npz"]  # fmt: skip
    others += [name for other, names in FILES.items() if other != model for name in names]
    for name in [*others, file]:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert find_model(str(tmp_path), model=model) == tmp_path / file
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    assert find_model(None, model=model) == tmp_path / file


def test_genders_and_preferences(tmp_path: Path) -> None:
    for name in ("basicmodel_m_lbs_10_207_0_v1.1.0.pkl", "basicModel_f_lbs_10_207_0_v1.0.0.pkl", "a/SMPL_FEMALE.npz"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert find_model(str(tmp_path), model="smpl", gender="male").name == "basicmodel_m_lbs_10_207_0_v1.1.0.pkl"
    assert find_model(str(tmp_path), model="smpl", gender="female").name == "SMPL_FEMALE.npz", "npz before pickle"


def test_missing_files_are_one_helpful_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(FOLDER_VARIABLE, raising=False)
    sites = {"smpl": "smpl.is", "smplh": "mano.is", "smplx": "smpl-x.is"}
    for model, site in sites.items():
        for path in (None, str(tmp_path), str(tmp_path / "gone.npz")):
            with pytest.raises(BodyError) as missing:
                SmplModel(SmplBody(model=model, path=path, gender="male"))
            message = str(missing.value)
            assert f"https://{site}.tue.mpg.de" in message and (path or FOLDER_VARIABLE) in message
            assert f"{model.upper()}_MALE.npz" in message and "\n" not in message and ". " not in message
            assert "--recipe anny-paper" in message and f"dsffnet stand-in {model} --out {model}.npz" in message


def spoiled(key: str, change: Any) -> Arrays:
    arrays = {name: array.copy() for name, array in arrays_of("smpl").items()}
    arrays[key] = change(arrays[key])
    return arrays


def put(index: Any, value: float) -> Any:
    def change(array: np.ndarray) -> np.ndarray:
        array[index] = value
        return array

    return change


SPOILED = {
    "weights missing": (lambda: {k: v for k, v in arrays_of("smpl").items() if k != "weights"}, "no 'weights'"),
    "flat template": (lambda: spoiled("v_template", np.ravel), r"'v_template' has the shape \[450\]"),
    "short weights": (lambda: spoiled("weights", lambda w: w[:-1]), r"'weights' has the shape \[149, 24\]"),
    "other joints": (lambda: spoiled("J_regressor", lambda j: j[:-1]), "'J_regressor' has the shape"),
    "few posedirs": (lambda: spoiled("posedirs", lambda p: p[..., :-9]), r"'posedirs' has .* \[150, 3, 207\]"),
    "not finite": (lambda: spoiled("shapedirs", put((3, 1, 2), np.nan)), "'shapedirs' holds .* not finite"),
    "heavy": (lambda: spoiled("weights", put((5, 0), 1.5)), "'weights' of vertex 5 sum to"),
    "cycle": (lambda: spoiled("kintree_table", put((0, 4), 7)), "'kintree_table' is no tree, as joint 4"),
    "second root": (lambda: spoiled("kintree_table", put((0, 9), 2**32 - 1)), "'kintree_table' is no tree, as joint 9"),
    "face outside": (lambda: spoiled("f", put((0, 0), 150)), "'f' names vertex 150, but the model has 150"),
    "animal": (lambda: random_model(tuple(range(-1, 32))), "33 joints, but SMPL has 24"),
    "smplh": (lambda: random_model(tree("smplh")), "52 joints, but SMPL has 24; --set data.body.model=smplh"),
    "two betas": (lambda: random_model(PARENTS, betas=2), "2 shape parameters.*--set data.body.betas=2"),
}  # fmt: skip


@pytest.mark.parametrize("fault", sorted(SPOILED))
@pytest.mark.parametrize("save", [save_npz, save_pickle], ids=["npz", "pkl"])
def test_files_that_are_no_model_are_refused_in_one_sentence(fault: str, save: Any, tmp_path: Path) -> None:
    make, expected = SPOILED[fault]
    path = save(tmp_path / "model.file.npz", make())
    with pytest.raises(BodyError, match=expected) as refusal:
        SmplModel(SmplBody(path=str(path)))
    assert str(path) in str(refusal.value) and "\n" not in str(refusal.value)


def test_a_pickle_of_no_dictionary_is_refused(tmp_path: Path) -> None:
    (tmp_path / "SMPL_NEUTRAL.npz").write_bytes(b"\x80\x04].")
    with pytest.raises(BodyError, match=r"SMPL_NEUTRAL\.npz holds list, not the dictionary"):
        SmplModel(SmplBody(path=str(tmp_path)))
