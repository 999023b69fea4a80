"""Readings of a drive on the disk until they have entered the map; they survive a crash.

The folder `MAP.live` holds a file for each session: parts of a recording one after the other, each with its length in
front, so that a part that a crash cut off is recognised. The one that is being written ends in `.part`. A process that
feeds a map holds the lock of the folder; its end, whatever it dies of, gives the lock back.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

from evermap.config import Config, parse_config, to_toml
from evermap.errors import ConfigError, DataError, EvermapError, InputError, NumericalError
from evermap.io import write_native
from evermap.live.inbox import joined
from evermap.maps.store import StaleRevisionError, open_store
from evermap.maps.store.measured import pack_recording, unpack_recording
from evermap.runs.sessions import Entered, TwiceError, enter_session
from evermap.types import AnyRecording

TRIES = 3
"""Attempts to enter a session while another process changes the map."""


@dataclass(frozen=True, slots=True)
class Brought:
    """Result of entering a waiting session.

    Attributes:
        name: of its recording.
        revision: of the map that it made; None where it was set aside.
        problem: why it was; empty where it was not.
        entered: what it made of the map; None as above, and where it was in the map already.
    """

    name: str
    revision: int | None
    problem: str = ""
    entered: Entered | None = None


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
            part.rename(part.with_suffix(".readings"))
        self._file: IO[bytes] | None = None
        self._number = 0

    def settle(self, config: Config) -> None:
        """Keep the settings that sessions are entered with from here on."""
        (self.folder / "config.toml").write_text(to_toml(config), encoding="utf-8")

    def write(self, recording: AnyRecording) -> None:
        """Put a part of the present session on the disk."""
        if self._file is None:
            there = (int(path.stem) for path in self.folder.glob("[0-9]*.readings"))
            self._number = 1 + max(self._number, *there, 0)
            self._file = (self.folder / f"{self._number:06d}.part").open("ab")
        data = pack_recording(recording)
        self._file.write(len(data).to_bytes(8, "little") + data)
        self._file.flush()
        os.fsync(self._file.fileno())

    def finish(self) -> None:
        """End the present session: it waits to be entered."""
        if self._file is not None:
            path = Path(self._file.name)
            self._file.close()
            path.rename(path.with_suffix(".readings"))
            self._file = None

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


def enter_waiting(map_file: Path) -> Iterator[Brought]:
    """Enter the waiting sessions of a map, one after the other, and report each.

    One that cannot be entered is set aside as a recording in the native format, beside the others.
    """
    folder = map_file.with_name(f"{map_file.name}.live")
    settings = folder / "config.toml"
    config = parse_config(settings.read_text(encoding="utf-8")) if settings.is_file() else Config()
    for path in sorted(folder.glob("*.readings")):
        parts = list(read_parts(path))
        if parts and sum(len(part.detections) for part in parts):
            yield _entered(map_file, joined(parts), config, path)
        path.unlink(missing_ok=True)


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


def read_parts(path: Path) -> Iterator[AnyRecording]:
    """Yield the parts of a session until the end of the file, or to where a crash cut it off."""
    data = path.read_bytes()
    at = 0
    while at + 8 <= len(data):
        size = int.from_bytes(data[at : at + 8], "little")
        part = data[at + 8 : at + 8 + size]
        if len(part) < size:
            return
        yield unpack_recording(part)
        at += 8 + size


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
    with suppress(InputError):
        write_native(replace(recording, source=""), aside)
    return Brought(recording.name, None, f"{problem}; its readings are in {aside}")


def _main(map_file: str) -> None:
    """Enter waiting sessions and report them: the main function of the separate process."""
    with suppress(OSError, AttributeError):
        os.nice(10)
    for one in enter_waiting(Path(map_file)):
        print(json.dumps({"name": one.name, "revision": one.revision, "problem": one.problem}), flush=True)


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
