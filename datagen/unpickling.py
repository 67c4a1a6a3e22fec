"""Reading pickles that came from elsewhere, without running anything in them.

A pickle is a program: loading one may call whatever it names. The original SMPL, SMPL-H and SMAL files are pickles
of Python 2, of NumPy arrays, SciPy matrices and objects of chumpy (which current Python cannot import).

Here unpickling only *records*: every global that a model file may name stands for a fresh class whose instances keep
the arguments and the state they are given, and do nothing. A global outside that list is refused when it is met. Only
then, and only for what is asked for, :func:`datagen.recorded_arrays.array_of` works out arrays from the record.
Neither NumPy's own unpickling (whose dtypes can be made to lie about pointers) nor SciPy's (which does not check its
indices) ever sees the file.
"""

import pickle
import pickletools
import re
from typing import Any, BinaryIO, ClassVar

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

_MOST_STEPS = 2_000_000  # of a pickle; a body model's has some thousands
_KEEPING = ("PUT", "BINPUT", "LONG_BINPUT")


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
    """Refuse a pickle of more steps than memory holds, or that numbers what it keeps far beyond them (ValueError).

    Python takes memory for every number up to the highest: ten bytes can ask for 64 GiB.
    """
    start = file.tell()
    for step, (code, argument, _) in enumerate(pickletools.genops(file)):
        if step > _MOST_STEPS or (code.name in _KEEPING and int(argument or 0) > step):
            raise ValueError("it would take more memory than any body model")
    file.seek(start)


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
        reason = str(error) or type(error).__name__
        raise BodyError(f"{name} cannot be read as a pickle ({reason}); copy or download it again") from error
