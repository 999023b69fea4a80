"""The protocol of map stores, and their revisions."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol, Self

import numpy as np

from evermap.errors import InputError
from evermap.existence.sites import Evidence
from evermap.maps.living import LivingMap, Members
from evermap.types import ChangeKind, MapChange


class RevisionKind(StrEnum):
    """Origin of a revision."""

    SESSION = "session"
    """A recording went into the map."""
    EDIT = "edit"
    """An operator pinned or deleted something."""
    REVERT = "revert"
    """An operator went back to an older revision."""


class StaleRevisionError(InputError):
    """Another process committed since the map was read; nothing was written."""


class StoreUnavailableError(InputError):
    """The database of a map does not answer, or refuses; neither the map nor the request is at fault."""


class DamagedMapError(InputError):
    """A map file with bytes that differ from those written.

    Attributes:
        intact: numbers of the revisions that are whole; `revert` goes back to any of them.
    """

    intact: tuple[int, ...] = ()


class PrunedRevisionError(InputError):
    """The content of a revision was deleted by `MapStore.prune`."""


@dataclass(frozen=True, slots=True)
class Attachment:
    """Bytes that belong to a revision, such as what its session measured.

    Attributes:
        revision: that they were committed with.
        name: what they are, unique in a revision.
        digest: their checksum (SHA-256, hexadecimal); equal bytes have the same one and are stored once.
        n_bytes: how many.
    """

    revision: int
    name: str
    digest: str
    n_bytes: int


@dataclass(frozen=True, slots=True)
class Provenance:
    """Provenance of a revision.

    Attributes:
        kind: what made it.
        recording, source: name of the recording, and where it was read from; '' where there is none.
        command: what was typed.
        config: the configuration in force, as TOML.
        seed: of everything random; None where nothing is.
        stamp_from_s, stamp_to_s: first and last stamp of what went in; nan where nothing did.
        wall_s: what making it took [s]; nan where nobody measured.
        note: an operator's word on it, for example 'pinned landmark 12'.
        robot: whose session it is; '' where nobody said.
    """

    kind: RevisionKind = RevisionKind.SESSION
    recording: str = ""
    source: str = ""
    command: str = ""
    config: str = ""
    seed: int | None = None
    stamp_from_s: float = float("nan")
    stamp_to_s: float = float("nan")
    wall_s: float = float("nan")
    note: str = ""
    robot: str = ""


@dataclass(frozen=True, slots=True)
class Revision:
    """One line of a map's history.

    Attributes:
        number: counted from 1; 0 is the empty map before the first session.
        parent: the revision before it.
        restores: the revision whose content this one brought back; None if it is no revert.
        created_at: when it was committed, ISO 8601, UTC.
        evermap_version: who wrote it.
        provenance: where it comes from.
        n_landmarks, n_existing: landmarks that it knows, and those of them that more probably exist than not.
        n_changes: number of changes by kind, kinds without any left out.
        n_grown: landmarks that its session found, but nobody saw appear; None in files of an older evermap.
    """

    number: int
    parent: int
    restores: int | None
    created_at: str
    evermap_version: str
    provenance: Provenance
    n_landmarks: int
    n_existing: int
    n_changes: Mapping[ChangeKind, int] = field(default_factory=dict)
    n_grown: int | None = None


@dataclass(frozen=True, slots=True)
class Pruning:
    """Content that `MapStore.prune` deleted, or would delete.

    Attributes:
        revisions: whose content that was.
        kept: revisions that still have theirs.
        n_chunks, n_bytes: pieces that only `revisions` held, and their size in the store.
    """

    revisions: tuple[int, ...]
    kept: tuple[int, ...]
    n_chunks: int
    n_bytes: int


class MapStore(Protocol):
    """Revisions of one living map. A revision is written whole or not at all, and never changed afterwards; the
    content of old ones goes by `prune` only.

    History is a line: a commit names the revision that it was made from, and fails if that is not the newest any more.
    Methods raise `InputError` where the store cannot be read or written, is damaged, or has no such revision. Where
    `revision` is None the newest is meant.
    """

    where: str
    """Path or address, for messages."""

    def head(self) -> int:
        """Return the newest revision; 0 if there is none yet."""
        ...

    def log(self) -> tuple[Revision, ...]:
        """Return all revisions, the oldest first."""
        ...

    def lineage(self, revision: int | None = None) -> tuple[int, ...]:
        """Return the ancestors of a revision and itself, oldest first, without reverted ones."""
        ...

    def load(self, revision: int | None = None) -> LivingMap:
        """Return the map as it was committed, bit by bit; revision 0 is the empty map.

        Raises:
            PrunedRevisionError: its content was pruned.
        """
        ...

    def members(self, revision: int | None = None) -> Members:
        """Return the landmarks of a revision and what operators said of them, also of a pruned one."""
        ...

    def commit(
        self,
        living: LivingMap,
        provenance: Provenance,
        changes: Sequence[MapChange] = (),
        evidence: Evidence | None = None,
        *,
        parent: int,
        attachments: Mapping[str, bytes | Attachment] | None = None,
    ) -> int:
        """Return a new revision, durable when this returns its number.

        Args:
            living: the map.
            provenance: where it comes from.
            changes: how it differs from its parent, as its session says.
            evidence: what the session saw of every clique; kept with 7 digits.
            parent: the revision that the map was made from.
            attachments: bytes to keep with the revision, by name, or attachments of earlier ones to share; neither is
                handed on to the next revision.

        Raises:
            StaleRevisionError: `parent` is not the newest revision.
            NumericalError: the map contradicts itself, or holds a position that is not finite; nothing was written.
        """
        ...

    def revert(self, revision: int, provenance: Provenance | None = None) -> int:
        """Return a new revision with the content of an older one; reverting to the one before takes it back.

        Ids that were given since are not given again.
        """
        ...

    def prune(self, keep: int = 10, *, also: Collection[int] = (), dry_run: bool = False) -> Pruning:
        """Delete the content that only old revisions hold; all or nothing of it, and nothing from a damaged map.

        Their lines in the log, changes, evidence, attachments, landmarks' ids and operators' words stay, as do all
        checksums. They cannot be loaded or reverted to any more.

        Args:
            keep: newest revisions that stay whole, and as many of `lineage()`, which late sessions start from.
            also: other revisions that stay whole, as those that robots use.
            dry_run: return what would be deleted, and delete nothing.

        Raises:
            ConfigError: `keep` is less than 1.
        """
        ...

    def compact(self) -> None:
        """Store the same in fewer bytes: all or nothing, and no damaged map. All answers are as before.

        Chunks of all revisions but the newest are compressed together. An older evermap refuses the map then.
        """
        ...

    def changes(self, revision: int | None = None) -> tuple[MapChange, ...]:
        """Return the committed changes of one revision."""
        ...

    def changes_of(self, landmark_id: int | None = None) -> tuple[tuple[int, MapChange], ...]:
        """Return all changes that a landmark (None for any) had a part in, each with its revision, in order."""
        ...

    def evidence(
        self,
        *,
        clique_id: int | None = None,
        landmark_id: int | None = None,
        since_s: float = -np.inf,
        revisions: Collection[int] | None = None,
    ) -> Evidence:
        """Return the evidence of sessions, by time; of one clique, or of the cliques that a landmark belonged to.

        Args:
            clique_id: the clique; None for all.
            landmark_id: the landmark; None for all.
            since_s: leave out what is older.
            revisions: whose sessions; None for those of `lineage()`.
        """
        ...

    def evidence_by_revision(
        self,
        *,
        clique_id: int | None = None,
        landmark_id: int | None = None,
        since_s: float = -np.inf,
        revisions: Collection[int] | None = None,
    ) -> dict[int, Evidence]:
        """Return the same by the revisions that it was stored with, each by time; empty where one has none."""
        ...

    def attachments(self, revisions: Collection[int] | None = None) -> tuple[Attachment, ...]:
        """Return the attachments of revisions, oldest first, without reading them; None for those of `lineage()`."""
        ...

    def attached(self, attachment: Attachment) -> bytes:
        """Read the bytes of an attachment; their checksum is compared."""
        ...

    def close(self) -> None:
        """Let go of the file or the connection."""
        ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
