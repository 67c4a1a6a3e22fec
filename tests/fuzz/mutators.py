"""Damage to a tree of files, by chance and by malice: of names, of kinds of files, of bytes, of what the bytes mean."""

import contextlib
import os
import random
import re
import shutil
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path

from tests.fuzz import archives, structures
from tests.fuzz.seals import is_plain, reseal_checkpoint, reseal_dataset

Content = Callable[[bytes, random.Random, str], tuple[bytes, str]]

_MEANINGS: dict[str, Content] = {
    ".json": structures.in_json, ".gltf": structures.in_json, ".jsonl": structures.in_json_lines,
    ".yaml": structures.in_yaml, ".safetensors": structures.in_safetensors, ".glb": structures.in_glb,
    ".npz": archives.in_npz, ".pkl": archives.in_pickle, ".pt": archives.in_torch, ".pth": archives.in_torch,
    "shard": archives.in_shard,
}  # fmt: skip
"""Suffixes of files whose content is understood, and what changes their meaning."""


def mutate(tree: Path, rng: random.Random, canary: Path, *, named: str = "") -> str:
    """Damage one thing in a tree, or in a file, in place; words of what.

    ``named``: a pattern of files that a person names, and which are no links to elsewhere therefore.
    """
    files = [path for path in (sorted(tree.rglob("*")) if tree.is_dir() else [tree]) if is_plain(path)]
    if not files:
        return "nothing is left to damage"
    draw = rng.random()
    if draw < 0.45:
        return _change_meaning(files, rng, canary)
    if draw < 0.75:
        return _change_bytes(_weighted(files, rng), rng)
    change = rng.choice(_KINDS)
    others = [path for path in files if change is not _lead_out or not fnmatch(path.name, named)]
    return change(tree, others, rng, canary) if others else _special(tree, files, rng, canary)


def reseal(tree: Path) -> None:
    """Make hashes fit again."""
    if (tree / "zarr.json").exists():
        reseal_dataset(tree)
    for manifest in tree.rglob("manifest.json") if tree.is_dir() else ():
        reseal_checkpoint(manifest.parent)


def _weighted(files: list[Path], rng: random.Random) -> Path:
    """One of the files: half of the time one of those at the top, which the others hang from."""
    top = min(len(path.parts) for path in files)
    return rng.choice([path for path in files if len(path.parts) == top] if rng.random() < 0.4 else files)


def _change_meaning(files: list[Path], rng: random.Random, canary: Path) -> str:
    known = [path for path in files if _kind(path) in _MEANINGS]
    if not known:
        return _change_bytes(_weighted(files, rng), rng)
    path = _weighted(known, rng)
    try:
        content, what = _MEANINGS[_kind(path)](path.read_bytes(), rng, str(canary))
    except Exception:  # an earlier mutation has made it unreadable
        return _change_bytes(path, rng)
    _put(path, content)
    return f"{path.name}: {what}"


def _kind(path: Path) -> str:
    return "shard" if "/vertices/c/" in path.as_posix() else path.suffix


def _change_bytes(path: Path, rng: random.Random) -> str:
    content, change = path.read_bytes(), rng.choice(_BYTES)
    _put(path, change(content, rng) if content else b"\0")
    return f"{path.name}: {change.__name__.strip('_').replace('_', ' ')}"


def _put(path: Path, content: bytes) -> None:
    path.unlink()
    path.write_bytes(content)


def _place(content: bytes, rng: random.Random) -> int:
    """A place in content, more often near its beginning and its end, where headers are."""
    near = min(64, len(content))
    return rng.choice((rng.randrange(len(content)), rng.randrange(near), len(content) - 1 - rng.randrange(near)))


