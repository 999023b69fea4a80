"""Bytes of a text file to lines, with any line end and with the line number of what is not text."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from evermap.errors import InputError
from evermap.types import Clock


def decode_text(data: bytes, path: Path) -> str:
    """Return UTF-8 text with newlines as line ends, whatever they were; a byte order mark is dropped.

    Raises:
        InputError: the bytes are not text, with the line where that shows first.
    """
    nul = data.find(b"\0")
    try:
        text = data.decode("utf-8-sig")
        first_bad = nul
    except UnicodeDecodeError as error:
        first_bad = error.start if nul < 0 else min(nul, error.start)
    if first_bad >= 0:
        line = data.count(b"\n", 0, first_bad) + 1
        raise InputError("is not plain text (UTF-8)", path=path, line=line, hint="was the file damaged, or packed?")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def parse_float(cell: str) -> float:
    """Return a number as people write it; unlike `float`, no digit grouping by underscores.

    Raises:
        ValueError: the cell holds none.
    """
    if "_" in cell:
        raise ValueError(f"could not convert string to float: {cell!r}")
    return float(cell)


def date_s(cell: str) -> float:
    """Return seconds since 1970-01-01 of an ISO 8601 date: UTC if it has a zone, else as the clocks on the wall show
    them.

    Raises:
        ValueError, OverflowError: it is none.
    """
    date = datetime.fromisoformat(cell.strip())
    return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()


def clock_of_date(cell: str) -> Clock | None:
    """Return `unix` for a date with a zone, `local_wall` for one without, None for other text."""
    try:
        return Clock.UNIX if datetime.fromisoformat(cell.strip()).tzinfo else Clock.LOCAL_WALL
    except ValueError:
        return None


def parse_json(data: bytes, path: Path, **how: Any) -> Any:
    """Return a JSON document; arguments as of `json.loads`.

    Raises:
        InputError: it is none.
    """
    try:
        return json.loads(decode_text(data, path), **how)
    except json.JSONDecodeError as error:
        raise InputError(f"not valid JSON: {error.msg}", path=path, line=error.lineno) from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"not valid JSON: {reason(error)}", path=path) from None


def counted(count: int, noun: str) -> str:
    """Return '1 row', '2 rows'."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def reason(error: BaseException) -> str:
    """Return what a library has to say about a file, in a short printable line."""
    first = (str(error).splitlines() or [""])[0] or type(error).__name__
    short = first if len(first) <= 120 else first[:117] + "..."
    return "".join(c if c.isprintable() else "?" for c in short)


def quote(cell: str) -> str:
    """Return a cell of the user's file for a message: short and printable."""
    short = cell if len(cell) <= 24 else cell[:21] + "..."
    return f"'{''.join(c if c.isprintable() else '?' for c in short)}'"
