"""The error of this package: one line that says what is wrong, where, and what to try."""

from __future__ import annotations

from pathlib import Path


class ScoreError(Exception):
    """An input that cannot be scored.

    Args:
        problem: what is wrong, in one line without a final full stop.
        path: the file it is in.
        line: of that file, counted from 1.
        hint: what to try.
    """

    def __init__(
        self, problem: str, *, path: str | Path | None = None, line: int | None = None, hint: str | None = None
    ) -> None:
        where = "" if path is None else f"{path}: " if line is None else f"{path}:{line}: "
        super().__init__(" ".join(f"{where}{problem}{f' (try: {hint})' if hint else ''}".split()))
