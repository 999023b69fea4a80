"""What the models of presence are compared on: rooms with looks, a door without, and the robot's looks at the door."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evermap.errors import InputError
from evermap.existence.protocol import Instants, Looks
from evermap.existence.rhythm import WEEK_S
from evermap.io.columns import read_columns
from evermap.types import FloatArray
from evermap.valid import STAMP_S

P_MISS = P_FALSE = 0.1
"""Of the detector of the room (so its authors simulated it) and of the robot that looks at the door."""
NOISE_SEEDS = 10
"""How often the robot's looks are drawn."""
DOOR_TESTS = 4
HOME = "aruba_person_room.csv.gz"
HOME_WEEKS = 10
RARE = 0.01
"""A room that is hardly ever used says nothing: always 'nobody there' is as good as right."""
_FLAGS = "1 or 0"


@dataclass(frozen=True, slots=True)
class Task:
    """What a forecaster of the door is given.

    Attributes:
        name: letter in the tables.
        title: in words.
        every_s: time from look to look; None: no look at all.
    """

    name: str
    title: str
    every_s: float | None


TASKS = (
    Task("a", "a week ahead, no look", None),
    Task("b", "a look every 30 minutes", 1800.0),
    Task("c", "a look every 4 hours", 14400.0),
)


@dataclass(frozen=True, slots=True)
class Stretch:
    """What truly was, minute by minute.

    Attributes:
        name: which file.
        stamp_s: (N,) local wall time; what lies in a jump is not known.
        present: (N,) 1 or 0.
    """

    name: str
    stamp_s: FloatArray
    present: FloatArray

    def certain_looks(self) -> Looks:
        """The truth as looks that never err: what is learned from."""
        return Looks.from_rows(np.zeros(len(self.stamp_s), dtype=np.int64), self.stamp_s, self.present, 0.0, 0.0)

    def without_last_week(self) -> tuple[Stretch, Stretch]:
        """All but the last seven days, and these: the one to learn from, the other to choose with."""
        late = self.stamp_s > self.stamp_s[-1] - WEEK_S
        return (
            Stretch(f"{self.name}, but its last week", self.stamp_s[~late], self.present[~late]),
            Stretch(f"last week of {self.name}", self.stamp_s[late], self.present[late]),
        )


@dataclass(frozen=True, slots=True)
class Trial:
    """One stretch to be foretold under a task: the same truth for every drawing of the noise, a feature each.

    Attributes:
        name: of the stretch.
        looks: of R features.
        instants: all stamps of the stretch, for each of them.
        present: (N,) the truth at these stamps.
    """

    name: str
    looks: Looks
    instants: Instants
    present: FloatArray

    @property
    def drawings(self) -> int:
        """R."""
        return self.looks.n_features


def trial(stretch: Stretch, task: Task, random: np.random.Generator, *, drawings: int = NOISE_SEEDS) -> Trial:
    """Draw the robot's looks: at whole multiples of the interval since the begin, where the truth is known.

    Args:
        stretch: what truly was.
        task: how often the robot looks.
        random: of the detector's errors.
        drawings: how many robots look, each with errors of its own; one where none looks.
    """
    rows = np.zeros(0, dtype=np.int64)
    if task.every_s is None:
        drawings = 1
    else:
        rows = np.flatnonzero(np.mod(stretch.stamp_s - stretch.stamp_s[0], task.every_s) == 0.0)
    truth = np.tile(stretch.present[rows], drawings)
    wrong = random.random(len(truth)) < np.where(truth == 1.0, P_MISS, P_FALSE)
    looks = Looks.from_rows(
        np.repeat(np.arange(drawings), len(rows)),
        np.tile(stretch.stamp_s[rows], drawings),
        np.where(wrong, 1.0 - truth, truth),
        P_MISS,
        P_FALSE,
        n_features=drawings,
    )
    return Trial(stretch.name, looks, Instants.same_for_all(drawings, stretch.stamp_s), stretch.present)


@dataclass(frozen=True, slots=True)
class Door:
    """A door, open or closed.

    Attributes:
        train: what may be learned from and chosen with.
        tests: weeks to be foretold.
    """

    train: Stretch
    tests: tuple[Stretch, ...]

    def trials(self, task: Task, seed: int) -> list[Trial]:
        """The test weeks under a task, and the looks that are drawn for this seed."""
        return [trial(week, task, _stream(seed, task, 1 + k)) for k, week in enumerate(self.tests)]

    def rehearsal(self, task: Task, seed: int) -> Trial:
        """The last week of `train`, to choose with."""
        _, late = self.train.without_last_week()
        return trial(late, task, _stream(seed, task, 0))


