"""Reading pickles that came from elsewhere, without running anything in them.

A pickle is a program: loading one may call whatever it names. The original SMPL, SMPL-H and SMAL files are pickles
of Python 2, of NumPy arrays, SciPy matrices and objects of chumpy (which current Python cannot import).

Here unpickling only *records*: every global that a model file may name stands for a fresh class whose instances keep
the arguments and the state they are given, and do nothing. A global outside that list is refused when it is met. Only
then, and only for what is asked for, :func:`array_of` works out arrays from the record, with code of this module.
Neither NumPy's own unpickling (whose dtypes can be made to lie about pointers) nor SciPy's (which does not check its
indices) ever sees the file.
"""

import pickle
import re
from typing import Any, BinaryIO, ClassVar

import numpy as np
from numpy.typing import NDArray

from datagen.errors import BodyError

_GLOBALS = re.compile(
    r"(?P<reconstruct>numpy\.(?:_core|core)\.multiarray\._reconstruct)"
    r"|(?P<scalar>numpy\.(?:_core|core)\.multiarray\.scalar)"
    r"|(?P<buffer>numpy\.(?:_core|core)\.numeric\._frombuffer)"
    r"|(?P<array>numpy\.ndarray)"
    r"|(?P<dtype>numpy\.dtype)"
    r"|(?P<sparse>scipy\.sparse(?:\.\w+)*\.(?:csc|csr|coo)_(?:matrix|array))"
    r"|(?P<set>(?:builtins|__builtin__)\.set)"
    r"|(?P<object>(?:builtins|__builtin__)\.object)"
    r"|(?P<bytes>(?:builtins|__builtin__)\.bytes)"
    r"|(?P<encode>_codecs\.encode)"
    r"|(?P<instance>(?:copyreg|copy_reg)\._reconstructor)"
    r"|(?P<chumpy>chumpy(?:\.\w+)*)",
    re.ASCII,
)
_PLAIN_DTYPE = re.compile(r"[biufSU][0-9]{1,4}", re.ASCII)
_DEEPEST = 32


class Recorded:
    """What a pickle asked to be made: the arguments and the state it gave. It does nothing with them."""

    origin: ClassVar[str] = ""
    kind: ClassVar[str] = ""
    arguments: tuple[Any, ...]
    state: Any

    def __new__(cls, *arguments: Any, **_: Any) -> "Recorded":
        """Keep the arguments, whatever they are."""
        made = object.__new__(cls)
        made.arguments, made.state = arguments, None
        return made

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _RecordingUnpickler(pickle.Unpickler):
    def __init__(self, file: BinaryIO, name: str) -> None:
        super().__init__(file, encoding="latin1")  # the bytes of Python 2's strings, as NumPy wrote them
        self._name = name
        self._made: dict[str, type[Recorded]] = {}

    def find_class(self, module: str, name: str) -> type[Recorded]:
        origin = f"{module}.{name}"
        admitted = _GLOBALS.fullmatch(origin)
        if admitted is None or "." in name:  # protocol 4 walks dotted names attribute by attribute
            raise BodyError(
                f"{self._name} was not loaded: it is a pickle that wants {origin}, which no body model needs and which "
                "could run code; take the file as its authors publish it, or the .npz version of it"
            )
        # A class of its own for every pickle: a hostile one may spoil the attributes of what it is given.
        made = self._made.get(origin)
        if made is None:
            made = type(name, (Recorded,), {"origin": origin, "kind": admitted.lastgroup})
            self._made[origin] = made
        return made


def unpickle(file: BinaryIO, *, name: str) -> Any:
    """The content of a pickle: plain Python values, and :class:`Recorded` for everything else.

    Parameters
    ----------
    file
        Open in binary mode, at the pickle's first byte.
    name
        What error messages call it.

    Raises
    ------
    BodyError
        The pickle names a global that is not admitted, or is damaged. Nothing of it has been executed.
    """
    try:
        return _RecordingUnpickler(file, name).load()
    except BodyError:
        raise
    except Exception as error:  # a damaged pickle makes the unpickler raise nearly anything
        reason = str(error) or type(error).__name__
        raise BodyError(f"{name} cannot be read as a pickle ({reason}); copy or download it again") from error


def array_of(value: Any, *, name: str) -> NDArray[Any]:
    """The array that a value of :func:`unpickle` stands for, in memory of its own; sparse matrices become dense.

    Raises
    ------
    BodyError
        It is no array of numbers or text, or one that contradicts itself.
    """
    try:
        return _evaluate(value, 0)
    except _NotAnArrayError as error:
        raise BodyError(f"{name} is not an array of numbers: {error}") from error
    except (ValueError, TypeError, IndexError, KeyError, AttributeError, OverflowError) as error:
        raise BodyError(f"{name} is a damaged array ({error}); copy or download the file again") from error


