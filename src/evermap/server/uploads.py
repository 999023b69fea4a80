"""Uploaded sessions: a native folder in a zip, or a bag, checked before anything reads it.

Tables are never unpacked to the disk. Bags are packed inside, hold programs' own formats, and are read by others' code:
that happens in a process of its own, which has so much memory and time, and leaves a native folder or an error.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import shutil
import stat
import subprocess
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, Any

from evermap.errors import EvermapError, InputError
from evermap.io.native import TABLES
from evermap.io.rig_toml import CAMERA_FILE, SENSOR_FILE
from evermap.types import AnyRecording

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_. ()+-]{0,119}")
"""Allowed parts of paths: nothing hidden, no '..', no drive, no control character."""
_READ = (".csv", ".parquet", ".toml")
_NATIVE = {*(f"{name}{ending}" for name in TABLES for ending in (".csv", ".parquet")), SENSOR_FILE, CAMERA_FILE}
"""Files that a native folder is read from; others are neither unpacked nor part of a session's digest."""
_BAGS = {".mcap": b"\x89MCAP0\r\n", ".bag": b"#ROSBAG V", ".db3": b"SQLite format 3\0"}
"""File endings of bags, and their first bytes."""
_BAG_READ = (*_BAGS, "metadata.yaml", ".toml")
_BAG_CPU_S, _BAG_BYTES = 600, 4_000_000_000
"""Limits of the process that reads a bag; 17 MB of messages take it 3 s and 0.14 GB."""
_CONVERT = f"""
import resource
resource.setrlimit(resource.RLIMIT_CPU, ({_BAG_CPU_S}, {_BAG_CPU_S}))
resource.setrlimit(resource.RLIMIT_DATA, ({_BAG_BYTES}, {_BAG_BYTES}))
resource.setrlimit(resource.RLIMIT_FSIZE, ({_BAG_BYTES}, {_BAG_BYTES}))
from evermap.__main__ import run
run()
"""
_ENCRYPTED = 0x1
_VALUE_BYTES = 8
_PIECE = 1 << 20
"""Bytes that are unpacked at a time."""
_ROTTEN = (
    zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError, OverflowError, OSError,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class UploadLimits:
    """Limits of an upload.

    Attributes:
        n_bytes: as it is sent.
        unpacked_bytes: of all files together.
        n_files: in the zip.
        body_bytes: of a request that is no upload.
    """

    n_bytes: int = 256_000_000
    unpacked_bytes: int = 1_000_000_000
    n_files: int = 100
    body_bytes: int = 1_000_000


def check_digest(data: bytes, limits: UploadLimits) -> str:
    """Return the SHA-256 of the session in an upload, independent of its packing.

    Raises:
        InputError: it is neither a zip of a native folder or of a bag, nor a bag, or may harm who reads it.
    """
    digest = hashlib.sha256()
    with _open_files(data, limits) as files:
        for name, (told, file) in sorted(files.items()):
            with file() as content:
                _check(content, told, limits)
            digest.update(f"{name}\n".encode())
            with file() as content:
                while piece := content.read(_PIECE):
                    digest.update(piece)
    return digest.hexdigest()


_Files = dict[str, tuple[str, Callable[[], IO[bytes]]]]
"""Files that a recording is read from, by name: what the upload calls each, and what opens it."""


@contextmanager
def _open_files(data: bytes, limits: UploadLimits) -> Iterator[_Files]:
    """Yield the files that a recording is read from; a bag that is one file always has the same name."""
    for ending, start in _BAGS.items():
        if data.startswith(start):
            yield {f"session{ending}": (f"session{ending}", partial(io.BytesIO, data))}
            return
    if data.count(b"PK\x01\x02") > 2 * limits.n_files:  # before millions of entries are listed
        raise InputError(f"contains more than {limits.n_files} files")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            wanted = _members(archive.infolist(), limits)
            yield {name: (info.filename, partial(archive.open, info)) for name, info in wanted.items()}
    except InputError:
        raise
    except _ROTTEN as error:
        hint = "zip -r session.zip FOLDER, or a bag: .mcap, .bag, .db3"
        raise InputError(f"is not a readable zip: {str(error)[:120]}", hint=hint) from None


def _members(infos: list[zipfile.ZipInfo], limits: UploadLimits) -> dict[str, zipfile.ZipInfo]:
    """The files that a recording is read from, by name."""
    files = [info for info in infos if not info.is_dir()]
    if len(infos) > limits.n_files:
        raise InputError(f"contains {len(infos)} files, more than {limits.n_files}")
    # what a file claims to be is all that is ever read of it
    size = sum(info.file_size for info in files)
    if size > limits.unpacked_bytes:
        raise InputError(f"unpacks to {size} bytes, more than {limits.unpacked_bytes}")
    found: dict[str, zipfile.ZipInfo] = {}
    for info in files:
        parts = PurePosixPath(info.filename.replace("\\", "/")).parts
        if info.filename.startswith(("/", "\\")) or not all(map(_NAME.fullmatch, parts)) or len(parts) > 2:
            raise InputError("contains a path that is not part of a recording", field=info.filename[:80])
        kind = stat.S_IFMT(info.external_attr >> 16)
        if info.flag_bits & _ENCRYPTED or kind not in (0, stat.S_IFREG):
            raise InputError("contains a link, or a file that is encrypted", field=info.filename[:80])
        if parts[-1].endswith(".gz"):
            raise InputError("is compressed twice", field=info.filename[:80], hint="plain CSV or Parquet in the zip")
        if parts[-1].endswith((*_READ, *_BAG_READ)):
            if parts[-1] in found:
                raise InputError("contains two files of that name", field=info.filename[:80])
            found[parts[-1]] = info
    if {"detections.csv", "detections.parquet"} & found.keys():
        return {name: info for name, info in found.items() if name in _NATIVE}
    bags = [name for name in found if name.endswith((*_BAGS,))]
    if not bags:
        raise InputError("contains no detections and no bag", hint="a zip of a folder as docs/formats.md describes it")
    found = {name: info for name, info in found.items() if name.endswith(_BAG_READ)}
    if sum(name.endswith(".toml") for name in found) > 1:
        raise InputError("contains two settings files", hint="one that states the topics of the bag")
    if "metadata.yaml" in found:
        return found
    if len(bags) > 1:
        raise InputError(f"contains {len(bags)} bags", hint="one, or the folder with its metadata.yaml")
    return {f"session{Path(name).suffix}": info for name, info in found.items()}


def _check(content: IO[bytes], name: str, limits: UploadLimits) -> None:
    """Refuse a file that is compressed, no bag in spite of its name, or a table that expands beyond the limits."""
    start = content.read(max(map(len, _BAGS.values())))
    if start[:2] == b"\x1f\x8b":
        raise InputError("is compressed twice", field=name[:80], hint="plain CSV or Parquet in the zip")
    if not start.startswith(_BAGS.get(Path(name).suffix, b"")):
        raise InputError("is not a bag", field=name[:80], hint="record it again, or leave it out")
    if name.endswith(".parquet"):
        _check_parquet(content, name, limits)


def _check_parquet(content: IO[bytes], name: str, limits: UploadLimits) -> None:
    """Refuse a table that expands beyond the limits."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        about = parquet.ParquetFile(content).metadata
        packed = sum(about.row_group(k).total_byte_size for k in range(about.num_row_groups))
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"is not a Parquet file: {str(error)[:120]}", field=name[:80]) from None
    if max(packed, about.num_rows * about.num_columns * _VALUE_BYTES) > limits.unpacked_bytes:
        raise InputError(f"unpacks to more than {limits.unpacked_bytes} bytes", field=name[:80])


def recording_of(data: bytes, digest: str) -> AnyRecording:
    """Read the recording of a checked upload.

    Raises:
        InputError, DataError: as `evermap.io.read_native` and `read_bag`, without the place on this machine.
    """
    from evermap.io import read_native

    remarks: tuple[str, ...] = ()
    with tempfile.TemporaryDirectory(prefix="evermap-upload-") as folder:
        path = Path(folder) / f"session-{digest[:12]}"
        try:
            with _open_files(data, UploadLimits()) as files:
                is_bag = any(name.endswith((*_BAGS,)) for name in files)
                bag = _unpack_bag(files, path) if is_bag else {}
            if is_bag:
                remarks = _convert(bag, path)
            else:
                path = path.with_suffix(".zip")
                path.write_bytes(data)
            recording = read_native(path)
        except EvermapError as error:
            error.path = None if error.path is None else Path(error.path.name)
            raise
    # equal sessions are equal recordings, wherever they were read
    return replace(recording, source=f"upload:{digest}", warnings=(*remarks, *recording.warnings))


def _unpack_bag(parts: _Files, out: Path) -> dict[str, Path]:
    """Write the files of a bag into a folder beside `out`; returns them by name."""
    bag = out.with_name("bag") / out.name
    bag.mkdir(parents=True)
    whole = "metadata.yaml" in parts
    files = {name: bag / (name if whole else f"{out.name}{Path(name).suffix}") for name in parts}
    for name, path in files.items():
        with parts[name][1]() as content, path.open("wb") as file:
            shutil.copyfileobj(content, file, _PIECE)
    return files


def _convert(files: dict[str, Path], out: Path) -> tuple[str, ...]:
    """Write a bag as a native folder, in a process that cannot take more than its share; returns remarks on it.

    Raises:
        InputError: it cannot be read, or not with so much memory and time.
    """
    bag = next(iter(files.values())).parent
    settings = [str(path) for path in files.values() if path.suffix == ".toml"]
    bag = bag if "metadata.yaml" in files else next(path for path in files.values() if path.suffix in _BAGS)
    command = [sys.executable, "-c", _CONVERT, "convert", str(bag), str(out), "--format", "parquet", "--json"]
    command += [f"--topics={name}" for name in settings]
    how: dict[str, Any] = {"capture_output": True, "text": True, "timeout": 2 * _BAG_CPU_S}
    try:
        done = subprocess.run(command, **how, check=False)  # noqa: S603  (ourselves, with files of names of ours)
    except subprocess.TimeoutExpired:
        raise InputError(f"cannot be read as a bag within {2 * _BAG_CPU_S} s") from None
    if done.returncode == 2:
        told = done.stderr.strip().rpartition("\n")[2].replace(f"{bag.parent}/", "")
        raise InputError(told.removeprefix("evermap: error: "))
    if done.returncode:
        raise InputError(f"cannot be read as a bag within {_BAG_CPU_S} s of CPU time and {_BAG_BYTES / 1e9:.0f} GB")
    return tuple(json.loads(done.stdout)["warnings"])
