"""One exception hierarchy: every error that a user can cause, in one line.

A message says what is wrong, where (file, line, field) and what to try. The command line prints that line and
exits with 2; anything that is not an `EvermapError` is a defect of ours and exits with 1.
"""

from __future__ import annotations

from pathlib import Path


class EvermapError(Exception):
    """Base of all errors that the caller can mend.

    Args:
        problem: what is wrong, in one line without a final full stop.
        path: the file it is in, if any.
        line: line number in that file, counted from 1, header and comments included.
        field: column or key in question.
        hint: what to try.
    """

    def __init__(
        self,
        problem: str,
        *,
        path: str | Path | None = None,
        line: int | None = None,
        field: str | None = None,
        hint: str | None = None,
    ) -> None:
        self.problem = problem
        self.path = None if path is None else Path(path)
        self.line = line
        self.field = field
        self.hint = hint
        super().__init__(self.one_line())

    def one_line(self) -> str:
        """`file:line: field 'name': problem (try: hint)`, with the parts that are known."""
        where = ""
        if self.path is not None:
            where = f"{self.path}:{self.line}: " if self.line is not None else f"{self.path}: "
        elif self.line is not None:
            where = f"line {self.line}: "
        if self.field is not None:
            where += f"field '{self.field}': "
        hint = f" (try: {self.hint})" if self.hint else ""
        return " ".join(f"{where}{self.problem}{hint}".split())


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