class _NotAnArrayError(Exception):
    pass


def _evaluate(value: Any, depth: int) -> NDArray[Any]:
    if depth > _DEEPEST:
        raise _NotAnArrayError("it is nested without end")
    if isinstance(value, (list, tuple)) and any(isinstance(item, Recorded) for item in value):
        return np.stack([_evaluate(item, depth + 1) for item in value])
    if not isinstance(value, Recorded):
        return _plain(np.asarray(value)) if isinstance(value, (int, float, list, tuple)) else _refuse(value)
    if value.kind == "instance":
        return _evaluate(_instance(value), depth + 1)
    return _EVALUATORS.get(value.kind, _refuse_kind)(value, depth)


def _plain(array: NDArray[Any]) -> NDArray[Any]:
    return array if array.dtype.kind in "biuf" else _refuse(array.tolist())


def _refuse(value: Any) -> NDArray[Any]:
    raise _NotAnArrayError(f"it holds {type(value).__name__}")


def _refuse_kind(value: Recorded, depth: int) -> NDArray[Any]:
    raise _NotAnArrayError(f"it holds {value.origin}")


def _instance(value: Recorded) -> Recorded:
    """Protocols 0 and 1 wrote objects as copy_reg._reconstructor(class, object, None) and a state."""
    made: Recorded = object.__new__(value.arguments[0])
    made.arguments, made.state = (), value.state
    if not isinstance(made, Recorded):
        raise _NotAnArrayError(f"it holds {type(made).__name__}")
    return made


def _reconstructed(value: Recorded, depth: int) -> NDArray[Any]:
    """An array as NumPy pickles it: state ([version,] shape, dtype, column-major, bytes)."""
    shape, dtype, column_major, content = value.state[-4:]
    if isinstance(content, list) and tuple(shape) == () and len(content) == 1:
        return _evaluate(content[0], depth + 1)  # an object wrapped by np.save
    return _from_bytes(content, dtype, shape, "F" if column_major else "C")


def _from_buffer(value: Recorded, depth: int) -> NDArray[Any]:
    """An array as NumPy pickles it with protocol 5: _frombuffer(bytes, dtype, shape, order)."""
    content, dtype, shape, order = value.arguments[:4]
    return _from_bytes(content, dtype, shape, "F" if order == "F" else "C")


def _scalar(value: Recorded, depth: int) -> NDArray[Any]:
    dtype, content = value.arguments
    return _from_bytes(content, dtype, (), "C")


def _from_bytes(content: Any, dtype: Any, shape: Any, order: Any) -> NDArray[Any]:
    return np.frombuffer(_bytes(content), _dtype(dtype)).reshape(shape, order=order).copy()


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


def _sparse(value: Recorded, depth: int) -> NDArray[Any]:
    """A SciPy matrix as a dense array; indices outside it are an IndexError of NumPy's."""
    state = value.state
    data = _evaluate(state["data"], depth + 1)
    dense = np.zeros(tuple(int(_evaluate(size, depth + 1)) for size in state["_shape"]), data.dtype)
    np.add.at(dense, _places(value, depth), data)
    return dense


def _places(value: Recorded, depth: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Row and column of every entry of a SciPy matrix."""
    state, layout = value.state, value.origin.rsplit(".", 1)[1][:3]
    if layout == "coo":
        row, column = state["coords"] if "coords" in state else (state["row"], state["col"])
        return _evaluate(row, depth + 1), _evaluate(column, depth + 1)
    along = _evaluate(state["indices"], depth + 1)
    starts = _evaluate(state["indptr"], depth + 1)
    across = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    return (along, across) if layout == "csc" else (across, along)


def _chumpy(value: Recorded, depth: int) -> NDArray[Any]:
    """The three objects of chumpy that model files hold arrays in: Ch, and selections and reshapings of one."""
    name = value.origin.rsplit(".", 1)[1]
    if name == "Ch":
        return _evaluate(value.state["x"], depth + 1)
    if name == "Select":
        chosen = _evaluate(value.state["a"], depth + 1).ravel()[_evaluate(value.state["idxs"], depth + 1)]
        return chosen.reshape(value.state.get("preferred_shape", chosen.shape))
    if name == "Reshape":
        return _evaluate(value.state["a"], depth + 1).reshape(value.state["newshape"])
    return _refuse_kind(value, depth)


_EVALUATORS = {
    "reconstruct": _reconstructed,
    "buffer": _from_buffer,
    "scalar": _scalar,
    "sparse": _sparse,
    "chumpy": _chumpy,
}
