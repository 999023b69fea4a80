"""Readings on the disk: what damage costs, and that nothing is deleted that has not entered."""

from __future__ import annotations

import errno
import os
import stat
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from benchmarks.spool_faults import make_part, measure

from evermap.config import Config, LiveConfig
from evermap.errors import DataError, InputError
from evermap.live import spool as spooling
from evermap.live.parts import close_parts, pack_part, unpack_parts
from evermap.live.spool import Spool, enter_waiting, recover
from evermap.maps.store import open_store
from evermap.maps.store.measured import pack_recording
from evermap.types import UNKNOWN, AnyRecording

COUNT = 6


PARTS = [make_part(k, rate_hz=1.5, count=1) for k in range(1, COUNT + 1)]
BLOCKS = [pack_part(k, part) for k, part in enumerate(PARTS, start=1)]
OPEN = b"".join(BLOCKS)
FILE = OPEN + close_parts(OPEN)


def numbers_of(recordings: tuple[AnyRecording, ...]) -> list[int]:
    """Which parts these are, all of whose readings are as they were written."""
    found = [round(float(one.frames.stamp_s[0]) / 2.0) for one in recordings]
    for number, one in zip(found, recordings, strict=True):
        assert pack_recording(one) == pack_recording(PARTS[number - 1])
    return found


@pytest.mark.parametrize("seed", range(4))
def test_a_flipped_bit_costs_one_part(seed: int) -> None:
    random = np.random.default_rng(seed)
    for at in random.integers(len(FILE), size=100):
        data = bytearray(FILE)
        data[at] ^= 1 << random.integers(8)
        parts = unpack_parts(bytes(data))
        hit = int(np.searchsorted(np.cumsum([len(block) for block in BLOCKS]), at, side="right")) + 1
        assert numbers_of(parts.recordings) == [k for k in range(1, COUNT + 1) if k != hit]
        assert parts.lost == ((hit,) if hit <= COUNT else (UNKNOWN,))


def test_the_measurement_finds_what_flips_cost() -> None:
    cost = measure(60, 3)
    assert (cost.refused, cost.wrong, cost.silent) == (0, 0, 0)
    assert set(cost.lost) == {0, 1}
    assert cost.settings > 0
    assert cost.lost.total() == 60


