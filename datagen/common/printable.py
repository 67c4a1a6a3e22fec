"""Text that somebody else chose, such as a file's name, made fit for terminals, pages and pictures.

A control character can move a terminal's cursor or change its colours, a bidirectional override turns a line around,
and half a surrogate pair (a byte of a file's name that is not UTF-8) cannot be written at all. They are shown as
Python's escapes instead.
"""

import difflib
import re
from collections.abc import Iterable

_CONTROLS = r"\x00-\x1f\x7f-\x9f"
_OVERRIDES = r"\u202a-\u202e\u2066-\u2069"
_SURROGATES = r"\ud800-\udfff"
_ANY = re.compile(f"[{_CONTROLS}{_OVERRIDES}{_SURROGATES}]")
_BUT_LINES = re.compile(rf"(?![\n\t])[{_CONTROLS}{_OVERRIDES}{_SURROGATES}]")


def printable(text: object) -> str:
    r"""Return text as one line, with what does not print as an escape.

    >>> print(printable("a\x1b[31mred\nb"))
    a\x1b[31mred\nb
    """
    return _ANY.sub(_escape, str(text))


def printable_lines(text: object) -> str:
    """Return text of several lines, with what does not print (other than ends of lines and tabs) as an escape."""
    return _BUT_LINES.sub(_escape, str(text))


def counted(count: int, noun: str) -> str:
    """Return a number of things in words.

    >>> counted(1, "pose"), counted(1200, "pose")
    ('1 pose', '1,200 poses')
    """
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def _escape(found: "re.Match[str]") -> str:
    return found[0].encode("unicode_escape").decode("ascii")


def nearest(name: str, known: Iterable[str]) -> str:
    """Return words that suggest the known name nearest to one that is not, or none."""
    by_letters = {each.casefold(): each for each in known}
    close = difflib.get_close_matches(name.casefold(), by_letters, n=1, cutoff=0.5)
    return f", did you mean {by_letters[close[0]]!r}?" if close else ""
