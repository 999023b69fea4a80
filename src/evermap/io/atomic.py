"""Whole files or none: bytes go to a temporary sibling first and then take the name in one step."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from evermap.errors import InputError


def write_atomic(path: str | Path, content: bytes | str) -> Path:
    """Writes `content` (text as UTF-8) to `path`, so that no reader ever sees half of it. Returns the path.

    Raises:
        InputError: the folder does not exist or cannot be written to; an older file of that name is untouched.
    """
    path = Path(path)
    data = content.encode() if isinstance(content, str) else content
    try:
        descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        try:
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(data)
            # mkstemp makes private files; outputs follow the user's umask as any other file
            os.chmod(temporary, 0o666 & ~_umask())
            os.replace(temporary, path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror or error}", path=path) from error
    return path


def _umask() -> int:
    current = os.umask(0o022)
    os.umask(current)
    return current
