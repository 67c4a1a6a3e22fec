"""How a PLY file is laid out, text or binary: its header, and the tables of what it lists."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.mesh.formats.surface import numbers

_KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_CUT_OFF = "it ends before its {:,} elements {!r} do: export or copy it again"
_HEADER = 2**20  # bytes in which a header must end


@dataclass(frozen=True)
class Property:
    """A value of each element, or a list of values where ``counted`` gives the type of its length."""

    name: str
    kind: str
    counted: str | None = None


@dataclass(frozen=True)
class Element:
    """What a file holds ``count`` of, with the properties of each."""

    name: str
    count: int
    properties: tuple[Property, ...]


@dataclass(frozen=True)
class Header:
    """Byte order, elements, comments, and where the header ends."""

    form: str
    elements: tuple[Element, ...]
    comments: tuple[str, ...]
    end: int

    def count(self, name: str) -> int:
        """Return how many elements of a name there are."""
        return sum(element.count for element in self.elements if element.name == name)


def read_header(content: bytes) -> Header:
    """Return the header at the beginning of a file; ValueError where there is none."""
    end, after = _ends(content)
    lines = [line.split() for line in content[:end].decode("utf-8", "replace").splitlines()]
    form, comments, elements = "", [], list[tuple[str, int, list[Property]]]()
    for words in lines:
        if words[:1] == ["format"]:
            form = words[1]
        elif words[:1] == ["comment"]:
            comments.append(" ".join(words[1:]))
        elif words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            elements[-1][2].append(_property(words))
    if any(count < 0 for _, count, _ in elements):
        raise ValueError("an element has a count below 0")
    if len({name for name, *_ in elements}) < len(elements):
        raise ValueError("two elements have one name")
    if form not in ORDERS:
        raise ValueError(f"its format is {form!r}, none of {', '.join(ORDERS)}")
    return Header(form, tuple(Element(name, n, tuple(each)) for name, n, each in elements), tuple(comments), after)


def _ends(content: bytes) -> tuple[int, int]:
    """Where the last line of the header begins, and what follows it."""
    if not content.startswith(b"ply"):
        raise ValueError("it does not begin with a PLY header")
    end = content[:_HEADER].find(b"end_header")
    after = (content.find(b"\n", end) + 1 or content.find(b"\r", end) + 1) if end >= 0 else 0
    if not after:
        raise ValueError("its header has no end: export or copy it again")
    return end, after


def _property(words: list[str]) -> Property:
    if words[1] == "list":
        return Property(words[4], _KINDS[words[3]], _KINDS[words[2]])
    return Property(words[2], _KINDS[words[1]])


@dataclass(frozen=True)
class ElementValues:
    """Values of an element's properties: ``single`` [element] each, ``lists`` as values [value] and lengths [element].

    ``start`` and ``end`` are where it lies: bytes of a binary file, rows of a text.
    """

    single: dict[str, NDArray[Any]]
    lists: dict[str, tuple[NDArray[Any], NDArray[np.int64]]]
    start: int
    end: int


def read_tables(content: bytes, header: Header, rows: list[bytes]) -> dict[str, ElementValues]:
    """Return the table of each element; ``rows`` are the lines of a text that follow its header."""
    tables: dict[str, ElementValues] = {}
    at = 0 if rows else header.end
    for element in header.elements:
        if header.form == "ascii":
            table = _text_table(element, rows, at)
        else:
            table = _binary_table(content, element, ORDERS[header.form], at)
        tables[element.name], at = table, table.end
    return tables


def _text_table(element: Element, rows: list[bytes], at: int) -> ElementValues:
    end = at + element.count
    if end > len(rows):
        raise ValueError(_CUT_OFF.format(element.count, element.name))
    words = [row.split() for row in rows[at:end]]
    if any(each.counted for each in element.properties):
        return _text_lists(element, words, at)
    columns = len(element.properties)
    if any(len(row) < columns for row in words):
        raise ValueError(f"a row of {element.name!r} has fewer than {columns} numbers")
    values = numbers([word for row in words for word in row[:columns]]).reshape(-1, columns)
    return ElementValues({each.name: values[:, number] for number, each in enumerate(element.properties)}, {}, at, end)


def _text_lists(element: Element, rows: list[list[bytes]], at: int) -> ElementValues:
    found: dict[str, list[list[bytes]]] = {each.name: [] for each in element.properties}
    for row in rows:
        place = 0
        for each in element.properties:
            first, size = (place + 1, int(row[place])) if each.counted else (place, 1)
            place = first + size
            if size < 0 or place > len(row):
                raise ValueError(f"a list of {element.name!r} is shorter than it says: {b' '.join(row)[:60]!r}")
            found[each.name].append(row[first:place])
    return _table(element, {name: _floats(values) for name, values in found.items()}, at, at + element.count)


def _floats(values: list[list[bytes]]) -> tuple[NDArray[Any], NDArray[np.int64]]:
    flat = [word for each in values for word in each]
    return numbers(flat), np.array([len(v) for v in values], np.int64)


def _table(
    element: Element, found: dict[str, tuple[NDArray[Any], NDArray[np.int64]]], at: int, end: int
) -> ElementValues:
    listed = {each.name for each in element.properties if each.counted}
    single = {name: values for name, (values, _) in found.items() if name not in listed}
    return ElementValues(single, {name: found[name] for name in found if name in listed}, at, end)


def _binary_table(content: bytes, element: Element, order: str, at: int) -> ElementValues:
    if not any(each.counted for each in element.properties):
        kind = np.dtype([(each.name, order + each.kind) for each in element.properties])
        _check_end(content, element, at + element.count * kind.itemsize)
        values = np.frombuffer(content, kind, element.count, at) if element.count else np.empty(0, kind)
        return ElementValues(
            {name: values[name] for name in kind.names or ()}, {}, at, at + element.count * kind.itemsize
        )
    return _equal_lists(content, element, order, at) or _lists(content, element, order, at)


def _check_end(content: bytes, element: Element, end: int) -> None:
    """ValueError where a file ends before what is read of an element does."""
    if end > len(content):
        raise ValueError(_CUT_OFF.format(element.count, element.name))


def _equal_lists(content: bytes, element: Element, order: str, at: int) -> ElementValues | None:
    """The table where all lists of a property are as long as the first, as of triangles; else None."""
    if not element.count:
        return None
    fields: list[Any] = []
    for each in element.properties:
        before = np.dtype(fields).itemsize
        if each.counted:
            first = at + before + np.dtype(each.counted).itemsize
            _check_end(content, element, first)
            size = int(np.frombuffer(content, order + each.counted, 1, at + before)[0])
            _check_end(content, element, first + max(size, 0) * np.dtype(each.kind).itemsize)
            fields += [(each.name + "#", order + each.counted), (each.name, order + each.kind, (max(size, 0),))]
        else:
            fields.append((each.name, order + each.kind))
    kind = np.dtype(fields)
    if at + element.count * kind.itemsize > len(content):
        return None
    values = np.frombuffer(content, kind, element.count, at)
    counted = [each.name for each in element.properties if each.counted]
    if any((values[name + "#"] != values[name].shape[1]).any() for name in counted):
        return None
    no_sizes = np.empty(0, np.int64)
    sizes = {name: values[name + "#"].astype(np.int64) for name in counted}
    found = {each.name: (values[each.name].ravel(), sizes.get(each.name, no_sizes)) for each in element.properties}
    return _table(element, found, at, at + element.count * kind.itemsize)


def _lists(content: bytes, element: Element, order: str, at: int) -> ElementValues:
    found: dict[str, list[NDArray[Any]]] = {each.name: [] for each in element.properties}
    kinds = [
        (each, np.dtype(order + (each.counted or "u1")), np.dtype(order + each.kind)) for each in element.properties
    ]
    place = at
    for _ in range(element.count):
        for each, counter, kind in kinds:
            size = 1
            if each.counted:
                _check_end(content, element, place + counter.itemsize)
                size = int(np.frombuffer(content, counter, 1, place)[0])
                if size < 0:  # NumPy takes it for: all that is left
                    raise ValueError(f"a list of {element.name!r} has {size} values")
                place += counter.itemsize
            _check_end(content, element, place + size * kind.itemsize)
            found[each.name].append(np.frombuffer(content, kind, size, place))
            place += size * kind.itemsize
    flat = {
        name: (np.concatenate(values or [np.empty(0)]), np.array([len(each) for each in values], np.int64))
        for name, values in found.items()
    }
    return _table(element, flat, at, place)
