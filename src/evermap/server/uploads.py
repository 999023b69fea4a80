"""Uploaded sessions: a zip of a native folder, checked before anything reads it, and never unpacked to the disk."""

from __future__ import annotations

import hashlib
import io
import re
import stat
import tempfile
import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from evermap.errors import InputError
from evermap.types import AnyRecording

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_. ()+-]{0,119}")
"""Parts of paths: nothing hidden, no '..', no drive, no control character."""
_READ = (".csv", ".parquet", ".toml")
_ENCRYPTED = 0x1
_VALUE_BYTES = 8
_ROTTEN = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    NotImplementedError,
    RuntimeError,
    ValueError,
    OverflowError,
    OSError,
)


@dataclass(frozen=True, slots=True)
class UploadLimits:
    """How large an upload may be.

    Attributes:
        n_bytes: as it is sent.
        unpacked_bytes: of all files together.
        n_files: in the zip.
    """

    n_bytes: int = 256_000_000
    unpacked_bytes: int = 1_000_000_000
    n_files: int = 100


def checked_digest(data: bytes, limits: UploadLimits) -> str:
    """Return the SHA-256 of the session in an upload, the same however it was packed.

    Raises:
        InputError: it is no zip of a native folder, or may harm who reads it.
    """
    if data.count(b"PK\x01\x02") > 2 * limits.n_files:  # before millions of entries are listed
        raise InputError(f"holds more than {limits.n_files} files")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            wanted = _members(archive.infolist(), limits)
            parts = {name: _content(archive, info, limits) for name, info in wanted.items()}
    except _ROTTEN as error:
        raise InputError(f"is no readable zip: {str(error)[:120]}", hint="zip -r session.zip FOLDER") from None
    digest = hashlib.sha256()
    for name in sorted(parts):
        digest.update(f"{name}\n".encode() + parts[name])
    return digest.hexdigest()


def _members(infos: list[zipfile.ZipInfo], limits: UploadLimits) -> dict[str, zipfile.ZipInfo]:
    """The files that a recording is read from, by name."""
    files = [info for info in infos if not info.is_dir()]
    if len(infos) > limits.n_files:
        raise InputError(f"holds {len(infos)} files, more than {limits.n_files}")
    # what a file claims to be is all that is ever read of it
    size = sum(info.file_size for info in files)
    if size > limits.unpacked_bytes:
        raise InputError(f"unpacks to {size} bytes, more than {limits.unpacked_bytes}")
    found: dict[str, zipfile.ZipInfo] = {}
    for info in files:
        parts = PurePosixPath(info.filename.replace("\\", "/")).parts
        if info.filename.startswith(("/", "\\")) or not all(map(_NAME.fullmatch, parts)) or len(parts) > 2:
            raise InputError("holds a path that no recording has", field=info.filename[:80])
        kind = stat.S_IFMT(info.external_attr >> 16)
        if info.flag_bits & _ENCRYPTED or kind not in (0, stat.S_IFREG):
            raise InputError("holds a link, or a file that is encrypted", field=info.filename[:80])
        if parts[-1].endswith(".gz"):
            raise InputError("is compressed twice", field=info.filename[:80], hint="plain CSV or Parquet in the zip")
        if parts[-1].endswith(_READ):
            if parts[-1] in found:
                raise InputError("holds two files of that name", field=info.filename[:80])
            found[parts[-1]] = info
    if not {"detections.csv", "detections.parquet"} & found.keys():
        raise InputError("holds no detections", hint="a zip of a folder as docs/formats.md describes it")
    return found


def _content(archive: zipfile.ZipFile, info: zipfile.ZipInfo, limits: UploadLimits) -> bytes:
    content = archive.read(info)
    if content[:2] == b"\x1f\x8b":
        raise InputError("is compressed twice", field=info.filename[:80], hint="plain CSV or Parquet in the zip")
    if info.filename.endswith(".parquet"):
        _check_parquet(content, info.filename, limits)
    return content


def _check_parquet(content: bytes, name: str, limits: UploadLimits) -> None:
    """Refuse a table that is small only as it is packed."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        about = parquet.ParquetFile(io.BytesIO(content)).metadata
        packed = sum(about.row_group(k).total_byte_size for k in range(about.num_row_groups))
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"is no Parquet file: {str(error)[:120]}", field=name[:80]) from None
    if max(packed, about.num_rows * about.num_columns * _VALUE_BYTES) > limits.unpacked_bytes:
        raise InputError(f"unpacks to more than {limits.unpacked_bytes} bytes", field=name[:80])


def recording_of(data: bytes, digest: str) -> AnyRecording:
    """Read the recording of a checked upload.

    Raises:
        InputError, DataError: as `evermap.io.read_native`, without the place of the file on this machine.
    """
    from evermap.io import read_native

    with tempfile.TemporaryDirectory(prefix="evermap-upload-") as folder:
        path = Path(folder) / f"session-{digest[:12]}.zip"
        path.write_bytes(data)
        try:
            recording = read_native(path)
        except InputError as error:
            error.path = None if error.path is None else Path(error.path.name)
            raise
    # equal sessions are equal recordings, wherever they were read
    return replace(recording, source=f"upload:{digest}")
