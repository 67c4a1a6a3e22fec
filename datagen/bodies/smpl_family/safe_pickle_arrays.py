"""Arrays worked out from what :mod:`datagen.bodies.smpl_family.safe_pickle` recorded, with code of this module
alone."""

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.bodies.smpl_family.safe_pickle import Recorded
from datagen.common.errors import BodyError

_PLAIN_DTYPE = re.compile(r"[biufSU][0-9]{1,4}", re.ASCII)
_DEEPEST = 32
_LARGEST = 2**30  # bytes that working out one array may take; SMPL-X's largest, 10,475 x 3 x 486 numbers, has 122 MB


def array_of(value: Any, *, name: str) -> NDArray[Any]:
    """The array that a value of :func:`unpickle` stands for, in memory of its own; sparse matrices become dense.

    Raises
    ------
    BodyError
        It is no array of numbers or text, or one that contradicts itself.
    """
    try:
        return _Work().evaluate(value)
    except _NotAnArrayError as error:
        raise BodyError(f"{name} is not an array of numbers: {error}") from error
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RuntimeError, MemoryError) as error:
        raise BodyError(f"{name} is a damaged array ({error}); copy or download the file again") from error


class _NotAnArrayError(Exception):
    pass


class _Work:
    """Working out one array: what is done already, and how much it took.

    A few bytes of a pickle may stand for much, as what is made once can be named often. So everything is worked out
    once, and sizes are known before memory is taken.
    """

    def __init__(self) -> None:
        self._done: dict[int, tuple[Any, NDArray[Any]]] = {}  # keeps values, so that none takes another's id
        self._depth = self._bytes = 0

    def evaluate(self, value: Any) -> NDArray[Any]:
        if id(value) not in self._done:
            if self._depth > _DEEPEST:
                raise _NotAnArrayError("it is nested without end")
            self._depth += 1
            self._done[id(value)] = value, _evaluate(value, self)
            self._depth -= 1
        return self._done[id(value)][1]

    def take(self, size: int) -> None:
        """Count bytes that are about to be used."""
        self._bytes += size
        if self._bytes > _LARGEST:
            raise _NotAnArrayError(
                f"it takes {self._bytes / 2**30:.3g} GiB or more, and no body model's takes a fraction of that"
            )


def _evaluate(value: Any, work: _Work) -> NDArray[Any]:
    if isinstance(value, (list, tuple)) and any(isinstance(item, (Recorded, list, tuple)) for item in value):
        return _stacked([work.evaluate(item) for item in value], work)
    if not isinstance(value, Recorded):
        return _plain(np.asarray(value)) if isinstance(value, (int, float, list, tuple)) else _refuse(value)
    if value.kind == "instance":
        return work.evaluate(_instance(value))
    return _EVALUATORS.get(value.kind, _refuse_kind)(value, work)


def _stacked(arrays: list[NDArray[Any]], work: _Work) -> NDArray[Any]:
    work.take(sum(array.size for array in arrays) * max(8, *(array.itemsize for array in arrays)))
    return np.stack(arrays)


def _plain(array: NDArray[Any]) -> NDArray[Any]:
    return array if array.dtype.kind in "biuf" else _refuse(array.tolist())


def _refuse(value: Any) -> NDArray[Any]:
    raise _NotAnArrayError(f"it holds {type(value).__name__}")


def _refuse_kind(value: Recorded, work: _Work) -> NDArray[Any]:
    raise _NotAnArrayError(f"it holds {value.origin}")


def _instance(value: Recorded) -> Recorded:
    """Protocols 0 and 1 wrote objects as copy_reg._reconstructor(class, object, None) and a state."""
    made: Recorded = object.__new__(value.arguments[0])
    made.arguments, made.state = (), value.state
    if not isinstance(made, Recorded):
        raise _NotAnArrayError(f"it holds {type(made).__name__}")
    return made


def _reconstructed(value: Recorded, work: _Work) -> NDArray[Any]:
    """An array as NumPy pickles it: state ([version,] shape, dtype, column-major, bytes)."""
    shape, dtype, column_major, content = value.state[-4:]
    if isinstance(content, list) and tuple(shape) == () and len(content) == 1:
        return work.evaluate(content[0])  # an object wrapped by np.save
    return _from_bytes(content, dtype, shape, "F" if column_major else "C", work)


