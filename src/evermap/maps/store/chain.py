"""The chain of a store's records: each is checked against the one after it, and the newest against the anchor."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from sqlalchemy import Connection, select

from evermap.errors import InputError
from evermap.maps.store import content, schema
from evermap.maps.store.anchor import read_anchor
from evermap.maps.store.chunk_table import fetch_chunks
from evermap.maps.store.content import DamagedError
from evermap.maps.store.history import Record, lineage


class RecordChain:
    """Records of the revisions of a store, as they are read; those that were read are kept.

    Args:
        where: path or address of the store, for messages.
    """

    def __init__(self, where: str) -> None:
        self.where = where
        self._records: dict[bytes, Record] = {}  # they never change, and their names are their checksums
        self._history: tuple[Any, int, dict[int, Record], dict[int, bytes | None]] | None = None  # of `read`

    def read(self, connection: Connection, since: int = 1) -> tuple[dict[int, Record], dict[int, bytes | None]]:
        """Records from a revision to the newest, each checked against the one after it; and which are lost."""
        head, expected = read_anchor(connection)
        if self._history is not None and self._history[0] == (head, expected) and self._history[1] <= since:
            return self._history[2:]
        anchor = head, expected
        table = schema.revision.c
        listed: dict[int, Any] = {
            row.number: row.record
            for row in connection.execute(select(table.number, table.record).where(table.number >= since))
        }
        names = {bytes(name) for name in listed.values() if isinstance(name, bytes)}
        for name, data in fetch_chunks(connection, names - self._records.keys(), missing_ok=True).items():
            try:
                self._records[name] = Record.of_text(content.read_text(name, data))
            except DamagedError as error:
                raise DamagedError(f"{error}, of the record of a revision") from None
        found: dict[int, Record] = {}
        lost: dict[int, bytes | None] = {}
        for number in range(head, max(since, 1) - 1, -1):
            if number in lost:
                expected = lost[number]
                continue
            record = None if expected is None else self._records.get(expected)
            if record is None or record.number != number or listed.get(number) != expected:
                raise DamagedError(f"a checksum does not match: revision {number} is not the one that was written")
            found[number] = record
            lost |= record.lost
            expected = record.parent
        self._history = anchor, since, found, lost
        return found, lost

    def record_of(self, connection: Connection, number: int) -> Record:
        """The record of a revision.

        Raises:
            InputError: it is lost.
        """
        found, _ = self.read(connection, number)
        if number not in found:
            hint = f"evermap map log {self.where}"
            raise InputError(f"revision {number} was lost to damage of the file", path=self.where, hint=hint)
        return found[number]

    def records_of(self, connection: Connection, revisions: Collection[int] | None) -> list[Record]:
        """Records of some revisions, oldest first; of the lineage of the newest if not told which."""
        records, _ = self.read(connection)
        wanted = self.find_lineage(connection, None) if revisions is None else sorted(revisions)
        return [records[number] for number in wanted if number in records]

    def find_number(self, connection: Connection, revision: int | None) -> int:
        """The number of a revision that exists."""
        head, _ = read_anchor(connection)
        number = head if revision is None else revision
        if not 0 <= number <= head:
            there = f"it has {head} of them" if head else "it has none yet"
            raise InputError(f"no revision {number}; {there}", path=self.where, hint=f"evermap map log {self.where}")
        return number

    def find_lineage(self, connection: Connection, revision: int | None) -> tuple[int, ...]:
        number = self.find_number(connection, revision)
        records, _ = self.read(connection)
        return lineage({k: record.origin for k, record in records.items()}, number)
