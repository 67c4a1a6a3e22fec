"""Reading pickles that came from elsewhere, without running anything in them.

A pickle is a program: loading one may call whatever it names. The original SMPL, SMPL-H and SMAL files are pickles
of Python 2, of NumPy arrays, SciPy matrices and objects of chumpy (which current Python cannot import).

Here unpickling only *records*: every global that a model file may name stands for a fresh class whose instances keep
the arguments and the state they are given, and do nothing. A global outside that list is refused when it is met. Only
then, and only for what is asked for, :func:`datagen.bodies.smpl_family.safe_pickle_arrays.array_of` works out arrays
from the record.
Neither NumPy's own unpickling (whose dtypes can be made to lie about pointers) nor SciPy's (which does not check its
indices) ever sees the file.
"""

import os
import pickle
import pickletools
import re
import struct
from typing import Any, BinaryIO, ClassVar

from datagen.common.errors import BodyError, reason_of

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

_MOST_STEPS = 2_000_000  # of a pickle; a body model's has some thousands
_CODES = {code.code.encode("latin1"): code for code in pickletools.opcodes}
_KEEPING = {"BINPUT": "<B", "LONG_BINPUT": "<I"}
_SIZES = {"FRAME": "<Q"}
_COUNTED = {
    pickletools.TAKEN_FROM_ARGUMENT1: "<B",
    pickletools.TAKEN_FROM_ARGUMENT4: "<i",
    pickletools.TAKEN_FROM_ARGUMENT4U: "<I",
    pickletools.TAKEN_FROM_ARGUMENT8U: "<Q",
}
"""How arguments that begin with their own size write it."""


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


def _require_modest(file: BinaryIO) -> None:
    """Refuse a pickle of more steps than memory holds, or that promises more than it has (ValueError).

    Python takes memory for sizes before it reads so many bytes, and for every number of what is kept up to the highest:
    ten bytes can ask for 64 GiB. Arguments are passed over and not decoded, as :mod:`pickletools` would: it refuses the
    text strings of Python 2, which hold any bytes.
    """
    start = file.tell()
    end = file.seek(0, os.SEEK_END)
    file.seek(start)
    step, name = 0, ""
    while name != "STOP":
        name, kept = _pass_over(file, end)
        if step > _MOST_STEPS or kept > step:
            raise ValueError("it would take more memory than any body model")
        step += 1
    file.seek(start)


def _pass_over(file: BinaryIO, end: int) -> tuple[str, int]:
    """Pass over one step: its name, and the number that it keeps something by (else 0)."""
    code = _CODES.get(file.read(1))
    if code is None:
        raise ValueError("it is cut off, or no pickle")
    form = _KEEPING.get(code.name) or _SIZES.get(code.name) or (_COUNTED.get(code.arg.n) if code.arg else None)
    if form:
        (number,) = struct.unpack(form, file.read(struct.calcsize(form)))
        if code.name in _KEEPING:
            return code.name, number
        if not 0 <= number <= end - file.tell():
            raise ValueError(f"it is cut off: {number:,} bytes are promised")
        if code.name not in _SIZES:
            file.seek(number, os.SEEK_CUR)
    elif code.arg and code.arg.n == pickletools.UP_TO_NEWLINE:
        line = file.readline()
        if code.name in ("GLOBAL", "INST"):
            file.readline()
        return code.name, int(line) if code.name == "PUT" else 0
    elif code.arg:
        file.seek(code.arg.n, os.SEEK_CUR)
    return code.name, 0


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
        _require_modest(file)
        return _RecordingUnpickler(file, name).load()
    except BodyError:
        raise
    except Exception as error:  # a damaged pickle makes the unpickler raise nearly anything
        raise BodyError(f"{name} cannot be read as a pickle ({reason_of(error)}); copy or download it again") from error
