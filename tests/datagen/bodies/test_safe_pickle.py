"""Pickles from elsewhere: what body models hold is read, everything else is refused before it can do anything."""

import functools
import io
import os
import pickle
import pickletools
import struct
import subprocess
import time
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse

from datagen.bodies.smpl_family.model_file import read_arrays
from datagen.bodies.smpl_family.safe_pickle import Recorded, unpickle
from datagen.bodies.smpl_family.safe_pickle_arrays import array_of
from datagen.common.errors import BodyError
from tests.support.shapes.models import fake_chumpy

PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)


def read(content: bytes) -> Any:
    return unpickle(io.BytesIO(content), name="model.pkl")


def array(content: bytes) -> np.ndarray:
    return array_of(read(content), name="'x' in model.pkl")


def text(value: str) -> bytes:
    return b"\x8c" + struct.pack("<B", len(value)) + value.encode()


def dotted(module: str, name: str) -> bytes:
    """Protocol 4 opcodes that push a global whose name may walk attributes."""
    return b"\x80\x04" + text(module) + text(name) + b"\x93"


class Call:
    """Pickles as a call of a function."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.called = (function, arguments)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self.called


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize(
    "original",
    [
        np.arange(12.0).reshape(3, 4),
        np.asfortranarray(np.arange(12, dtype=np.int16).reshape(3, 4)),
        np.arange(5, dtype=">f4"),
        np.array([True, False]),
        np.array(["lbs", "längs"]),
        np.zeros((0, 3), np.uint32),
        np.float64(2.5),
        np.array(7),
    ],
    ids=lambda original: f"{original.dtype}{list(original.shape)}",
)
def test_arrays_come_back(original: np.ndarray, protocol: int) -> None:
    read_back = array(pickle.dumps(original, protocol))
    assert np.array_equal(read_back, original) and read_back.dtype.kind == original.dtype.kind
    assert read_back.flags.writeable and read_back.flags.owndata


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("layout", ["csc_matrix", "csr_matrix", "coo_matrix"])
def test_sparse_matrices_come_back_dense(layout: str, protocol: int) -> None:
    dense = np.where(np.arange(20).reshape(4, 5) % 3, 0, np.arange(20.0).reshape(4, 5))
    assert np.array_equal(array(pickle.dumps(getattr(scipy.sparse, layout)(dense), protocol)), dense)


def test_scipys_old_module_paths_are_known() -> None:
    """SMPL's own files name scipy.sparse.csc, a module that SciPy took away; repeated entries add up."""
    content = pickle.dumps(scipy.sparse.coo_matrix(([1.0, 2.0], ([0, 0], [1, 1])), (2, 2)), 2)
    old = content.replace(b"scipy.sparse._coo", b"scipy.sparse.coo")
    assert old != content
    assert np.array_equal(array(old), [[0, 3], [0, 0]])


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_chumpys_objects_come_back_without_chumpy(protocol: int) -> None:
    with fake_chumpy() as (ch, select):
        held, chosen = ch.__new__(ch), select.__new__(select)
        held.__dict__.update(x=np.arange(24.0).reshape(2, 3, 4), _dirty_vars={"x"})
        chosen.__dict__.update(a=held, idxs=np.array([23, 0, 5, 6]), preferred_shape=(2, 2))
        content = pickle.dumps([held, chosen], protocol)
    first, second = read(content)
    assert isinstance(first, Recorded) and isinstance(second, Recorded)
    assert np.array_equal(array_of(first, name="x"), np.arange(24.0).reshape(2, 3, 4))
    assert np.array_equal(array_of(second, name="x"), [[23, 0], [5, 6]])


def test_python_2_strings_are_keys_and_bytes() -> None:
    """A dictionary as Python 2 wrote it: str opcodes, the array's bytes in a str, __builtin__.set."""
    key, raw = b"U\x01x", np.array([0x80, 0xFF], np.uint8).tobytes()
    dtype = b"cnumpy\ndtype\n(U\x02u1K\x00K\x01tR(K\x03U\x01|NNNI-1\nI-1\nK\x00tb"
    made = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tU\x01btR"
    content = b"\x80\x02}(" + key + made + b"(K\x01(K\x02t" + dtype + b"\x89U\x02" + raw + b"tb"
    content += b"U\x01sc__builtin__\nset\n(](U\x01xetRu."
    pickletools.dis(content, out=io.StringIO())
    decoded = read(content)
    assert set(decoded) == {"x", "s"}
    assert np.array_equal(array_of(decoded["x"], name="x"), [0x80, 0xFF])