def read_home(folder: Path) -> dict[str, Door]:
    """Whether a person is in each of the rooms of a flat: ten weeks to learn from, the whole weeks after them as tests.

    The recording begins on a Thursday at 00:00, as stamps from 1970 do, so days of the week are right as they are.

    Returns:
        By room, those that the person is in at least `RARE` of the ten weeks; nothing where the file is not there.

    Raises:
        InputError: the file is malformed, or too short.
    """
    path = folder / HOME
    if not path.is_file():
        return {}
    table = read_columns(path, [])
    table.expect(("stamp_s", "room"))
    stamp_s, (names, room) = table.numbers(STAMP_S), table.labels("room")
    week = ((stamp_s - stamp_s[0]) // WEEK_S).astype(np.int64)
    whole = int((stamp_s[-1] + 60.0 - stamp_s[0]) // WEEK_S)
    if whole <= HOME_WEEKS or (np.diff(stamp_s) <= 0.0).any():
        raise InputError(f"needs more than {HOME_WEEKS} weeks, in order of time", path=path, field="stamp_s")
    doors = {}
    for index, name in enumerate(names):
        there = (room == index).astype(np.float64)
        early = week < HOME_WEEKS
        if there[early].mean() < RARE:
            continue
        train = Stretch(name, stamp_s[early], there[early])
        tests = (week == number for number in range(HOME_WEEKS, whole))
        doors[name] = Door(train, tuple(Stretch(name, stamp_s[rows], there[rows]) for rows in tests))
    return doors


@dataclass(frozen=True, slots=True)
class RoomFeature:
    """A landmark of the room.

    Attributes:
        name: its number in the files.
        train, test: looks of both recordings.
        stamp_s: (N,) grid of the test recording.
        present: (N,) the truth there.
    """

    name: str
    train: Looks
    test: Looks
    stamp_s: FloatArray
    present: FloatArray


def read_door(folder: Path, name: str = "door_2016") -> Door:
    """A training file and four weeks.

    Raises:
        InputError: a file is missing or malformed.
    """
    stretches = [_read_stretch(folder, f"{name}_{part}") for part in _door_parts()]
    return Door(stretches[0], tuple(stretches[1:]))


def read_room(folder: Path) -> list[RoomFeature]:
    """All landmarks; the truth of the training recording is not even kept.

    Raises:
        InputError: a file is missing or malformed, or the two know different landmarks.
    """
    train, test = _read_looks(folder, "room_train"), _read_looks(folder, "room_test")
    if list(train) != list(test):
        raise InputError("the two recordings know different landmarks", path=folder, field="feature_id")
    return [
        RoomFeature(name, train[name][0], looks, stamp_s, present) for name, (looks, stamp_s, present) in test.items()
    ]


def _door_parts() -> Iterator[str]:
    yield "train"
    yield from (f"test_{k + 1}" for k in range(DOOR_TESTS))


def _read_stretch(folder: Path, name: str) -> Stretch:
    table = read_columns(_file(folder, name), [])
    table.expect(("stamp_s", "present"))
    stamp_s, present = table.numbers(STAMP_S), table.flags("present", hint=_FLAGS)
    if len(stamp_s) < 2 or np.isnan(present).any() or (np.diff(stamp_s) <= 0.0).any():
        raise InputError("needs rows in order of time, each 1 or 0", path=table.path, field="present")
    return Stretch(name, stamp_s, present)


def _read_looks(folder: Path, name: str) -> dict[str, tuple[Looks, FloatArray, FloatArray]]:
    """Looks, stamps and truth of every landmark."""
    table = read_columns(_file(folder, name), [])
    table.expect(("stamp_s", "feature_id", "detected", "present"))
    stamp_s, detected, present = (
        table.numbers(STAMP_S),
        table.flags("detected", hint=_FLAGS + ", or nothing where there was no look"),
        table.flags("present", hint=_FLAGS),
    )
    if np.isnan(present).any():
        row = int(np.flatnonzero(np.isnan(present))[0])
        raise table.error("is empty", row=row, field="present", hint=_FLAGS)
    names, feature = table.labels("feature_id")
    found = {}
    for index, one in enumerate(names):
        rows = np.flatnonzero(feature == index)
        rows = rows[np.argsort(stamp_s[rows], kind="stable")]
        seen = rows[~np.isnan(detected[rows])]
        looks = Looks.from_rows(np.zeros(len(seen), dtype=np.int64), stamp_s[seen], detected[seen], P_MISS, P_FALSE)
        found[one] = looks, stamp_s[rows], present[rows]
    return found


def _file(folder: Path, name: str) -> Path:
    path = folder / f"{name}.csv.gz"
    if not path.is_file():
        raise InputError("no such file", path=path, hint="--data FOLDER with room_*.csv.gz and door_2016_*.csv.gz")
    return path


def _stream(seed: int, task: Task, number: int) -> np.random.Generator:
    """Random numbers of their own for every task and stretch."""
    return np.random.default_rng([seed, TASKS.index(task), number])


__all__ = [
    "NOISE_SEEDS",
    "TASKS",
    "Door",
    "RoomFeature",
    "Stretch",
    "Task",
    "Trial",
    "read_door",
    "read_home",
    "read_room",
    "trial",
]
