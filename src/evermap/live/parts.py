"""Parts of a drive in a file, one after the other, so that damage to one costs no other.

Each part begins with a mark, its number, its length and two checksums: of this header, and of the bytes behind it. What
cannot be read is skipped up to the next valid header, as readers of MCAP do: a damaged length loses one part, not all
behind it. Parts that are missing show by their numbers, and at the end by a header without a part that closes the file.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

from evermap.maps.store.content import DamagedError
from evermap.maps.store.measured import pack_recording, unpack_recording
from evermap.types import UNKNOWN, AnyRecording

MARK = b"\x89evPART\n"
"""First bytes of a part; the first one is in no text, and the last one changes where a file is taken for text."""
_HEADER = struct.Struct("<8sIQI")
_CHECKSUM = struct.Struct("<I")
_HEADER_SIZE = _HEADER.size + _CHECKSUM.size
_UNMARKED = 8
"""Bytes of the length in front of a part as evermap wrote it before parts had a mark."""


class Header(NamedTuple):
    """Start of a part: its number from 1, the length of its bytes, and their checksum.

    At the end of a file: the number of its parts, and no bytes.
    """

    number: int
    size: int
    checksum: int


@dataclass(frozen=True, slots=True)
class DriveParts:
    """What a file of parts holds.

    Attributes:
        recordings: of the parts that are intact, in the order of their numbers.
        lost: numbers of parts that are damaged or missing; `UNKNOWN` for one whose number is damaged, too.
    """

    recordings: tuple[AnyRecording, ...]
    lost: tuple[int, ...] = ()

    @property
    def damage(self) -> str:
        """What is lost, in words; empty where nothing is."""
        if not self.lost:
            return ""
        known = [str(number) for number in self.lost if number != UNKNOWN]
        which = f" ({', '.join(known)})" if known else ""
        return f"{len(self.lost)} of {len(self.recordings) + len(self.lost)} parts{which} cannot be read"


def pack_part(number: int, recording: AnyRecording) -> bytes:
    """Return the bytes of a part.

    Args:
        number: which part of the session it is, from 1.
        recording: its readings.
    """
    body = pack_recording(recording)
    return _pack_header(number, body) + body


def close_parts(data: bytes) -> bytes:
    """Return what closes a file, behind parts that a crash may have ended: one that it cut off never was there."""
    headers = list(_find_headers(data))
    whole = [header.number for at, header in headers if at + _HEADER_SIZE + header.size <= len(data)]
    is_closed = any(not header.size for _, header in headers)
    return b"" if is_closed or not headers else _pack_header(max(whole, default=0), b"")


def _pack_header(number: int, body: bytes) -> bytes:
    header = _HEADER.pack(MARK, number, len(body), zlib.crc32(body))
    return header + _CHECKSUM.pack(zlib.crc32(header))


def unpack_parts(data: bytes) -> DriveParts:
    """Return the parts of a file that was closed.

    Args:
        data: what `pack_part` and `close_parts` returned, one after the other, possibly damaged.
    """
    headers = list(_find_headers(data))
    if not headers:
        return _unpack_unmarked(data)
    found, closed = dict[int, AnyRecording](), None
    for at, header in headers:
        body = data[at + _HEADER_SIZE : at + _HEADER_SIZE + header.size]
        if not header.size:
            closed = header.number
        elif len(body) == header.size and zlib.crc32(body) == header.checksum:
            with suppress(DamagedError):  # one of a newer version
                found.setdefault(header.number, unpack_recording(body))
    count = max(header.number for _, header in headers) if closed is None else closed
    lost = sorted(set(range(1, count + 1)) - found.keys())
    if closed is None:  # and how many were behind them
        lost.append(UNKNOWN)
    return DriveParts(tuple(found[number] for number in sorted(found)), tuple(lost))


def _find_headers(data: bytes) -> Iterator[tuple[int, Header]]:
    """Yield the valid headers, and where they begin."""
    at = data.find(MARK)
    while at >= 0:
        raw = data[at : at + _HEADER.size]
        checksum = data[at + _HEADER.size : at + _HEADER_SIZE]
        if len(checksum) == _CHECKSUM.size and _CHECKSUM.unpack(checksum)[0] == zlib.crc32(raw):
            yield at, Header(*_HEADER.unpack(raw)[1:])
        at = data.find(MARK, at + 1)


def _unpack_unmarked(data: bytes) -> DriveParts:
    """Return the parts of a file without marks, up to where it is damaged."""
    found, at = list[AnyRecording](), 0
    while at + _UNMARKED <= len(data):
        size = int.from_bytes(data[at : at + _UNMARKED], "little")
        body = data[at + _UNMARKED : at + _UNMARKED + size]
        if len(body) < size:  # of a damaged length, or cut off by a crash
            break
        try:
            found.append(unpack_recording(body))
        except DamagedError:
            break
        at += _UNMARKED + size
    return DriveParts(tuple(found), (UNKNOWN,) if at < len(data) else ())
