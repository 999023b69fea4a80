"""Whole files or none: bytes go to a temporary sibling first and then take the name in one step."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
            Path(temporary).chmod(0o666 & ~_umask())
            Path(temporary).replace(path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror or error}", path=path) from error
    return path


@contextmanager
def staged_folder(folder: str | Path, *, replaceable: Callable[[Path], bool] | None = None) -> Iterator[Path]:
    """A temporary sibling to fill, which becomes `folder` at the end; nothing is left of it after an error.

    Args:
        folder: must not exist or be empty, unless `replaceable` accepts everything in it.
        replaceable: says of a file in an existing folder whether it may be replaced or removed.

    Raises:
        InputError: the folder holds something that is not replaceable, or cannot be written.
    """
    folder = Path(folder)
    _check_free(folder, replaceable)
    try:
        folder.absolute().parent.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.absolute().parent))
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror or error}", path=folder) from error
    try:
        yield staging
        staging.chmod(0o777 & ~_umask())
        if folder.exists() and any(folder.iterdir()):
            new = {child.name for child in staging.iterdir()}
            for child in staging.iterdir():
                child.replace(folder / child.name)
            for child in folder.iterdir():
                if child.name not in new:
                    child.unlink()
        else:
            staging.replace(folder)
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror or error}", path=folder) from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _check_free(folder: Path, replaceable: Callable[[Path], bool] | None) -> None:
    if not folder.exists():
        return
    if not folder.is_dir():
        raise InputError("is a file, not a folder", path=folder, hint="name a new folder")
    kept = [child.name for child in folder.iterdir() if replaceable is None or not replaceable(child)]
    if kept:
        raise InputError(f"the folder is not empty, it holds {min(kept)}", path=folder, hint="name a new folder")


def _umask() -> int:
    current = os.umask(0o022)
    os.umask(current)
    return current