def _flipped_bits(content: bytes, rng: random.Random) -> bytes:
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 8))):
        changed[_place(content, rng)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _cut_off(content: bytes, rng: random.Random) -> bytes:
    return content[: _place(content, rng)]


def _cut_out(content: bytes, rng: random.Random) -> bytes:
    start = _place(content, rng)
    return content[:start] + content[start + rng.choice((1, 4, 100)) :]


def _spliced(content: bytes, rng: random.Random) -> bytes:
    start, place, length = _place(content, rng), _place(content, rng), rng.choice((1, 8, 64, 1000))
    return content[:place] + content[start : start + length] + content[place + rng.choice((0, length)) :]


def _overwritten(content: bytes, rng: random.Random) -> bytes:
    start, length = _place(content, rng), rng.choice((1, 4, 8, 100))
    filler = rng.choice((b"\0", b"\xff", b"9", b"-", b" ", b"\n", b"\x80", b"["))
    return content[:start] + filler * length + content[start + length :]


def _other_whole_number(content: bytes, rng: random.Random) -> bytes:
    """A number of 2, 4 or 8 bytes, such as lengths and offsets are."""
    size, start = rng.choice((2, 4, 8)), _place(content, rng) // 4 * 4
    value = rng.choice((0, 1, 2 ** (8 * size) - 1, 2 ** (8 * size - 1), 2 ** (8 * size - 1) - 1, len(content)))
    return content[:start] + (value % 2 ** (8 * size)).to_bytes(size, "little") + content[start + size :]


def _other_written_number(content: bytes, rng: random.Random) -> bytes:
    numbers = list(re.finditer(rb"-?\d+(\.\d+)?(e-?\d+)?", content[:200_000]))
    if not numbers:
        return _flipped_bits(content, rng)
    found = rng.choice(numbers)
    other = rng.choice(
        (b"-1", b"0", b"1e999", b"nan", b"inf", b"1e300", b"99999999999", b"9" * 5000, b"1.5", b"x", b"")
    )
    return content[: found.start()] + other + content[found.end() :]


def _other_word(content: bytes, rng: random.Random) -> bytes:
    """A word of text replaced by another one of it, or by bytes that are no text."""
    words = list(re.finditer(rb"[^\s]+", content[:200_000]))
    if not words:
        return _flipped_bits(content, rng)
    found, other = rng.choice(words), rng.choice(words)[0]
    instead = rng.choice((other, b"\xff\xfe", b"\x1b[2J", b"../" * 8 + b"etc/passwd", b"/dev/zero", b"\0", b"x" * 5000))
    return content[: found.start()] + instead + content[found.end() :]


def _other_line_ends(content: bytes, rng: random.Random) -> bytes:
    return content.replace(b"\n", rng.choice((b"\r\n", b"\r", b"\n\n", b" ", b"\\\n", b"\x0b")))


def _repeated(content: bytes, rng: random.Random) -> bytes:
    return content * rng.choice((2, 3))


def _followed_by_noise(content: bytes, rng: random.Random) -> bytes:
    return content + rng.randbytes(rng.choice((1, 4, 100, 5000)))


def _noise(content: bytes, rng: random.Random) -> bytes:
    return rng.randbytes(rng.choice((1, 100, len(content))))


def _emptied(content: bytes, rng: random.Random) -> bytes:
    return b""


_BYTES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    _flipped_bits, _flipped_bits, _cut_off, _cut_out, _spliced, _overwritten, _other_whole_number,
    _other_written_number, _other_written_number, _other_word, _other_line_ends, _repeated, _followed_by_noise,
    _noise, _emptied,
)  # fmt: skip


def _swap(tree: Path, files: list[Path], rng: random.Random, canary: Path) -> str:
    one, other = rng.choice(files), rng.choice(files)
    first, second = one.read_bytes(), other.read_bytes()
    _put(one, second)
    _put(other, first)
    return f"{one.name} and {other.name} change places"


def _copy_over(tree: Path, files: list[Path], rng: random.Random, canary: Path) -> str:
    one, other = rng.choice(files), rng.choice(files)
    _put(one, other.read_bytes())
    return f"{one.name} is a copy of {other.relative_to(tree.parent)}"


def _remove(tree: Path, files: list[Path], rng: random.Random, canary: Path) -> str:
    path = rng.choice(files)
    path.unlink()
    return f"{path.name} is removed"


def _special(tree: Path, files: list[Path], rng: random.Random, canary: Path) -> str:
    """Something other than a regular file where one is expected."""
    path = _weighted(files, rng)
    kind = rng.choice(
        ("folder", "full folder", "pipe", "endless", "loop", "dangling", "sparse", "unreadable", "socket")
    )
    path.unlink()
    _make(path, kind)
    return f"{path.relative_to(tree.parent)} is {kind}"


def _make(path: Path, kind: str) -> None:
    if kind in ("folder", "full folder"):
        path.mkdir()
        if kind == "full folder":
            (path / "zarr.json").write_text("{}")
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "endless":
        path.symlink_to("/dev/zero")
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "dangling":
        path.symlink_to("nowhere")
    elif kind == "socket":
        os.mknod(path, 0o140600)
    else:
        path.write_bytes(b"")
        os.truncate(path, 2**36 if kind == "sparse" else 0)
        path.chmod(0 if kind == "unreadable" else 0o644)


def _lead_out(tree: Path, files: list[Path], rng: random.Random, canary: Path) -> str:
    """A link to what is not the tree's, from a file or a folder in it; a person's own link to the tree is no such."""
    folders = [path for path in tree.rglob("*") if path.is_dir() and not path.is_symlink()] if tree.is_dir() else []
    if not tree.is_dir():
        return _special(tree, files, rng, canary)
    path = rng.choice(folders) if folders and rng.random() < 0.3 else _weighted(files, rng)
    if path.is_dir():
        with contextlib.suppress(shutil.Error):  # a pipe that was put there before
            shutil.copytree(path, canary / "copied", symlinks=True, dirs_exist_ok=True)
        shutil.rmtree(path)
        path.symlink_to(canary / "copied")
    else:
        shutil.copy(path, canary / "copied.bin")
        path.unlink()
        path.symlink_to(rng.choice((canary / "secret.txt", canary / "copied.bin", canary)))
    return f"{path.relative_to(tree.parent)} is a link to the canary"


def _add_stranger(tree: Path, files: list[Path], rng: random.Random, canary: Path) -> str:
    home = rng.choice(files).parent
    name = rng.choice(
        ("\x1b[2J.json", "x" * 200, ".hidden", "zarr.json", "record.json", "step-99999999", "a\nb", "-rf")
    )
    with contextlib.suppress(OSError):
        (home / name).write_bytes(rng.choice(files).read_bytes())
    return f"{name[:30]!r} is added"


_KINDS: tuple[Callable[[Path, list[Path], random.Random, Path], str], ...] = (
    _swap, _copy_over, _remove, _special, _special, _lead_out, _lead_out, _add_stranger,
)  # fmt: skip