def test_text_pickles_of_python_2_hold_any_bytes() -> None:
    """Protocol 0, in which the oldest models are published: its strings are escaped bytes, which are no ASCII."""
    assert read(b"(dp0\nS'f'\np1\nS'\\xff\\x00\\x80'\np2\ns.") == {"f": "\xff\x00\x80"}


@pytest.mark.parametrize(
    "content",
    [
        b"\x80\x02Nr\xff\xff\xff\x7f.",  # kept as number 2^31
        b"Np2000000000\n.",
        b"\x80\x04\x96" + struct.pack("<Q", 2**40) + b".",  # a bytearray of a terabyte
        b"\x80\x04\x95" + struct.pack("<Q", 2**40) + b"N.",
        b"\x80\x02T" + struct.pack("<i", -1) + b".",
    ],
)
def test_sizes_that_are_promised_take_no_memory(content: bytes) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(BodyError, match=r"cannot be read as a pickle \(it (would take more|is cut off)"):
            read(content)
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def hostile_pickles(mark: Path) -> dict[str, tuple[bytes, str]]:
    """Pickles that would make the file ``mark`` or get at a function, and the global to be named in the refusal."""
    command = f"touch {mark}"
    touch = Call(os.system, command)
    import builtins

    evaluated = Call(builtins.eval, f"__import__('os').system({command!r})")
    partial = functools.partial(os.system, command)
    state = text(command) + b"\x85R."
    return {
        "os.system": (pickle.dumps(touch), f"{os.system.__module__}.system"),
        "protocol 0": (pickle.dumps(touch, 0), f"{os.system.__module__}.system"),
        "popen": (pickle.dumps(Call(subprocess.Popen, ["touch", str(mark)])), "subprocess.Popen"),
        "eval": (pickle.dumps(evaluated, 2), "__builtin__.eval"),
        "exec": (pickle.dumps(Call(builtins.exec, f"open({str(mark)!r}, 'w')")), "builtins.exec"),
        "open": (pickle.dumps(Call(open, str(mark), "w")), "open"),
        "getattr": (pickle.dumps(Call(getattr, partial, "func")), "builtins.getattr"),
        "partial": (pickle.dumps(Call(partial)), "functools.partial"),
        "inside an array's state": (pickle.dumps({"v_template": np.zeros(3), "f": [touch]}), "system"),
        "in an object array": (pickle.dumps(np.array([touch, None], object)), "system"),
        "after good keys": (pickle.dumps([np.zeros(3), scipy.sparse.eye(3).tocsc(), touch]), "system"),
        "dotted in numpy": (dotted("numpy", "ndarray.__class__.__subclasses__") + b")R.", "numpy.ndarray.__class__"),
        "dotted in chumpy": (
            dotted("chumpy.ch", "Ch.__init__.__globals__") + b".",
            "chumpy.ch.Ch.__init__.__globals__",
        ),
        "dotted module": (dotted("numpy.core.multiarray", "_reconstruct.__globals__") + b".", "__globals__"),
        "numpy's own": (dotted("numpy.testing._private.utils", "runstring") + state, "runstring"),
        "numpy.load": (dotted("numpy", "load") + state, "numpy.load"),
        "scipy's io": (dotted("scipy.sparse", "load_npz") + state, "scipy.sparse.load_npz"),
        "scipy's neighbour": (dotted("scipy.sparse_evil", "csc_matrix") + b")R.", "scipy.sparse_evil"),
        "chumpy's neighbour": (dotted("chumpyevil", "Ch") + b")R.", "chumpyevil.Ch"),
        "a newline in the name": (dotted("numpy", "ndarray\n") + b".", "numpy.ndarray"),
        "copyreg": (dotted("copyreg", "add_extension") + b".", "copyreg.add_extension"),
        "codecs": (dotted("_codecs", "decode") + b".", "_codecs.decode"),
        "dtype's relatives": (dotted("numpy.dtypes", "ObjectDType") + b".", "numpy.dtypes.ObjectDType"),
    }


