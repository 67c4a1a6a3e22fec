"""Strange values in the place of expected ones, in what holds nested values: JSON, YAML, headers of binary files."""

import copy
import json
import math
import random
import re
import struct
from collections.abc import Callable, Iterator
from typing import Any

import yaml

SECRET = "fuzz-secret-d41d8cd98f"
"""What stands in the canary's files and in the environment, and must never be seen in anything that is written."""
SECRET_NAME = "FUZZ_SECRET"
DEPTH = 5000
_DEEP = "@deep@"
_Slot = tuple[Any, Any]
"""A list or mapping, and a place in it."""

NAMES = (
    "..", "../canary/secret.txt", "../../canary/secret.txt", "../../../canary/secret.txt", "../canary", "../../canary",
    "a/../../../canary/secret.txt", "{canary}/secret.txt", "{canary}", "file://{canary}/secret.txt", "/dev/zero",
    "/dev/stdin", "/proc/self/environ", "s3://bucket/name", "http://127.0.0.1:9/x", "~/.bashrc", ".", "/", "-rf", "",
    "..\\canary\\secret.txt", "zarr.json", "CON", "\0", "a\0b", "e\u0301\u202e",
)  # fmt: skip
"""Names of files that lead elsewhere; {canary} is the canary's folder."""
TEXTS = (
    "x" * 5000, "\x1b[2J\x1b[31mred\x07", "two\nlines\r\nmore", "<script>alert(1)</script>", "${oc.env:FUZZ_SECRET}",
    "${.}", "${training.batch}", "???", "%s %n {0} {x!r}", "nan", "1e999", "\ud800", "ﬀ", "null", "=cmd|'/c calc'!A1",
)  # fmt: skip
NUMBERS = (
    0, 1, -1, 2, 3, 0.5, -0.0, 255, 2**31 - 1, 2**31, 2**32, 2**53 + 1, 2**63, 10**12, 10**30, 10**400, -(10**12),
    1e308, 5e-324, math.nan, math.inf, -math.inf,
)  # fmt: skip
OTHERS: tuple[Any, ...] = (None, True, False, [], {}, [[]], [None], {"": None}, _DEEP, [1, "a", None, {"b": [2]}])


def strange(rng: random.Random, canary: str) -> Any:
    """A value that nobody expects."""
    kind = rng.choice((NAMES, TEXTS, NUMBERS, OTHERS))
    value = rng.choice(kind)
    return value.replace("{canary}", canary) if isinstance(value, str) else copy.deepcopy(value)


def changed(value: Any, rng: random.Random, canary: str) -> tuple[Any, str]:
    """Nested values with one thing changed, and words of what."""
    holder = {"": copy.deepcopy(value)}
    slots = list(_slots(holder))
    by_depth = rng.choice((slots, [slot for slot in slots if not isinstance(slot[0][slot[1]], (dict, list))] or slots))
    container, key = rng.choice(by_depth)
    before = container[key]
    change = rng.choice(_CHANGES)
    what = change(container, key, rng, canary)
    return holder.get("", {}), f"{_path_of(key)} ({_short(before)}) {what}"


def _slots(container: Any) -> Iterator[_Slot]:
    for key in container if isinstance(container, dict) else range(len(container)):
        yield container, key
        if isinstance(container[key], (dict, list)):
            yield from _slots(container[key])


def _replace(container: Any, key: Any, rng: random.Random, canary: str) -> str:
    container[key] = strange(rng, canary)
    return f"becomes {_short(container[key])}"


def _retype(container: Any, key: Any, rng: random.Random, canary: str) -> str:
    value = container[key]
    container[key] = rng.choice((str(value), [value], {"value": value}, [value, value], {str(value)[:50]: value}))
    return f"is wrapped as {_short(container[key])}"