def _from_buffer(value: Recorded, work: _Work) -> NDArray[Any]:
    """An array as NumPy pickles it with protocol 5: _frombuffer(bytes, dtype, shape, order)."""
    content, dtype, shape, order = value.arguments[:4]
    return _from_bytes(content, dtype, shape, "F" if order == "F" else "C", work)


def _scalar(value: Recorded, work: _Work) -> NDArray[Any]:
    dtype, content = value.arguments
    return _from_bytes(content, dtype, (), "C", work)


def _from_bytes(content: Any, dtype: Any, shape: Any, order: Any, work: _Work) -> NDArray[Any]:
    plain = _bytes(content)
    work.take(len(plain))
    return np.frombuffer(plain, _dtype(dtype)).reshape(shape, order=order).copy()


def _dtype(value: Any) -> np.dtype[Any]:
    """A plain dtype, of numbers or text; those with fields, objects or times are no business of a body model."""
    code = value.arguments[0] if isinstance(value, Recorded) and value.kind == "dtype" else value
    if not isinstance(code, str) or _PLAIN_DTYPE.fullmatch(code) is None:
        raise _NotAnArrayError(f"its elements are of type {code!r}")
    order = value.state[1] if isinstance(value, Recorded) and value.state else "|"
    return np.dtype({"<": "<", ">": ">", "=": "<", "|": "<"}[order] + code)


def _bytes(value: Any) -> bytes | bytearray:
    if isinstance(value, Recorded) and value.kind == "encode" and value.arguments[1:] in ((), ("latin1",)):
        value = value.arguments[0]
    if isinstance(value, Recorded) and value.kind == "bytes" and not value.arguments:
        return b""  # as Python 3 writes it for Python 2
    if isinstance(value, str):
        return value.encode("latin1")
    if isinstance(value, (bytes, bytearray)):
        return value
    raise _NotAnArrayError(f"its bytes are {type(value).__name__}")


def _sparse(value: Recorded, work: _Work) -> NDArray[Any]:
    """A SciPy matrix as a dense array; indices outside it are an IndexError of NumPy's."""
    state = value.state
    data = work.evaluate(state["data"])
    shape = tuple(int(work.evaluate(size)) for size in state["_shape"])
    work.take(math.prod(shape) * data.itemsize)
    dense = np.zeros(shape, data.dtype)
    np.add.at(dense, _places(value, work), data)
    return dense


def _places(value: Recorded, work: _Work) -> tuple[NDArray[Any], NDArray[Any]]:
    """Row and column of every entry of a SciPy matrix."""
    state, layout = value.state, value.origin.rsplit(".", 1)[1][:3]
    if layout == "coo":
        row, column = state["coords"] if "coords" in state else (state["row"], state["col"])
        return work.evaluate(row), work.evaluate(column)
    along = work.evaluate(state["indices"])
    starts = work.evaluate(state["indptr"])
    counts = np.diff(starts)
    if counts.size and not (counts.min() >= 0 and counts.max() <= len(along) == counts.sum()):
        raise _NotAnArrayError("the rows or columns of a sparse matrix do not fit its numbers")
    work.take(8 * len(along))
    across = np.repeat(np.arange(len(starts) - 1), counts)
    return (along, across) if layout == "csc" else (across, along)


def _chumpy(value: Recorded, work: _Work) -> NDArray[Any]:
    """The three objects of chumpy that model files hold arrays in: Ch, and selections and reshapings of one."""
    name = value.origin.rsplit(".", 1)[1]
    if name == "Ch":
        return work.evaluate(value.state["x"])
    if name == "Select":
        source, places = work.evaluate(value.state["a"]), work.evaluate(value.state["idxs"])
        work.take(places.size * source.itemsize)
        chosen = source.ravel()[places]
        return chosen.reshape(value.state.get("preferred_shape", chosen.shape))
    if name == "Reshape":
        return work.evaluate(value.state["a"]).reshape(value.state["newshape"])
    return _refuse_kind(value, work)


_EVALUATORS = {
    "reconstruct": _reconstructed,
    "buffer": _from_buffer,
    "scalar": _scalar,
    "sparse": _sparse,
    "chumpy": _chumpy,
}
