"""Material libraries (.mtl) of OBJ files: what they say of base colours, and the files that go with them."""

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from datagen.mesh_surface import Image, Material

_TEXTURES = ("map_", "bump", "disp", "decal", "norm", "refl")


@dataclass(frozen=True)
class LibraryFiles:
    """Materials of the libraries, the files that belong to them (name -> bytes), and what is not to be had."""

    materials: tuple[Material, ...]
    beside: dict[str, bytes]
    missing: list[str]


def read_library(folder: Path, lines: list[str]) -> LibraryFiles:
    """Read the libraries that ``mtllib`` lines name, with their textures, from the folder of the OBJ file."""
    materials: list[Material] = []
    beside: dict[str, bytes] = {}
    missing: list[str] = []
    for name in (name for line in dict.fromkeys(lines) for name in _library_names(folder, line)):
        content = _beside(folder, name, "materials", missing)
        if content is not None:
            beside[name] = content
            materials += _parse(content.decode("utf-8", "replace"), folder, PurePosixPath(name).parent, beside, missing)
    return LibraryFiles(tuple(materials), beside, missing)


def _library_names(folder: Path, line: str) -> list[str]:
    return [line] if " " not in line or (folder / line).is_file() else line.split()


def _beside(folder: Path, name: str, what: str, missing: list[str]) -> bytes | None:
    """The bytes of a file that another one names; what cannot be taken along is noted in ``missing``."""
    place = PurePosixPath(name)
    try:
        if place.is_absolute():
            return None  # stays right wherever the mesh goes
        if ".." in place.parts:
            missing.append(f"{what}: {name} lies outside of the mesh's folder and was not copied")
            return None
        return (folder / name).read_bytes()
    except (OSError, ValueError):
        missing.append(f"{what}: {name} is not beside the mesh")
        return None


def _parse(text: str, home: Path, sub: PurePosixPath, beside: dict[str, bytes], missing: list[str]) -> list[Material]:
    """Materials of a library that lies in the folder ``sub`` of ``home``; textures are named from there."""
    entries = _entries(text)
    folder = home / sub
    images: dict[str, Image] = {}
    for name in dict.fromkeys(_file_name(folder, entry[key]) for entry in entries for key in entry if _is_texture(key)):
        content = _beside(folder, name, "texture", missing)
        if content is not None:
            beside[str(sub / name)] = content
            images[name] = Image(PurePosixPath(name).name, content)
    return [_material(entry, images.get(_file_name(folder, entry.get("map_Kd", "")))) for entry in entries]


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


def _file_name(folder: Path, value: str) -> str:
    """The file of a texture line, whose options come before it; a name with spaces is told by its file."""
    words = value.split()
    while len(words) > 1 and not (folder / " ".join(words)).is_file():
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
        return [min(max(float(word), 0.0), 1.0) for word in text.split() if not word.startswith("-")] or [0.0]
    except ValueError:  # spectral files and other colour spaces
        return [0.8]


def library_text(materials: tuple[Material, ...], images: dict[str, str]) -> str:
    """A library with these materials; ``images`` names the file of each texture by its material's name."""
    lines = []
    for material in materials:
        lines += [f"newmtl {material.name}", "Kd {:.6g} {:.6g} {:.6g}".format(*material.colour[:3])]
        lines += [f"d {material.colour[3]:.6g}"] if material.colour[3] < 1 else []
        lines += [f"map_Kd {images[material.name]}"] if material.name in images else []
    return "\n".join(lines) + "\n"


def texture_beside(folder: Path, name: str, missing: list[str]) -> Image | None:
    """A texture that a mesh file names, from its folder; None for no name, and where it is not to be had."""
    content = _beside(folder, name, "texture", missing) if name else None
    return Image(PurePosixPath(name).name, content) if content is not None else None
