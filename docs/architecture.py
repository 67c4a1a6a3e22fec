"""Draw images/architecture.svg, the packages in their layers, from the contracts of pyproject.toml.

python docs/architecture.py
"""

import tomllib
from collections.abc import Iterator
from pathlib import Path

_ROOT = Path(__file__).parents[1]
_PICTURE = _ROOT / "docs" / "images" / "architecture.svg"
_COLUMNS = {
    "workflows": ("chains generation, training and evaluation", "the dsffnet command", "#fbf1e4", "#e8c99b", "#7a4a12"),
    "training": ("trains, measures and uses networks", "reads datasets, makes none", "#eaf2fa", "#a9c9e8", "#2b4a7f"),
    "datagen": (
        "makes identity x pose grids of bodies",
        "and keeps them as Zarr",
        "#e9f4e9",
        "#a9cfae",
        "#2e6b3a",
    ),
}
_WIDTH, _PITCH, _STEP, _BOX, _GAP = 360, 400, 62, 46, 10


def layers_of(root: str) -> list[list[str]]:
    """Packages of ``datagen``, ``training`` or ``workflows``, the uppermost layer first."""
    contracts = tomllib.loads((_ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (layers,) = (each["layers"] for each in contracts if each["name"] == f"Packages of {root}")
    names = [[name.strip().removeprefix(f"{root}.") for name in layer.split("|")] for layer in layers]
    return [[name for name in layer if name != "__main__"] for layer in names]


def picture() -> str:
    """The picture as SVG."""
    high = 110 + _STEP * max(len(layers_of(root)) for root in _COLUMNS)
    wide = 20 + _PITCH * len(_COLUMNS) - (_PITCH - _WIDTH) + 20
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide} {high + 20}" font-family="system-ui, sans-serif" '
        'role="img" aria-label="Packages and the layers they stand in">',
        f'<rect width="{wide}" height="{high + 20}" fill="white"/>',
        '<defs><marker id="a" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="8" markerHeight="8" orient="auto">'
        '<path d="M0 0L10 5L0 10z" fill="#666"/></marker></defs>',
    ]
    for place, root in enumerate(_COLUMNS):
        lines += _column(root, 20 + _PITCH * place, high)
        if place:
            start = 20 + _PITCH * place - (_PITCH - _WIDTH) + 4
            lines.append(_arrow(start, 45, start + _PITCH - _WIDTH - 8, 45))
    return "\n".join([*lines, "</svg>", ""])


def _column(root: str, left: int, high: int) -> Iterator[str]:
    about, more, paper, edge, ink = _COLUMNS[root]
    yield f'<rect x="{left}" y="20" width="{_WIDTH}" height="{high - 20}" rx="10" fill="{paper}" stroke="{edge}"/>'
    yield f'<text x="{left + 18}" y="52" font-size="21" font-weight="700" fill="{ink}">{root}/</text>'
    for height, words in ((74, about), (91, more)):
        yield f'<text x="{left + 18}" y="{height}" font-size="13" fill="#444">{words}</text>'
    for row, names in enumerate(layers_of(root)):
        top = 110 + _STEP * row
        if row:
            yield _arrow(left + _WIDTH / 2, top - _STEP + _BOX + 1, left + _WIDTH / 2, top - 1)
        width = (_WIDTH - 36 - _GAP * (len(names) - 1)) / len(names)
        for place, name in enumerate(names):
            x = left + 18 + place * (width + _GAP)
            yield f'<rect x="{x:g}" y="{top}" width="{width:g}" height="{_BOX}" rx="6" fill="white" stroke="{ink}"/>'
            middle = f'x="{x + width / 2:g}" y="{top + 28}"'
            yield f'<text {middle} font-size="15" text-anchor="middle" fill="#222">{name}</text>'


def _arrow(x1: float, y1: float, x2: float, y2: float) -> str:
    return f'<line x1="{x1:g}" y1="{y1:g}" x2="{x2:g}" y2="{y2:g}" stroke="#666" marker-end="url(#a)"/>'


if __name__ == "__main__":
    _PICTURE.write_text(picture())
