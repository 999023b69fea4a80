"""Readings of a drive on the disk until they have entered the map; they survive a crash.

The folder `MAP.live` holds a file for each session: parts of a recording one after the other (`parts`). The one that is
being written ends in `.part`. Readings that have not entered the map are never deleted: of a damaged file, what is
intact enters, and the file is set aside. A process that feeds a map holds the lock of the folder; its end, whatever it
dies of, gives the lock back.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

from evermap.config import Config, parse_config, to_toml
from evermap.errors import ConfigError, DataError, EvermapError, InputError, NumericalError
from evermap.io import write_native
from evermap.io.files import write_atomic
from evermap.live.inbox import joined
from evermap.live.parts import close_parts, pack_part, unpack_parts
from evermap.maps.store import StaleRevisionError, open_store
from evermap.runs.sessions import Entered, TwiceError, enter_session
from evermap.types import AnyRecording

TRIES = 3
"""Attempts to enter a session while another process changes the map."""
WAITING = ".readings"
"""Ending of the file of a session that waits to be entered."""


_NAMED = re.compile(r"(?:aside-|damaged-)?(\d+)(?:\.[a-z]+)?")
"""What is of a session: waiting, being written, set aside, damaged."""
_SUM = "# checksum "
"""Beginning of the first line of settings, before the CRC-32 of the others."""


@dataclass(frozen=True, slots=True)
class Brought:
    """Result of entering a waiting session.

    Attributes:
        name: of its recording.
        revision: of the map that it made; None where it made none.
        problem: why it did not enter; empty where it did, or had.
        entered: what it made of the map; None as above, and where it was in the map already.
        damage: what of it is lost; empty where nothing is.
    """

    name: str
    revision: int | None
    problem: str = ""
    entered: Entered | None = None
    damage: str = ""


class Spool:
    """The folder of a map, held by this process.

    Raises:
        ConfigError: another process feeds the map. InputError: nothing can be written beside it.
    """

    def __init__(self, map_file: Path) -> None:
        self.map_file, self.folder = map_file, map_file.with_name(f"{map_file.name}.live")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = (self.folder / "lock").open("a")
        except OSError as error:
            raise InputError(f"cannot be written: {error.strerror}", path=self.folder, hint="mapping=False") from None
        if not _take_lock(self._lock):
            self._lock.close()
            hint = "one engine feeds a map; others localise in it: mapping=False"
            raise ConfigError("another process feeds this map", path=map_file, hint=hint)
        for part in self.folder.glob("*.part"):
            self._let_wait(part)
        self._file: IO[bytes] | None = None
        self._number = self._parts = 0
        self._unwritten: list[bytes] = []

    def settle(self, config: Config) -> None:
        """Keep the settings that sessions are entered with from here on."""
        text = to_toml(config)
        write_atomic(self.folder / "config.toml", f"{_SUM}{zlib.crc32(text.encode()):08x}\n{text}")
        _sync(self.folder)

    def write(self, recording: AnyRecording) -> None:
        """Put a part of the present session on the disk. One that finds no room there is written with the next.

        Raises:
            OSError: it cannot be written now.
        """
        if self._file is None:
            self._number = 1 + max(self._number, *_find_numbers(self.folder), 0)
            self._parts, self._file = 0, (self.folder / f"{self._number:06d}.part").open("ab")
            _sync(self.folder)
        self._parts += 1
        self._unwritten.append(pack_part(self._parts, recording))
        self._flush(self._file)

    def finish(self) -> None:
        """End the present session: it waits to be entered.

        Raises:
            OSError: a part that found no room finds none now.
        """
        if self._file is not None:
            self._flush(self._file)
            path = Path(self._file.name)
            self._file.close()
            self._let_wait(path)
            self._file = None

    def _flush(self, file: IO[bytes]) -> None:
        begin = file.tell()
        try:
            file.write(b"".join(self._unwritten))
            file.flush()
            os.fsync(file.fileno())
        except OSError:
            with suppress(OSError):  # a part of a part is damage; it is skipped where it stays
                os.truncate(file.name, begin)
            with suppress(OSError):  # bytes that the file still holds in memory would be written once more
                file.close()
            self._file = Path(file.name).open("ab")  # noqa: SIM115  (until `finish`)
            raise
        self._unwritten = []

    def _let_wait(self, part: Path) -> None:
        """Take a file for a session that has ended, by itself or by a crash."""
        with suppress(OSError), part.open("r+b") as file:  # what is not closed is damaged, and kept
            file.write(close_parts(file.read()))
            file.flush()
            os.fsync(file.fileno())
        path = part.with_suffix(WAITING)
        if path.exists():
            path = self.folder / f"{1 + max(_find_numbers(self.folder)):06d}{WAITING}"
        part.rename(path)
        _sync(self.folder)

    def close(self) -> None:
        """Let others feed the map; what waits can be entered by `recover`."""
        self.finish()
        self._lock.close()

    def enter_beside(self) -> subprocess.Popen[str]:
        """Enter waiting sessions in a separate process, which prints a line of JSON for each."""
        command = [sys.executable, "-c", "import sys; from evermap.live.spool import _main; _main(*sys.argv[1:])"]
        quiet = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        return subprocess.Popen(  # noqa: S603  (ourselves; no shell reads the name of the map)
            [*command, str(self.map_file)], stdout=subprocess.PIPE, text=True, env=quiet, stdin=subprocess.DEVNULL
        )


def enter_waiting(map_file: Path, config: Config | None = None) -> Iterator[Brought]:
    """Enter the waiting sessions of a map, one after the other, and report each.

    One that cannot be entered is set aside as a recording in the native format, beside the others; of one that is
    damaged what is intact enters, and its file is kept as `damaged-NUMBER`. Where the map or the disk is at fault it
    waits for the next attempt.

    Args:
        map_file: the map that they are of.
        config: settings where those of the sessions cannot be read; None: as delivered.
    """
    folder = map_file.with_name(f"{map_file.name}.live")
    settings = find_settings(folder / "config.toml") or config or Config()
    for path in sorted(folder.glob(f"[0-9]*{WAITING}")):
        try:
            brought = _enter_file(map_file, path, settings)
        except EvermapError as error:  # the next attempt may have what this one lacked
            brought = Brought(path.stem, None, f"{error.problem}; its readings wait in {path}")
        except Exception as error:
            defect = "" if isinstance(error, OSError | MemoryError) else f"a bug in evermap: {type(error).__name__}: "
            brought = Brought(path.stem, None, f"{defect}{error}; its readings wait in {path}")
        if brought is not None:
            yield brought


def _enter_file(map_file: Path, path: Path, config: Config) -> Brought | None:
    """Enter a session and delete its file, or set it aside; None where there was nothing to enter."""
    parts, brought = unpack_parts(path.read_bytes()), None
    if sum(len(part.detections) for part in parts.recordings):
        brought = _entered(map_file, joined(parts.recordings), config, path)
    if not parts.lost:
        path.unlink(missing_ok=True)
        return brought
    aside = path.with_name(f"damaged-{path.name}")
    path.rename(aside)
    _sync(path.parent)
    brought = brought or Brought(path.stem, None, "nothing of it is left to enter")
    return replace(brought, damage=f"{parts.damage}; the file is kept as {aside}")


def find_settings(path: Path) -> Config | None:
    """Return the settings that `Spool.settle` wrote; None where there are none, or they are damaged."""
    try:
        first, _, rest = (text := path.read_text(encoding="utf-8")).partition("\n")
        if first.startswith(_SUM):
            text = rest
            if f"{zlib.crc32(text.encode()):08x}" != first.removeprefix(_SUM):
                return None
        return parse_config(text)
    except (OSError, ValueError, EvermapError):
        return None


def _find_numbers(folder: Path) -> list[int]:
    """Return the numbers of all sessions that the folder has anything of."""
    named = (_NAMED.fullmatch(path.name) for path in folder.iterdir())
    return [int(match[1]) for match in named if match is not None]


def _sync(folder: Path) -> None:
    """Put the names of a folder's files on the disk, where the system can do that."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def recover(map_file: str | Path) -> tuple[Brought, ...]:
    """Enter what a process that was killed has left of its drive.

    Args:
        map_file: the map that it fed.

    Raises:
        ConfigError: a process is feeding the map.
        InputError: it is no map.
    """
    path = Path(map_file)
    if not path.with_name(f"{path.name}.live").is_dir():
        return ()
    spool = Spool(path)
    try:
        return tuple(enter_waiting(path))
    finally:
        spool.close()