@pytest.mark.parametrize("trick", sorted(hostile_pickles(Path("mark"))))
def test_hostile_pickles_are_refused_by_name_and_leave_no_trace(trick: str, tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    content, named = hostile_pickles(mark)[trick]
    with pytest.raises(BodyError) as refusal:
        read(content)
    message = str(refusal.value)
    assert named in message and "model.pkl" in message and ".npz" in message and "could run code" in message
    assert not mark.exists()


def test_the_hostile_pickles_do_harm_when_pickle_loads_them(tmp_path: Path) -> None:
    """Otherwise the test above would prove nothing."""
    for trick in ("os.system", "protocol 0", "eval", "exec", "open", "in an object array"):
        mark = tmp_path / trick.replace(" ", "-")
        pickle.loads(hostile_pickles(mark)[trick][0])
        assert mark.exists(), trick


def test_what_a_pickle_calls_and_sets_is_only_recorded() -> None:
    """Build and reduce opcodes on admitted classes run nothing and reach nothing outside their own pickle."""
    spoil = dotted("chumpy.ch", "Ch") + b"}" + text("x") + b"K\x07sb."  # BUILD on the class itself
    with pytest.raises(BodyError, match="cannot be read"):
        read(spoil)
    slots = dotted("chumpy.ch", "Ch") + b"N}" + text("__setstate__") + b"K\x07s\x86b."
    with pytest.raises(BodyError, match="cannot be read"):
        read(slots)
    value = read(dotted("_codecs", "encode") + text("rot13") + text("rot13") + b"\x86R.")
    assert isinstance(value, Recorded) and value.arguments == ("rot13", "rot13")
    with fake_chumpy() as (ch, _):
        held = ch.__new__(ch)
        held.__dict__.update(x=1.5)
        assert array(pickle.dumps(held)) == 1.5


LYING = {
    "object dtype": lambda: pickle.dumps(np.array([None, 1], object)),
    "dtype with fields": lambda: pickle.dumps(np.zeros(2, [("a", "f8"), ("b", "O")])),
    "times": lambda: pickle.dumps(np.zeros(2, "datetime64[s]")),
    "too few bytes": lambda: pickle.dumps(np.arange(3.0), 4).replace(b"K\x03\x85", b"K\x04\x85"),
    "sparse index outside": lambda: pickle.dumps(_corrupt(scipy.sparse.csc_matrix(np.eye(3)), "indices", 2**20)),
    "sparse pointers backwards": lambda: pickle.dumps(_corrupt(scipy.sparse.csr_matrix(np.eye(3)), "indptr", -5)),
    "a word": lambda: pickle.dumps("lbs"),
    "a dictionary": lambda: pickle.dumps({"x": 1}),
    "ragged lists": lambda: pickle.dumps([[1.0], [1.0, 2.0]]),
}


def _corrupt(matrix: Any, member: str, value: int) -> Any:
    getattr(matrix, member)[1] = value
    return matrix


@pytest.mark.parametrize("lie", sorted(LYING))
def test_arrays_that_lie_are_refused(lie: str) -> None:
    with pytest.raises(BodyError, match=r"'x' in model\.pkl"):
        array(LYING[lie]())


def test_a_byte_order_cannot_smuggle_a_dtype_in() -> None:
    state = b"(K\x03" + text("O,") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    dtype = dotted("numpy", "dtype")[2:] + text("f8") + b"\x85R" + state
    scalar = b"\x80\x04" + dotted("numpy.core.multiarray", "scalar")[2:] + dtype + b"C\x10" + b"A" * 16 + b"\x86R."
    with pytest.raises(BodyError, match=r"'x' in model\.pkl"):
        array(scalar)


def test_an_array_that_holds_itself_ends() -> None:
    content = dotted("chumpy.ch", "Ch") + b")\x81\x94}" + text("x") + b"h\x00sb."
    with pytest.raises(BodyError, match="without end"):
        array(content)


@pytest.mark.parametrize("content", [b"", b"hello", b"\x80\x04", pickle.dumps(np.arange(5.0))[:-9], b"\x80\x63."])
def test_damaged_pickles_are_one_sentence(content: bytes) -> None:
    with pytest.raises(BodyError, match=r"model\.pkl cannot be read as a pickle"):
        read(content)


def test_object_members_of_npz_go_the_same_way(tmp_path: Path) -> None:
    """np.savez wraps a sparse matrix in an object array; hostile ones are refused, if anyone asks for them at all."""
    mark, matrix = tmp_path / "mark", scipy.sparse.csc_matrix(np.eye(4))
    hostile = np.empty((), object)
    hostile[()] = Call(os.system, f"touch {mark}")
    np.savez(tmp_path / "m.npz", J_regressor=np.array(matrix, object), joint2num=hostile, f=np.arange(3))
    arrays = read_arrays(tmp_path / "m.npz", ("J_regressor", "f"))
    assert np.array_equal(arrays["J_regressor"], np.eye(4)) and np.array_equal(arrays["f"], np.arange(3))
    with pytest.raises(BodyError, match=r"'joint2num' in .*m\.npz was not loaded: .*\.system"):
        read_arrays(tmp_path / "m.npz", ("joint2num",))
    assert not mark.exists()


def _shared(depth: int, *, chumpy: bool) -> bytes:
    """A pickle of a list of eight times the same, of which each is a list of eight times the same ..."""
    with fake_chumpy() as (ch, _):
        value: Any = 1.5
        for _ in range(depth):
            value = [value] * 8
            if chumpy:
                held = ch.__new__(ch)
                held.__dict__.update(x=value)
                value = held
        return pickle.dumps(value)


def _sparse_of_shape(*shape: int) -> bytes:
    matrix = scipy.sparse.csc_matrix(np.eye(3))
    matrix._shape = shape
    return pickle.dumps(matrix)


LARGE = {
    "shared objects": lambda: _shared(15, chumpy=True),
    "shared lists": lambda: _shared(15, chumpy=False),
    "a sparse matrix of 1e14 numbers": lambda: _sparse_of_shape(10**7, 10**7),
    "a sparse matrix that repeats": lambda: pickle.dumps(_corrupt(scipy.sparse.csr_matrix(np.eye(3)), "indptr", 10**9)),
    "a hundred large sparse matrices": lambda: pickle.dumps([pickle.loads(_sparse_of_shape(5000, 1000))] * 100),
}


@pytest.mark.parametrize("kind", sorted(LARGE))
def test_few_bytes_that_stand_for_many_are_refused_at_once(kind: str) -> None:
    content = LARGE[kind]()
    assert len(content) < 10_000
    started = time.perf_counter()
    with pytest.raises(BodyError, match=r"'x' in model\.pkl is not an array of numbers: (it takes .* GiB|the rows)"):
        array(content)
    assert time.perf_counter() - started < 5


def test_what_is_named_often_is_worked_out_once() -> None:
    assert array(_shared(5, chumpy=True)).shape == (8,) * 5
    assert array(pickle.dumps([[1, 2, 3]] * 50_000)).shape == (50_000, 3)


def test_the_header_is_looked_at_before_anything_is_unpacked(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "m.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("f.npy", b"no header" + bytes(2**26))
    tracemalloc.start()
    try:
        with pytest.raises(BodyError, match="is damaged"):
            read_arrays(tmp_path / "m.npz", ("f",))
        assert tracemalloc.get_traced_memory()[1] < 2**22
    finally:
        tracemalloc.stop()


def test_what_is_said_of_a_damaged_archive_is_short(tmp_path: Path) -> None:
    """Python quotes the whole name in a member's header, be it thousands of bytes."""
    content = io.BytesIO()
    np.savez(content, f=np.zeros((500, 3)))
    changed = bytearray(content.getvalue())
    struct.pack_into("<H", changed, 26, 8000)  # the length of the name
    (tmp_path / "m.npz").write_bytes(changed)
    with pytest.raises(BodyError, match="is damaged") as caught:
        read_arrays(tmp_path / "m.npz", ("f",))
    assert len(str(caught.value)) < 500 + len(str(tmp_path))
