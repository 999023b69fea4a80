"""Reading and writing of files.

A folder and a zip of it look the same to a reader: a `FileSet` of named byte strings. What is written is there whole or
not at all: bytes go to a temporary sibling first and then take the name in one step.
"""

from __future__ import annotations

import gzip
import re
import secrets
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from evermap.errors import InputError
from evermap.interrupts import temporary
from evermap.io.text import reason
from evermap.types import Recording, SpatialRecording
from evermap.types.mark import MARK

# Errors of `zipfile` on damaged or encrypted archives, found by corrupting them at random.
_ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError, ValueError, OverflowError)


@dataclass(frozen=True, slots=True)
class FileSet:
    """The files of one folder, on disk, inside a zip, or in memory.

    Attributes:
        root: the folder or zip that the user named; of files in memory what they are, for messages.
        folder: the folder inside `root`, '' for the top.
        members: file name -> path relative to `root`.
        zipped: whether `root` is a zip.
        contents: file name -> content of files in memory; None where they are on disk.
    """

    root: Path
    folder: str
    members: dict[str, str]
    zipped: bool
    contents: Mapping[str, bytes] | None = None

    def __contains__(self, name: str) -> bool:
        return name in self.members

    @property
    def title(self) -> str:
        """Name of the innermost folder, or of the zip without its ending."""
        if self.folder:
            return PurePosixPath(self.folder).name
        if self.contents is not None:
            return self.root.stem
        return self.root.stem if self.zipped else self.root.resolve().name

    def path_of(self, name: str) -> Path:
        """Return where `name` is or would be, for messages: a zip is shown as if it were a folder."""
        return self.root / self.members.get(name, str(PurePosixPath(self.folder) / name))

    def read(self, name: str) -> bytes:
        """Return the content of a file, unpacked where it is gzipped.

        Raises:
            InputError: it is missing, unreadable, or damaged inside the zip.
        """
        path = self.path_of(name)
        if name not in self.members:
            raise InputError("file is missing", path=path)
        if self.contents is not None:
            return self.contents[name]
        if not self.zipped:
            return content_of(path)
        try:
            with zipfile.ZipFile(self.root) as archive:
                return unpacked(archive.read(self.members[name]), path)
        except OSError as error:
            raise InputError(f"cannot be read: {error.strerror or error}", path=path) from error
        except (*_ZIP_ERRORS, KeyError) as error:
            problem = f"damaged inside the zip: {reason(error)}"
            raise InputError(problem, path=path, hint="download or create the zip again") from error


def file_sets(path: str | Path) -> list[FileSet]:
    """Return every folder with files in it: of a zip all, of a folder itself and the folders directly below.

    A plain file that is not a zip gives an empty list.

    Raises:
        InputError: nothing is there, or the zip is damaged.
    """
    path = Path(path)
    try:
        if not path.exists():
            raise InputError("no such file or folder", path=path, hint="check the path")
        if path.is_dir():
            return _folder_sets(path)
        if path.suffix.lower() == ".zip" or zipfile.is_zipfile(path):
            return _zip_sets(path)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", path=path) from error
    except ValueError as error:  # a name with a NUL byte
        raise InputError(f"no usable file name: {reason(error)}") from error
    return []


def find_file_set(path: str | Path, wanted: Callable[[FileSet], bool]) -> FileSet | None:
    """Return the outermost file set that `wanted` accepts; None where there is none.

    Raises:
        InputError: as `file_sets`, or two such folders lie side by side.
    """
    found = [files for files in file_sets(path) if wanted(files)]
    if not found:
        return None
    depth = min(_depth(files) for files in found)
    outermost = [files for files in found if _depth(files) == depth]
    if len(outermost) > 1:
        names = ", ".join(sorted(files.folder for files in outermost))
        raise InputError(f"contains {len(outermost)} recordings: {names}", path=path, hint="name one of them")
    return outermost[0]


def _depth(files: FileSet) -> int:
    return len(PurePosixPath(files.folder).parts)


def _folder_sets(path: Path) -> list[FileSet]:
    sets = []
    for folder in [path, *sorted(child for child in path.iterdir() if child.is_dir())]:
        inside = "" if folder == path else folder.name
        try:
            names = sorted(child.name for child in folder.iterdir() if child.is_file())
        except OSError:
            if folder == path:
                raise
            continue  # a locked subfolder is none of the user's recordings
        members = {name: str(PurePosixPath(inside) / name) for name in names if not name.startswith(".")}
        if members:
            sets.append(FileSet(path, inside, members, zipped=False))
    return sets