def _entered(map_file: Path, recording: AnyRecording, config: Config, path: Path) -> Brought:
    problem = ""
    for _ in range(TRIES):
        try:
            with open_store(map_file, create=True) as store:
                entered = enter_session(store, recording, config)
                if refusal := entered.refusal(config):
                    problem = f"set aside: {refusal}"
                    break
                number = entered.commit(store, config, command="evermap live")
                return Brought(recording.name, number, entered=entered)
        except TwiceError:  # killed after it was entered, before that was noted
            return Brought(recording.name, None)
        except StaleRevisionError as error:
            problem = error.problem
        except (DataError, InputError, NumericalError) as error:
            problem = error.problem
            break
        except (EvermapError, OSError, MemoryError):  # the next attempt may have what this one lacked
            raise
        except Exception as error:  # a bug must not stop the sessions behind it
            problem = f"a bug in evermap: {type(error).__name__}: {error}"
            break
    aside = path.with_name(f"aside-{path.stem}")
    write_native(replace(recording, source=""), aside)
    return Brought(recording.name, None, f"{problem}; its readings are in {aside}")


def _main(map_file: str) -> None:
    """Enter waiting sessions and report them: the main function of the separate process."""
    with suppress(OSError, AttributeError):
        os.nice(10)
    for one in enter_waiting(Path(map_file)):
        row = {"name": one.name, "revision": one.revision, "problem": one.problem, "damage": one.damage}
        print(json.dumps(row), flush=True)


def _take_lock(file: Any) -> bool:
    """Take the lock of a folder; False where another process has it."""
    try:
        import fcntl
    except ImportError:  # Windows has no such lock
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
