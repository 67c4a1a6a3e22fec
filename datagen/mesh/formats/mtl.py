"""Files that a mesh names: material libraries (.mtl) of OBJ files, what they say of base colours, and textures."""

import math
import os
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from datagen.common.errors import UnsafeFileError
from datagen.common.files import read_bounded, resolve_within
from datagen.mesh.formats.surface import Image, Material

NAMED_LIMIT = 2**30
"""Bytes at most of all files together that one mesh names: they are in memory until the mesh is written."""
_LIBRARY_LIMIT = 2**24
_MOST_FILES = 1_000  # that one mesh names
_TEXTURES = ("map_", "bump", "disp", "decal", "norm", "refl")
_NAME_WORDS = 32  # of a texture line that a name with spaces may take up


class NamedFiles:
    """Files that a mesh names, read from its own folder and below.

    Attributes
    ----------
    contents
        Name -> bytes of what was read.
    missing
        What could not be read, one line each.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.contents: dict[str, bytes] = {}
        self.missing: list[str] = []

    def read(self, name: str, what: str, *, limit: int = NAMED_LIMIT) -> bytes | None:
        """The bytes of a file; None where it is not to be had, which is noted. An absolute path stays as it is."""
        if PurePosixPath(name).is_absolute() or len(self.missing) >= _MOST_FILES:
            return None
        if name not in self.contents:
            try:
                self.contents[name] = self._content(name, limit)
            except UnsafeFileError as error:
                self.missing.append(f"{what}: {name} was not copied: {error}")
            except (OSError, ValueError):
                self.missing.append(f"{what}: {name} is not beside the mesh")
        return self.contents.get(name)

    def _content(self, name: str, limit: int) -> bytes:
        if len(self.contents) >= _MOST_FILES:
            raise UnsafeFileError(f"the mesh names more than {_MOST_FILES:,} files")
        try:
            path = resolve_within(self.folder, name)
        except UnsafeFileError as error:
            raise UnsafeFileError("it lies outside of the mesh's folder") from error
        left = NAMED_LIMIT - sum(map(len, self.contents.values()))
        return read_bounded(path, limit=min(limit, left))

    def holds(self, name: str) -> bool:
        """Return whether a file of that name is there."""
        return os.path.isfile(self.folder / name)  # Path's own raises on names that are too long


@dataclass(frozen=True)
class LibraryFiles:
    """Materials of the libraries, the files that belong to them (name -> bytes), and what is not to be had."""

    materials: tuple[Material, ...]
    beside: dict[str, bytes]
    missing: list[str]


def read_library(folder: Path, lines: list[str]) -> LibraryFiles:
    """Read the libraries that ``mtllib`` lines name, with their textures, from the folder of the OBJ file."""
    files = NamedFiles(folder)
    materials: list[Material] = []
    for name in dict.fromkeys(name for line in dict.fromkeys(lines) for name in _library_names(files, line)):
        content = files.read(name, "materials", limit=_LIBRARY_LIMIT)
        if content is not None:
            materials += _parse(content.decode("utf-8", "replace"), files, PurePosixPath(name).parent)
    return LibraryFiles(tuple(materials), files.contents, files.missing)


def _library_names(files: NamedFiles, line: str) -> list[str]:
    return [line] if " " not in line or files.holds(line) else line.split()


def _parse(text: str, files: NamedFiles, sub: PurePosixPath) -> list[Material]:
    """Materials of a library that lies in the folder ``sub``; textures are named from there."""
    entries = _entries(text)
    images: dict[str, Image] = {}
    for value in dict.fromkeys(entry[key] for entry in entries for key in entry if _is_texture(key)):
        name = _file_name(files, sub, value)
        content = files.read(str(sub / name), "texture") if name else None
        if content is not None:
            images[value] = Image(PurePosixPath(name).name, content)
    return [_material(entry, images.get(entry.get("map_Kd", ""))) for entry in entries]


def _entries(text: str) -> list[dict[str, str]]:
    found: list[dict[str, str]] = []
    for line in text.splitlines():
        key, _, rest = line.strip().partition(" ")
        if key == "newmtl":
            found.append({"name": rest.strip()})
        elif found and key:
            found[-1][key] = rest.strip()
    return found


def _is_texture(key: str) -> bool:
    return key.lower().startswith(_TEXTURES)


def _file_name(files: NamedFiles, sub: PurePosixPath, value: str) -> str:
    """The file of a texture line, whose options come before it; a name with spaces is told by its file."""
    words = value.split()[-_NAME_WORDS:]
    while len(words) > 1 and not files.holds(str(sub / " ".join(words))):
        words = words[1:]
    return " ".join(words).replace("\\", "/")


def _material(entry: dict[str, str], image: Image | None) -> Material:
    red, green, blue = (_numbers(entry.get("Kd", "0.8 0.8 0.8")) * 3)[:3]
    if image and red == green == blue == 0:  # some exporters write black where a texture gives the colour
        red = green = blue = 1.0
    opacity = _numbers(entry["d"])[-1] if "d" in entry else 1 - _numbers(entry.get("Tr", "0"))[-1]
    return Material(entry["name"], (red, green, blue, opacity), image)


def _numbers(text: str) -> list[float]:
    try:
        return [_share(float(word)) for word in text.split() if not word.startswith("-")] or [0.0]
    except ValueError:  # spectral files and other colour spaces
        return [0.8]


def _share(value: float) -> float:
    return 0.8 if math.isnan(value) else min(max(value, 0.0), 1.0)


def library_text(materials: tuple[Material, ...], images: dict[str, str]) -> str:
    """Return a library with these materials; ``images`` names the file of each texture by its material's name."""
    lines = []
    for material in materials:
        lines += [f"newmtl {material.name}", "Kd {:.6g} {:.6g} {:.6g}".format(*material.colour[:3])]
        lines += [f"d {material.colour[3]:.6g}"] if material.colour[3] < 1 else []
        lines += [f"map_Kd {images[material.name]}"] if material.name in images else []
    return "\n".join(lines) + "\n"


def texture_beside(files: NamedFiles, name: str) -> Image | None:
    """Return a texture that a mesh file names; None for no name, and where it is not to be had."""
    content = files.read(name, "texture") if name else None
    return Image(PurePosixPath(name).name, content) if content is not None else None
