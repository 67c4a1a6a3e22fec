"""Finding model files of the SMPL family and SMAL where people keep them, by the names they are published under."""

import os
import re
from dataclasses import dataclass
from pathlib import Path

from datagen.common.errors import BodyError

FOLDER_VARIABLE = "DSFFNET_BODY_MODELS"


@dataclass(frozen=True)
class Family:
    """A model that people hold files of: where it is published, and the names that its files have there.

    ``names`` are patterns of file names, in which ``{gender}`` stands for neutral, female or male and ``{initial}``
    also for their first letter; ``examples`` are what people are told.
    """

    title: str
    website: str
    names: tuple[str, ...]
    examples: str
    alternative: str


_STAND_IN = "or use the licence-free {body}, or a stand-in: dsffnet stand-in {model} --out {model}.npz"

FAMILIES = {
    "smpl": Family(
        "SMPL",
        "https://smpl.is.tue.mpg.de",
        (r"smpl_{gender}", r"basicmodel_{initial}_lbs_.*"),
        "SMPL_{GENDER}.npz, SMPL_{GENDER}.pkl, basicModel_{gender}_lbs_*.pkl",
        _STAND_IN.format(body="body: --recipe anny-paper", model="smpl"),
    ),
    "smplh": Family(
        "SMPL-H",
        "https://mano.is.tue.mpg.de",
        (r"smplh_{gender}",),
        "SMPLH_{GENDER}.npz, SMPLH_{GENDER}.pkl, smplh/{gender}/model.npz",
        _STAND_IN.format(body="body: --recipe anny-paper", model="smplh"),
    ),
    "smplx": Family(
        "SMPL-X",
        "https://smpl-x.is.tue.mpg.de",
        (r"smplx_{gender}",),
        "SMPLX_{GENDER}.npz, SMPLX_{GENDER}.pkl, smplx/{gender}/model.npz",
        _STAND_IN.format(body="body: --recipe anny-paper", model="smplx"),
    ),
    "smal": Family(
        "SMAL",
        "https://smal.is.tue.mpg.de",
        (r"smal(?!.*data).*", r"my_smpl_.*"),
        "smal_CVPR2017.npz, smal_CVPR2017.pkl, my_smpl_*.pkl",
        _STAND_IN.format(body="animals: --recipe animals-paper", model="smal"),
    ),
}


def find_model(path: str | None, *, model: str, gender: str = "neutral") -> Path:
    """The model file that a recipe means: ``path`` if it is a file, else the best match below it.

    Without ``path``, the folder that the environment variable DSFFNET_BODY_MODELS names. An .npz is preferred to a
    pickle, then what lies less deep, then alphabetical order.

    Raises
    ------
    BodyError
        Nothing there: with what was looked for, where it is published, and what to use instead.
    """
    place = path or os.environ.get(FOLDER_VARIABLE)
    if place and Path(place).is_file():
        return Path(place)
    found = [] if not place else [file for file in Path(place).rglob("*.*") if _is_named(file, model, gender)]
    if found:
        return min(found, key=lambda file: (file.suffix.lower() != ".npz", len(file.parts), str(file)))
    raise BodyError(_missing(place, model, gender))


def _is_named(file: Path, model: str, gender: str) -> bool:
    if file.suffix.lower() not in (".npz", ".pkl") or not file.is_file():
        return False
    fill = {"gender": gender, "initial": f"(?:{gender}|{gender[0]})"}
    if any(re.fullmatch(name.format(**fill), file.stem, re.IGNORECASE) for name in FAMILIES[model].names):
        return True
    folders = [part.lower() for part in file.resolve().parts[:-1]]
    kinds = [folder for folder in folders if folder in FAMILIES]
    return file.stem.lower() == "model" and folders[-1] == gender and (not kinds or kinds[-1] == model)


def _missing(place: str | None, model: str, gender: str) -> str:
    family = FAMILIES[model]
    names = family.examples.format(gender=gender, GENDER=gender.upper())
    where = (
        f"in the folder {place} and below it"
        if place and Path(place).is_dir()
        else f"at {place}, which does not exist"
        if place
        else f"nowhere, as neither data.body.path nor {FOLDER_VARIABLE} is set"
    )
    kind = family.title if model == "smal" else f"{gender} {family.title}"
    return (
        f"no file of the {kind} model: looked for {names} {where}; "
        f"get it from {family.website} under its licence, {family.alternative}"
    )
