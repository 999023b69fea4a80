"""Whole files or none: bytes go to a temporary sibling first and then take the name in one step."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from evermap.errors import InputError
from evermap.interrupts import temporary


def write_atomic(path: str | Path, content: bytes | str) -> Path:
    """Write `content` (text as UTF-8) to `path`, so that no reader ever sees half of it. Returns the path.

    Raises:
        InputError: the folder does not exist or cannot be written to; an older file of that name is untouched.
    """
    path = Path(path)
    data = content.encode() if isinstance(content, str) else content
    partial = _sibling(path)
    try:
        with temporary(lambda: partial.unlink(missing_ok=True)):
            with partial.open("xb") as stream:
                stream.write(data)
            partial.replace(path)
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror or error}", path=path) from error
    return path


@contextmanager
def staged_folder(folder: str | Path) -> Iterator[Path]:
    """Yield A temporary sibling to fill, which becomes `folder` at the end; nothing is left of it after an error.

    Args:
        folder: must not exist, or be empty.

    Raises:
        InputError: the folder holds something, or cannot be written.
    """
    folder = Path(folder).resolve()
    _check_free(folder)
    staging = _sibling(folder)
    try:
        with temporary(lambda: shutil.rmtree(staging, ignore_errors=True)):
            staging.mkdir(parents=True)
            yield staging
            staging.replace(folder)  # the system refuses if it is not empty by now
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror or error}", path=folder) from error


def _sibling(path: Path) -> Path:
    return path.parent / f".{path.name}.{secrets.token_hex(4)}"


def _check_free(folder: Path) -> None:
    if not folder.exists():
        return
    if not folder.is_dir():
        raise InputError("is a file, not a folder", path=folder, hint="name a new folder")
    held = sorted(child.name for child in folder.iterdir())
    if held:
        raise InputError(f"the folder is not empty, it holds {held[0]}", path=folder, hint="name a new folder")
