"""Rows of an evaluation (one a triple and method) as CSV, and finished pieces of one kept for its next start."""

import csv
import io
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from datagen.common.errors import DamagedFileError, UnsafeFileError
from datagen.common.files import SET_ASIDE, read_text_within, set_aside, warn_once, write_atomically

_LONGEST = 2**29  # bytes: two million rows

RowType = TypeVar("RowType")

_FORMULA = tuple("=+-@\t\n\r＝＋－＠'")


def inert(value: Any) -> Any:
    """A cell as a CSV file holds it: a number as it is, a text such that no spreadsheet runs it."""
    if not isinstance(value, str) or _is_number(value):
        return value
    return f"'{value}" if _looks_like_formula(value) else value


def _looks_like_formula(text: str) -> bool:
    return text.startswith(_FORMULA) and text.strip("-") != ""  # dashes alone stand for no value


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", ""))
        return True
    except ValueError:
        return False


def write_csv(rows: Sequence[Any], path: Path, kind: type[Any], *, without: Collection[str] = ()) -> None:
    """Write rows of a dataclass, ``without`` some fields; the file appears whole or not at all."""
    text = io.StringIO()
    names = [field.name for field in fields(kind) if field.name not in without]
    writer = csv.DictWriter(text, names, extrasaction="ignore")
    writer.writeheader()
    writer.writerows({name: inert(value) for name, value in asdict(row).items()} for row in rows)
    write_atomically(path, text.getvalue().encode(errors="backslashreplace"))


def read_csv(path: Path, kind: type[RowType]) -> list[RowType]:
    """Rows that :func:`write_csv` wrote.

    Raises
    ------
    DamagedFileError
        It holds other than such rows.
    UnsafeFileError
        It leads out of its folder, is not a regular file, or is far too long.
    FileNotFoundError, OSError
        It is not there, or cannot be read.
    """
    columns = fields(kind)  # type: ignore[arg-type]
    types: dict[str, Any] = {field.name: field.type for field in columns}
    younger = {field.name for field in columns if field.default is not MISSING}
    text = read_text_within(path.parent, path.name, limit=_LONGEST)
    try:
        lines = csv.DictReader(io.StringIO(text, newline=""))
        named = types.keys() - (younger - set(lines.fieldnames or ()))
        return [kind(**{name: types[name](_as_given(line[name])) for name in named}) for line in lines]
    except (ValueError, KeyError, TypeError, AttributeError, csv.Error) as error:
        raise DamagedFileError(f"{path} holds other than rows of measurements ({error}). Measure again") from error


def _as_given(text: str) -> str:
    return text[1:] if text.startswith("'") and _looks_like_formula(text[1:]) else text


def kept_rows(path: Path, kind: type[RowType]) -> list[RowType]:
    """Rows of an earlier start; none where there is no file or, with a warning, where it is damaged and set aside."""
    try:
        return read_csv(path, kind)
    except FileNotFoundError:
        return []
    except (DamagedFileError, UnsafeFileError) as error:
        warn_once(f"{error}. It is kept as {path.name}{SET_ASIDE}, and what it held is measured again")
        set_aside(path)
        return []


_PIECE = re.compile(r"(seen|unseen)-\d{5,}-[0-9a-f]{32}\.csv")


@dataclass(frozen=True, order=True)
class Score:
    """Metrics of one output, in the normalised box unless their name says otherwise; NaN: not measured, not finite."""

    pmd: float
    pmd_recentred: float
    chamfer: float
    earth_mover: float
    millimetres: float
    edge_ratio: float
    normal_degrees: float
    pmd_by_area: float


@dataclass(frozen=True, order=True)
class Dressed:
    """Metrics of the skin and of the garments of a dressed target, each as a mesh of its own; 0 of a bare one.

    Units are those of :class:`Score`: the whole target's box. Edges and faces between both belong to neither.
    """

    skin_pmd: float = 0.0
    skin_chamfer: float = 0.0
    skin_earth_mover: float = 0.0
    skin_millimetres: float = 0.0
    skin_edge_ratio: float = 0.0
    skin_normal_degrees: float = 0.0
    garment_pmd: float = 0.0
    garment_chamfer: float = 0.0
    garment_earth_mover: float = 0.0
    garment_millimetres: float = 0.0
    garment_edge_ratio: float = 0.0
    garment_normal_degrees: float = 0.0


@dataclass(frozen=True, order=True)
class Triple:
    """Number of an evaluation triple, and what it is of: source (identity, pose) and target (identity, pose)."""

    triple: int
    source_identity: int
    source_pose: int
    target_identity: int
    target_pose: int


@dataclass(frozen=True, order=True)
class Listed:
    """Which method, and which of the dataset's two lists of triples."""

    method: str
    pose_type: str


@dataclass(frozen=True, order=True)
class Row(Dressed, Score, Triple, Listed):
    """One method on one evaluation triple. Fields come in the order of a file's columns: the last base's first."""


def is_dressed(row: Row) -> bool:
    """Whether the target has garments, or was measured as one that has and came out as no number."""
    return row.skin_millimetres != 0 or row.garment_millimetres != 0


def write_rows(rows: list[Row], path: Path) -> None:
    """Write rows as CSV, at once; without columns of garments where nobody wears any."""
    dressed = any(map(is_dressed, rows))
    write_csv(rows, path, Row, without=() if dressed else [field.name for field in fields(Dressed)])


def read_rows(path: Path) -> list[Row]:
    """Rows of a CSV that :func:`write_rows` wrote; see :func:`training.evaluation.results.read_csv`."""
    return read_csv(path, Row)


def piece_name(pose_type: str, start: int, fingerprint: str) -> str:
    """File name of one method's rows of the triples from ``start`` on; ``fingerprint``: 32 hexadecimal digits."""
    return f"{pose_type}-{start:05d}-{fingerprint}.csv"


def read_piece(path: Path, expected: list[tuple[str, str, int]]) -> list[Row] | None:
    """Rows of a kept piece; None if it is missing, damaged, or not of these (method, pose type, triple)."""
    try:
        rows = read_rows(path)
    except (OSError, DamagedFileError, UnsafeFileError):
        return None
    return rows if [(row.method, row.pose_type, row.triple) for row in rows] == expected else None


def forget_pieces(folder: Path, *, but: Iterable[str]) -> None:
    """Remove the kept pieces of other evaluations (other weights, data, recipe); other files stay."""
    wanted = set(but)
    for path in folder.iterdir() if folder.is_dir() else ():
        if _PIECE.fullmatch(path.name) and path.name not in wanted:
            path.unlink(missing_ok=True)
