"""Chunks of many revisions that are compressed together, as `MapStore.compact` leaves them.

Columns of successive revisions are alike where a compressor of one chunk at a time cannot see it. A *pack* is a row of
`chunk`, as all others: the values of chunks of one kind, one after the other, by LZMA. The row of each of its members
says where they are in it instead of having them.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

from evermap.maps.store.content import PLAIN, DamagedError, deflate, inflate

PACK_BYTES = 1 << 20
"""Values in a pack, as a rule: a member costs reading all of it, some 10 ms; four times as long ones gain 2 %."""
_MAGIC = b"\xfd7zXZ\x00"
_PLACE = struct.Struct(">c32sII")
_MEMBER = b"\x01"
MEMBER_BYTES = _PLACE.size
"""Bytes of the row of a member: no others of this length begin as it does."""


class Place(NamedTuple):
    """Where a member is: name of its pack, first byte and number of bytes."""

    pack: bytes
    at: int
    size: int


def place_of(data: bytes) -> Place | None:
    """Return where the bytes of a row are; None if it has them itself."""
    if len(data) != MEMBER_BYTES or data[:1] != _MEMBER:
        return None
    return Place(*_PLACE.unpack(data)[1:])


def make_pack(stored: Mapping[bytes, bytes]) -> dict[bytes, bytes]:
    """Return the rows of chunks, by name, with those of a pack of them; rows of their own if that is no shorter."""
    import lzma  # a Python that was built without it opens all maps that are not packed

    values = [inflate(data) for data in stored.values()]
    single = {name: deflate(data) for name, data in stored.items()}
    whole = b"".join(values)
    pack = lzma.compress(whole, check=lzma.CHECK_NONE)
    if len(pack) + MEMBER_BYTES * len(stored) >= sum(map(len, single.values())):
        return single
    pack_name, at, rows = hashlib.sha256(whole).digest(), 0, dict[bytes, bytes]()
    for name, own in zip(stored, values, strict=True):
        rows[name] = _PLACE.pack(_MEMBER, pack_name, at, len(own))
        at += len(own)
    return {pack_name: pack, **rows}


def open_members(
    rows: dict[bytes, bytes], fetch: Callable[[bytes], bytes], *, missing_ok: bool = False
) -> dict[bytes, bytes]:
    """Return rows with the values of members in the place of where they are.

    Args:
        rows: stored bytes by name.
        fetch: the row of a pack.
        missing_ok: leave out those of damaged packs.

    Raises:
        DamagedError: a pack is not what was written.
    """
    for pack, members in _by_pack(rows.items()).items():
        try:
            whole = _read_pack(pack, fetch(pack))
        except DamagedError:
            if not missing_ok:
                raise
            continue
        for name, place in members:
            rows[name] = PLAIN + whole[place.at : place.at + place.size]
    return rows


def with_members(rows: Iterable[list[Any]]) -> Iterator[list[Any]]:
    """Yield rows of a file's pages; after all others the members of packs, with the values of those that are whole."""
    packs: dict[bytes, list[bytes]] = {}
    members: list[tuple[bytes, bytes]] = []
    for row in rows:
        if len(row) == 2 and isinstance(row[0], bytes) and isinstance(row[1], bytes):
            if row[1].startswith(_MAGIC):
                packs.setdefault(row[0], []).append(row[1])  # free pages may have another one that is not whole
                continue
            if place_of(row[1]) is not None:
                members.append((row[0], row[1]))
                continue
        yield row
    for pack, listed in _by_pack(members).items():
        for data in packs.get(pack, ()):
            with suppress(DamagedError):
                whole = _read_pack(pack, data)
                yield from ([name, PLAIN + whole[place.at : place.at + place.size]] for name, place in listed)
                break


def _by_pack(rows: Iterable[tuple[bytes, bytes]]) -> dict[bytes, list[tuple[bytes, Place]]]:
    found: dict[bytes, list[tuple[bytes, Place]]] = {}
    for name, data in rows:
        place = place_of(data)
        if place is not None:
            found.setdefault(place.pack, []).append((name, place))
    return found


def _read_pack(name: bytes, data: bytes) -> bytes:
    import lzma

    try:
        whole = lzma.decompress(data)
    except lzma.LZMAError as error:
        raise DamagedError(f"a pack cannot be unpacked: {error}") from None
    if hashlib.sha256(whole).digest() != name:
        raise DamagedError("a checksum does not match: of a pack")
    return whole