def _zip_sets(path: Path) -> list[FileSet]:
    try:
        with zipfile.ZipFile(path) as archive:
            names = [info.filename for info in archive.infolist() if not info.is_dir()]
    except _ZIP_ERRORS as error:
        problem = f"not a readable zip: {reason(error)}"
        raise InputError(problem, path=path, hint="download or create the zip again") from error
    folders: dict[str, dict[str, str]] = {}
    for name in names:
        inner = PurePosixPath(name)
        # macOS packs its resource forks beside the data under the same names
        if "__MACOSX" in inner.parts or inner.name.startswith("."):
            continue
        folder = "" if str(inner.parent) == "." else str(inner.parent)
        folders.setdefault(folder, {})[inner.name] = name
    return [FileSet(path, folder, members, zipped=True) for folder, members in folders.items()]


def content_of(path: Path) -> bytes:
    """Return the content of a file, unpacked where it is gzipped.

    Raises:
        InputError: it is missing, unreadable or damaged.
    """
    try:
        return unpacked(path.read_bytes(), path)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", path=path) from error


HEAD_BYTES = 4096
"""Bytes from which the kind of a file is recognised."""
LFS = b"version https://git-lfs.github.com/spec/"
"""Begin of a pointer that Git LFS leaves where a file was not fetched."""


def head_of(path: Path) -> bytes:
    """Return the first bytes of a file, unpacked where it is gzipped; none where it cannot be read."""
    try:
        with path.open("rb") as stream:
            head = stream.read(HEAD_BYTES)
    except OSError:
        return b""
    if head[:2] != b"\x1f\x8b":
        return head
    try:
        return zlib.decompressobj(31).decompress(head, HEAD_BYTES)
    except zlib.error:
        return b""


def unpacked(data: bytes, path: Path) -> bytes:
    """Return the content of a gzipped file, and that of any other as it is.

    Raises:
        InputError: it is gzipped and damaged, or a pointer of Git LFS to a file that was not fetched.
    """
    refuse_pointer(data, path)
    if data[:2] != b"\x1f\x8b":
        return data
    try:
        return gzip.decompress(data)
    except (OSError, EOFError, zlib.error) as error:
        problem = f"damaged gzip file: {reason(error)}"
        raise InputError(problem, path=path, hint="download or create it again") from error


def refuse_pointer(data: bytes, path: Path) -> None:
    """Raise InputError where bytes are those of a pointer of Git LFS, not of the file that was meant."""
    if data.startswith(LFS):
        size = re.search(rb"^size (\d{1,18})$", data[:400], re.MULTILINE)
        whole = f" of {int(size[1]):,} bytes" if size else ""
        problem = f"is a pointer of Git LFS to a file{whole} that was not fetched"
        raise InputError(problem, path=path, hint="`git lfs pull` in its repository")


@dataclass(frozen=True, slots=True)
class Reader:
    """One format of recordings.

    Attributes:
        name: short name, e.g. 'mrclam'.
        looks_for: the files by which the format is known, for messages.
        holds: whether files look like this format, by their names.
        read: returns the recording of a path and a robot; None for the format's default robot.
        robots: robots in files that can be asked for; none where the format does not number them.
        endings: of single files that are a recording of this format,
        accepts: which of those files are, by what they hold and what is beside them; None: all.
        head: whether a single file begins as one of this format, by its first bytes.
    """

    name: str
    looks_for: str
    holds: Callable[[FileSet], bool]
    read: Callable[[str | Path, int | None], Recording | SpatialRecording]
    robots: Callable[[FileSet], tuple[int, ...]] = lambda _: ()
    endings: tuple[str, ...] = ()
    accepts: Callable[[Path], bool] | None = None
    head: Callable[[bytes], bool] | None = None

    def matches(self, path: str | Path) -> bool:
        """Return whether the files of this format are there, at the top or one folder down."""
        path = Path(path)
        if self.endings and path.is_file() and path.name.endswith(self.endings):
            return self.accepts is None or self.accepts(path)
        if self.head is not None and path.is_file() and self.head(head_of(path)):
            return True
        return find_file_set(path, self.holds) is not None


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


def is_marked(path: Path) -> bool:
    """Return whether evermap wrote a file, by its `MARK`."""
    try:
        with path.open("rb") as file:
            return MARK.encode() in file.read(4096)
    except OSError:
        return False


def write_new(path: str | Path, content: bytes | str) -> Path:
    """Write a file that is not there yet, as `write_atomic`. Returns the path.

    Raises:
        InputError: it exists, or cannot be written.
    """
    if Path(path).exists():
        raise InputError("exists already", path=path, hint="another name")
    return write_atomic(path, content)


@contextmanager
def stage_folder(folder: str | Path) -> Iterator[Path]:
    """Yield a temporary sibling to fill, which becomes `folder` at the end; nothing is left of it after an error.

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