def _scale(container: Any, key: Any, rng: random.Random, canary: str) -> str:
    value = container[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return _replace(container, key, rng, canary)
    container[key] = rng.choice((-value, value + 1, value - 1, value * 1000, value * 10**9, value / 2, float(value)))
    return f"becomes {_short(container[key])}"


def _remove(container: Any, key: Any, rng: random.Random, canary: str) -> str:
    del container[key]
    return "is removed"


def _add(container: Any, key: Any, rng: random.Random, canary: str) -> str:
    value = strange(rng, canary)
    inner = container[key]
    if isinstance(inner, dict):
        name = rng.choice(("unknown", "", *map(str, NAMES[:8]), *TEXTS[:3])).replace("{canary}", canary)
        inner[name] = value
        return f"gains {_short(name)}: {_short(value)}"
    if isinstance(inner, list):
        inner.insert(rng.randint(0, len(inner)), value)
        return f"gains {_short(value)}"
    return _replace(container, key, rng, canary)


def _repeat(container: Any, key: Any, rng: random.Random, canary: str) -> str:
    inner, times = container[key], rng.choice((2, 3, 100, 3000))
    if isinstance(inner, list) and len(inner) * times < 30_000:
        container[key] = inner * times
    elif isinstance(inner, str):
        container[key] = (inner * times)[:20_000]
    elif isinstance(inner, dict):
        inner |= {
            f"{name}{number}": each for number in range(min(times, 100)) for name, each in list(inner.items())[:3]
        }
    else:
        container[key] = [inner] * times
    return f"comes {times} times"


def _rename(container: Any, key: Any, rng: random.Random, canary: str) -> str:
    if not isinstance(container, dict) or key == "":
        return _remove(container, key, rng, canary)
    name = rng.choice((key + " ", key.upper(), key[:-1], *NAMES[:6]))
    container[name.replace("{canary}", canary)] = container.pop(key)
    return f"is renamed {name!r}"


def _exchange(container: Any, key: Any, rng: random.Random, canary: str) -> str:
    keys = list(container) if isinstance(container, dict) else list(range(len(container)))
    other = rng.choice(keys)
    container[key], container[other] = container[other], container[key]
    return f"changes places with {_path_of(other)}"


_Change = Callable[[Any, Any, random.Random, str], str]
_CHANGES: tuple[_Change, ...] = (_replace, _replace, _replace, _retype, _scale, _scale, _remove, _add, _repeat, _rename,
                                 _exchange)  # fmt: skip


def as_json(value: Any) -> bytes:
    """JSON of a value, with very deep nesting where it says so."""
    text = json.dumps(value, indent=None, ensure_ascii=True)
    return text.replace(json.dumps(_DEEP), "[" * DEPTH + "]" * DEPTH).encode()


def as_yaml(value: Any) -> bytes:
    """YAML of a value, with very deep nesting where it says so."""
    try:
        text = yaml.safe_dump(value, sort_keys=False)
    except yaml.YAMLError:
        text = json.dumps(value)
    return re.sub(f"['\"]?{_DEEP}['\"]?", "[" * DEPTH + "]" * DEPTH, text).encode("utf-8", "surrogatepass")


def in_json(content: bytes, rng: random.Random, canary: str) -> tuple[bytes, str]:
    """A JSON file with one thing changed."""
    value, what = changed(json.loads(content), rng, canary)
    if isinstance(value, dict) and value and rng.random() < 0.05:
        key = rng.choice(list(value))
        text = as_json(value)
        return text[:-1] + b"," + as_json({key: strange(rng, canary)})[1:], f"{what}; {key} comes twice"
    return as_json(value), what


def in_json_lines(content: bytes, rng: random.Random, canary: str) -> tuple[bytes, str]:
    """A file of JSON lines with one line changed."""
    lines = content.splitlines()
    number = rng.randrange(len(lines))
    lines[number], what = in_json(lines[number], rng, canary)
    return b"\n".join(lines) + b"\n", f"line {number}: {what}"


YAMLS = (
    b"a: &a [x,x,x,x,x,x,x,x,x]\n" + b"".join(
        b"%c: &%c [%s]\n" % (98 + n, 98 + n, b",".join([b"*%c" % (97 + n)] * 9)) for n in range(9)
    ),
    b"data: !!python/object/apply:os.system ['touch {canary}/made']\n",
    b"data: &x\n  body: *x\n",
    b"data: {training: *nobody}\n",
    b"training: {batch: 8, batch: 9}\n",
    b"--- 1\n--- 2\n",
    b"? [a, b]\n: c\n",
    b"1: 2\n",
    b"data: 2001-01-01\n",
    b"data: {body: {family: leg, rings: 1e11}}\n",
    b"\xff\xfe",
    b"data:\n\t- x\n",
    b"'" + b"[" * 20_000,
    b"[" * 20_000,
    b"{a: " * 3000 + b"}" * 3000,
    b"description: ${oc.env:FUZZ_SECRET}\ndata: {body: {family: leg}}\n",
    b"description: ${oc.decode:${oc.env:FUZZ_SECRET}}\ndata: {body: {family: leg}}\n",
    b"description: ${description}\n",
    b"training: ${data}\ndata: ${training}\n",
)  # fmt: skip
"""What YAML can do that nobody asked for."""


def in_yaml(content: bytes, rng: random.Random, canary: str) -> tuple[bytes, str]:
    """A YAML file with one thing changed."""
    if rng.random() < 0.15:
        number = rng.randrange(len(YAMLS))
        return YAMLS[number].replace(b"{canary}", canary.encode()), f"is YAML trick {number}"
    value, what = changed(yaml.safe_load(content), rng, canary)
    return as_yaml(value), what


def in_safetensors(content: bytes, rng: random.Random, canary: str) -> tuple[bytes, str]:
    """The header of a file of weights changed, or what the header's metadata say."""
    (length,) = struct.unpack_from("<Q", content)
    header = json.loads(content[8 : 8 + length])
    if rng.random() < 0.4 and "__metadata__" in header:
        inner, what = in_json(header["__metadata__"]["dsffnet"].encode(), rng, canary)
        header["__metadata__"]["dsffnet"] = inner.decode()
        text = as_json(header)
    else:
        text, what = in_json(content[8 : 8 + length], rng, canary)
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + content[8 + length :], f"header: {what}"


def in_glb(content: bytes, rng: random.Random, canary: str) -> tuple[bytes, str]:
    """The JSON chunk of a GLB file changed."""
    (length,) = struct.unpack_from("<I", content, 12)
    text, what = in_json(content[20 : 20 + length], rng, canary)
    text += b" " * (-len(text) % 4)
    rest = content[20 + length :]
    whole = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest
    return whole, f"JSON: {what}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) < 60 else f"{text[:50]}... of {len(text)}"


def _path_of(key: Any) -> str:
    return repr(key) if key != "" else "everything"
