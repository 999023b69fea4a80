"""One exception hierarchy: every error that a user can cause, in one line.

A message says what is wrong, where (file, line, field) and what to try. The command line prints that line and
exits with 2; anything that is not an `EvermapError` is a defect of ours and exits with 1.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

_UNSHOWN = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters, line ends, direction marks, and surrogates, which cannot be encoded."""
_MOST = 400
"""Maximum characters of each part of a message: enough for a sentence and a path."""


def printable(text: str, most: int | None = None) -> str:
    r"""Make foreign text fit to be shown: names, values and paths from files and command lines.

    What would move the cursor, change colours, reverse the line or cannot be encoded is escaped as `\x1b`; all else
    stays as it is.

    Args:
        text: from outside.
        most: characters; of a longer text the middle is left out.
    """
    if most is not None and len(text) > most:
        text = f"{text[: most * 2 // 3]} ... {text[len(text) - most // 4 :]}"
    return _UNSHOWN.sub(lambda found: found.group().encode("unicode_escape", "surrogatepass").decode(), text)


def similar(name: str, known: Iterable[str], *, cutoff: float = 0.5) -> str | None:
    """Return the known name that resembles another most, None where none does by the share `cutoff` of difflib."""
    import difflib

    close = difflib.get_close_matches(name.strip(), list(known), n=1, cutoff=cutoff)
    return close[0] if close else None


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return a hint where a name is not known: the one that was probably meant, or all of them."""
    names = list(known)
    return similar(name, names) or ("one of " if len(names) > 1 else "") + ", ".join(names)


class EvermapError(Exception):
    """Base of all errors that the caller can mend.

    Args:
        problem: what is wrong, in one line without a final full stop.
        path: the file it is in, if any.
        line: line number in that file, counted from 1, header and comments included.
        field: argument, column or key in question.
        hint: what to try. Arguments stand in `backquotes` here and in `problem`.
        row: of the array in question, counted from 0, for callers who know where the array came from.
    """

    def __init__(
        self,
        problem: str,
        *,
        path: str | Path | None = None,
        line: int | None = None,
        field: str | None = None,
        hint: str | None = None,
        row: int | None = None,
    ) -> None:
        self.problem = problem
        self.path = None if path is None else Path(path)
        self.line = line
        self.field = field
        self.hint = hint
        self.row = row
        super().__init__(self.one_line())

    def one_line(self) -> str:
        """Return `file:line: field 'name': problem (try: hint)`, with the parts that are known, each `printable` and
        short.
        """
        where = ""
        if self.path is not None:
            path = _short(re.sub("^([a-z]+:)/(?!/)", r"\1//", str(self.path)))  # an address keeps its slashes
            where = f"{path}:{self.line}: " if self.line is not None else f"{path}: "
        elif self.line is not None:
            where = f"line {self.line}: "
        if self.field is not None:
            where += f"field '{_short(self.field)}': "
        hint = f" (try: {_short(self.hint)})" if self.hint else ""
        return " ".join(f"{where}{_short(self.problem)}{hint}".split())


def _short(text: str) -> str:
    return printable(re.sub(r"\s+", " ", text), _MOST)


class InputError(EvermapError):
    """An input file or folder is missing, malformed or inconsistent."""


class ConfigError(EvermapError):
    """A configuration value or a command line option is out of range or contradicts another."""


class DataError(EvermapError):
    """Well-formed input from which nothing can be estimated, for example a recording without any sighting."""


class NumericalError(EvermapError):
    """The estimator failed on this input: no finite optimum, singular system, impossible observation."""


class MissingExtraError(EvermapError):
    """An optional dependency is needed for this output; the message names the extra that brings it."""


class EvermapWarning(UserWarning):
    """A remark in one line about how evermap works here; the command line prints it as such."""
