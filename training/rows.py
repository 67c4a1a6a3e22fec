"""Rows of an evaluation (one a triple and method) as CSV, and finished pieces of one kept for its next start."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from datagen.errors import DamagedFileError, UnsafeFileError
from training.row_files import read_csv, write_csv

_PIECE = re.compile(r"(seen|unseen)-\d{5,}-[0-9a-f]{32}\.csv")


@dataclass(frozen=True, order=True)
class Row:
    """One method on one evaluation triple. Metrics are in the normalised box unless their name says otherwise.

    A metric is NaN where the method's output was not finite.
    """

    method: str
    pose_type: str
    triple: int
    source_identity: int
    source_pose: int
    target_identity: int
    target_pose: int
    pmd: float
    pmd_recentred: float
    chamfer: float
    earth_mover: float
    millimetres: float
    edge_ratio: float
    normal_degrees: float


def write_rows(rows: list[Row], path: Path) -> None:
    """Write rows as CSV, at once."""
    write_csv(rows, path, Row)


def read_rows(path: Path) -> list[Row]:
    """Rows of a CSV that :func:`write_rows` wrote; see :func:`training.row_files.read_csv`."""
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