def test_every_bit_of_a_header_may_be_flipped() -> None:
    begin = len(BLOCKS[0])
    for bit in range(8 * 28):
        data = bytearray(FILE)
        data[begin + bit // 8] ^= 1 << bit % 8
        parts = unpack_parts(bytes(data))
        assert numbers_of(parts.recordings) == [1, 3, 4, 5, 6]
        assert parts.lost == (2,)


@pytest.mark.parametrize("left", [1, 7, 8, 27, 28, 29, 300])
def test_a_part_that_a_crash_cut_off_was_never_there(left: int) -> None:
    data = b"".join(BLOCKS[:3]) + BLOCKS[3][:left]
    parts = unpack_parts(data + close_parts(data))
    assert numbers_of(parts.recordings) == [1, 2, 3]
    assert not parts.lost
    alone = unpack_parts(BLOCKS[0][:left] + close_parts(BLOCKS[0][:left]))
    assert not alone.recordings
    assert bool(alone.lost) == (left < 28)  # whose header is cut, it may be anything


@pytest.mark.parametrize("at", range(0, len(FILE), 1371))
def test_a_file_that_lost_its_end_says_so(at: int) -> None:
    """Other than one that a crash ended, which was closed when it was found."""
    parts = unpack_parts(FILE[:at])
    whole = int(np.searchsorted(np.cumsum([len(block) for block in BLOCKS]), at, side="right"))
    assert numbers_of(parts.recordings) == list(range(1, whole + 1))
    assert bool(parts.damage) == (at > 0)
    assert close_parts(FILE) == b""


@pytest.mark.parametrize(
    ("blocks", "found", "lost"),
    [
        (BLOCKS[:2] + BLOCKS[3:], [1, 2, 4, 5, 6], (3,)),
        (BLOCKS[2:], [3, 4, 5, 6], (1, 2)),
        ([BLOCKS[1], BLOCKS[0], *BLOCKS[2:]], [1, 2, 3, 4, 5, 6], ()),
        ([BLOCKS[0], *BLOCKS], [1, 2, 3, 4, 5, 6], ()),
        ([*BLOCKS[:2], b"\0" * 512, *BLOCKS[2:]], [1, 2, 3, 4, 5, 6], ()),
        ([*BLOCKS[:2], BLOCKS[2][:100], *BLOCKS[3:]], [1, 2, 4, 5, 6], (3,)),
        (BLOCKS[:4], [1, 2, 3, 4], (5, 6)),
        ([b"nothing of ours" * 9], [], (UNKNOWN,)),
        ([], [], ()),
    ],
    ids=["hole", "begin", "swapped", "twice", "zeros", "cut within", "end", "other", "empty"],
)
def test_what_is_intact_is_found_in_its_order(blocks: list[bytes], found: list[int], lost: tuple[int, ...]) -> None:
    end = FILE[len(OPEN) :] if found else b""
    parts = unpack_parts(b"".join(blocks) + end)
    assert numbers_of(parts.recordings) == found
    assert parts.lost == lost


def test_parts_without_marks_are_read_up_to_damage() -> None:
    """As they were written before parts had numbers: the length, then the bytes."""
    blocks = [len(data := pack_recording(part)).to_bytes(8, "little") + data for part in PARTS]
    whole = unpack_parts(b"".join(blocks))
    assert numbers_of(whole.recordings) == [1, 2, 3, 4, 5, 6]
    assert not whole.lost
    cut = unpack_parts(b"".join(blocks)[:-20])
    assert numbers_of(cut.recordings) == [1, 2, 3, 4, 5]
    assert cut.lost == (UNKNOWN,)
    for bit in range(64):  # of a length
        length = bytearray(b"".join(blocks))
        length[len(blocks[0]) + bit // 8] ^= 1 << bit % 8
        assert unpack_parts(bytes(length)).lost == (UNKNOWN,)
    hit = bytearray(b"".join(blocks))
    middle = len(blocks[0]) + len(blocks[1]) // 2
    hit[middle : middle + 64] = bytes(64)  # one bit may be a date that nobody reads
    damaged = unpack_parts(bytes(hit))
    assert numbers_of(damaged.recordings) == [1]
    assert damaged.lost == (UNKNOWN,)


class Entering:
    """A map that takes sessions, or fails as it is asked to."""

    def __init__(self) -> None:
        self.frames: list[int] = []
        self.configs: list[Config] = []
        self.fails: list[BaseException | None] = []
        self.refusal = ""

    def __call__(self, _store: Any, recording: AnyRecording, config: Config) -> Any:
        if self.fails and (error := self.fails.pop(0)) is not None:
            raise error
        self.frames.append(len(recording.frames))
        self.configs.append(config)
        return SimpleNamespace(refusal=lambda _: self.refusal, commit=lambda *_, **__: len(self.frames))


@pytest.fixture
def entering(monkeypatch: pytest.MonkeyPatch) -> Entering:
    made = Entering()
    monkeypatch.setattr(spooling, "enter_session", made)
    return made


def wrote(path: Path, count: int = COUNT, config: Config | None = None) -> Path:
    """A session of some parts that waits; returns its file."""
    spool = Spool(path)
    if config is not None:
        spool.settle(config)
    for part in PARTS[:count]:
        spool.write(part)
    spool.close()
    return max(path.with_name(f"{path.name}.live").glob("*.readings"))


def test_of_a_damaged_session_the_rest_enters_and_its_file_is_kept(tmp_path: Path, entering: Entering) -> None:
    file = wrote(tmp_path / "site.evermap")
    data = bytearray(file.read_bytes())
    data[len(BLOCKS[0]) + 16] ^= 1  # of a length
    file.write_bytes(data)
    (brought,) = recover(tmp_path / "site.evermap")
    assert brought.revision == 1
    assert entering.frames == [3 * (COUNT - 1)]
    (kept,) = file.parent.glob("damaged-*")
    assert kept.read_bytes() == data
    assert brought.damage == f"1 of 6 parts (2) cannot be read; the file is kept as {kept}"
    assert recover(tmp_path / "site.evermap") == ()


@pytest.mark.parametrize(
    "data", [b"\0" * 4096, b"\xff" * 9, FILE[3 : len(BLOCKS[0])]], ids=["zeros", "ones", "headless"]
)
def test_a_file_of_which_nothing_can_be_read_is_kept(tmp_path: Path, entering: Entering, data: bytes) -> None:
    file = wrote(tmp_path / "site.evermap")
    file.write_bytes(data)
    later = wrote(tmp_path / "site.evermap")
    assert later != file
    damaged, brought = recover(tmp_path / "site.evermap")
    assert damaged.revision is None
    assert damaged.problem == "nothing of it is left to enter"
    assert damaged.damage.startswith("1 of 1 parts cannot be read; the file is kept as ")
    assert (file.parent / f"damaged-{file.name}").read_bytes() == data
    assert brought.revision == 1


def test_what_enters_is_deleted_and_what_is_empty_says_nothing(tmp_path: Path, entering: Entering) -> None:
    file = wrote(tmp_path / "site.evermap")
    (file.parent / "000007.readings").touch()
    (brought,) = recover(tmp_path / "site.evermap")
    assert (brought.revision, brought.damage) == (1, "")
    assert sorted(path.name for path in file.parent.iterdir()) == ["lock"]


@pytest.mark.parametrize(
    "error", [DataError("the map is locked", path="site"), OSError(errno.ENOSPC, "no space"), MemoryError()]
)
def test_where_the_map_is_at_fault_a_session_waits_and_stops_none(
    tmp_path: Path, entering: Entering, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    path = tmp_path / "site.evermap"
    first, second = wrote(path), wrote(path, 2)
    opening = open_store
    fails = [error]

    def open_or_fail(*given: Any, **options: Any) -> Any:
        if fails and isinstance(fails[0], OSError | MemoryError):
            raise fails.pop()
        return opening(*given, **options)

    monkeypatch.setattr(spooling, "open_store", open_or_fail)
    if isinstance(error, DataError):
        entering.fails = [error]
    waits, brought = recover(path)
    assert waits.revision is None
    assert brought.revision is not None
    assert not second.exists()
    if isinstance(error, DataError):  # of the session
        assert (first.parent / "aside-000001").is_dir()
    else:
        assert waits.problem.endswith(f"its readings wait in {first}")
        (brought,) = recover(path)
        assert brought.revision is not None
        assert entering.frames == [6, 18]


def test_nothing_is_set_aside_over_what_is_there(tmp_path: Path, entering: Entering) -> None:
    """Numbers of sessions are not used again while anything of one is there."""
    path, entering.refusal = tmp_path / "site.evermap", "it is lost"
    for _ in range(2):
        wrote(path)
        (brought,) = recover(path)
        assert "set aside: it is lost; its readings are in " in brought.problem
    names = sorted(one.name for one in (tmp_path / "site.evermap.live").glob("aside-*"))
    assert names == ["aside-000001", "aside-000002"]


def test_foreign_files_stop_nothing(tmp_path: Path, entering: Entering) -> None:
    file = wrote(tmp_path / "site.evermap")
    for name in ("12 of monday.readings", "x.part.txt", "aside-", "000001.part"):
        (file.parent / name).write_bytes(FILE)
    assert [one.revision for one in recover(tmp_path / "site.evermap")] == [1, 2, 3]
    assert {"x.part.txt", "aside-"} <= {path.name for path in file.parent.iterdir()}


def test_settings_are_those_of_the_session_or_of_the_engine_where_they_are_damaged(
    tmp_path: Path, entering: Entering
) -> None:
    path, asked = tmp_path / "site.evermap", Config(live=LiveConfig(revision_s=77.0))
    file = wrote(path, config=asked)
    settings = file.parent / "config.toml"
    whole, other = settings.read_bytes(), Config(live=LiveConfig(revision_s=55.0))
    list(enter_waiting(path, other))
    for at in range(0, len(whole), 97):
        wrote(path, 1)
        data = bytearray(whole)
        data[at] ^= 1
        settings.write_bytes(data)
        list(enter_waiting(path, other))
    assert entering.configs[0] == asked
    assert all(one == other for one in entering.configs[1:])
    settings.write_text("[live]\nrevision_s = 66.0\n")  # as it was written before it had a checksum
    wrote(path, 1)
    list(enter_waiting(path, other))
    assert entering.configs[-1].live.revision_s == 66.0


def test_what_finds_no_room_is_written_with_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spool, sync = Spool(tmp_path / "site.evermap"), os.fsync
    spool.write(PARTS[0])

    def fail(_: int) -> None:
        raise OSError(errno.ENOSPC, "no space")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="no space"):
        spool.write(PARTS[1])
    monkeypatch.setattr(os, "fsync", sync)
    for part in PARTS[2:]:
        spool.write(part)
    spool.close()
    (file,) = (tmp_path / "site.evermap.live").glob("*.readings")
    assert file.read_bytes() == FILE


def test_what_found_no_room_at_last_is_written_at_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spool, sync = Spool(tmp_path / "site.evermap"), os.fsync
    for part in PARTS[:-1]:
        spool.write(part)

    def fail(_: int) -> None:
        raise OSError(errno.ENOSPC, "no space")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="no space"):
        spool.write(PARTS[-1])
    monkeypatch.setattr(os, "fsync", sync)
    spool.finish()
    (file,) = (tmp_path / "site.evermap.live").glob("*.readings")
    assert file.read_bytes() == FILE
    spool.close()


def test_a_drive_without_detections_has_nothing_to_enter(tmp_path: Path, entering: Entering) -> None:
    spool = Spool(tmp_path / "site.evermap")
    spool.write(replace(PARTS[0], detections=PARTS[0].detections[:0]))
    spool.close()
    assert recover(tmp_path / "site.evermap") == ()
    assert not list((tmp_path / "site.evermap.live").glob("*.readings"))


def test_names_are_put_on_the_disk_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file whose folder was not synced is not found after a power cut."""
    folders, sync = [], os.fsync

    def note(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            folders.append(sorted(path.name for path in (tmp_path / "site.evermap.live").iterdir()))
        sync(handle)

    monkeypatch.setattr(os, "fsync", note)
    wrote(tmp_path / "site.evermap", 2)
    assert folders == [["000001.part", "lock"], ["000001.readings", "lock"]]


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "site.evermap.live").write_text("a file")
    with pytest.raises(InputError, match="cannot be written"):
        Spool(tmp_path / "site.evermap")
