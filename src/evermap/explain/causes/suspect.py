"""What a cause is: the inputs of a session, what undoes it of them, what it costs, and the words for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.slam import mistakes
from evermap.slam.pairs import USUAL
from evermap.types import UNKNOWN, AnyRecording, FloatArray, Landmarks

USUAL_P, RARE_P, UNIT_P = 1e-3, 1e-4, 1e-3
"""Probabilities beforehand of a cause that is met every day in bug reports, of one that is not, and of a unit."""
SCALE = 0.15
"""Standard deviation of the logarithm of all ranges, or of all speeds."""
LITTLE = 0.1
"""Standard deviations beforehand within which a state is as is usual of sensors: 2 cm of a mount, 50 ms of a clock."""


@dataclass(frozen=True, slots=True)
class Inputs:
    """What a session is solved from.

    Attributes:
        recording: with identities, as it is estimated.
        prior_map: that was given; None without.
        stretched: (M,) logarithm of the volume by which each detection's numbers were stretched since they were read.
        stretched_place: the same of a place of the map.
        left_out: places of a map that was left out, of landmarks that were seen.
    """

    recording: AnyRecording
    prior_map: Landmarks | None
    stretched: FloatArray
    stretched_place: float
    left_out: int = 0

    @classmethod
    def of(cls, recording: AnyRecording, prior_map: Landmarks | None) -> Inputs:
        """Return the inputs as given."""
        return cls(recording, prior_map, np.zeros(len(recording.detections)), 0.0)

    @property
    def n_common(self) -> int:
        """Return the number of landmarks of the map whose identities were seen."""
        given = self.prior_map
        return 0 if given is None else int(np.isin(given.landmark_id, self.recording.detections.landmark_id).sum())


Undo = Callable[[Inputs, float], Inputs]


@dataclass(frozen=True, slots=True)
class Suspect:
    """A cause that may be: what it undoes, what it costs, and its words.

    Attributes:
        code: stable name of the kind of cause.
        subject: what it is of: a sensor, a class, an identity, 'odometry', 'map'.
        p: probability beforehand.
        undo: inputs, and the state, to the inputs without it.
        say: the state to one line for the user.
        fix: the state to the line of `sensor.toml`, or the option, that mends it.
        sigma: standard deviation of the state beforehand; 0 of a discrete cause.
        shown: the state as a user reads it: a ratio, seconds, metres, radians.
        of_map: whether it is of the given map.
        pairs: whether it shows in pairs of sightings of one landmark and the odometry between them.
        rows: which detections it is of: those of an 'id', a 'class' or a 'size', or by a 'sensor'; None of all.
        shows: whether the readings alone say so, or nothing else than a solution can.
    """

    code: str
    subject: str
    p: float
    undo: Undo
    say: Callable[[float], str]
    fix: Callable[[float], str]
    sigma: float = 0.0
    shown: Callable[[float], float] = float
    of_map: bool = False
    pairs: bool = True
    rows: tuple[str, float] | None = None
    shows: bool = False

    @property
    def is_continuous(self) -> bool:
        """Return whether it has a state."""
        return self.sigma > 0.0

    @property
    def is_of_landmark(self) -> bool:
        """Whether it is of a single landmark."""
        return self.rows is not None and self.rows[0] == "id"

    @property
    def log_p(self) -> float:
        """Return its price [nats], negative."""
        return math.log(self.p)


def rows_of_kind(recording: AnyRecording, of: tuple[str, float] | None) -> Any:
    """Return (M,) detections of an identity, of a class, by a sensor, or of tags of a size; all for None."""
    seen = recording.detections
    if of is None:
        return np.ones(len(seen), dtype=np.bool_)
    kind, which = of
    if kind == "id":
        return seen.landmark_id == which
    if kind == "class":
        return seen.class_id == which
    if kind == "sensor":
        return seen.sensor == which  # type: ignore[union-attr]
    return np.isclose(seen.tag_size_m, which)  # type: ignore[union-attr]


def list_often_seen(recording: AnyRecording) -> list[int]:
    """Return identities that were seen often enough to ask of each."""
    ids = recording.detections.landmark_id
    name, count = np.unique(ids[ids != UNKNOWN], return_counts=True)
    return [int(one) for one in name[count >= USUAL.fewest // 4]]


def say_always(text: str) -> Callable[[float], str]:
    """Return words of a cause that are the same whatever its state."""
    return lambda _: text


def name_fix(mistake: mistakes.Mistake) -> str:
    """Return where a mistake of the readings is mended: table and column."""
    table = "odometry.csv" if mistake.field.endswith("ps") or mistake.field == "odometry" else "detections.csv"
    return f"{table}: {mistake.field}" if mistake.field else "[mount]"


def round_up(share: float) -> str:
    """Return a standard deviation that covers an error, in one figure."""
    if share <= 0.0:
        return "0.001"
    unit = 10.0 ** math.floor(math.log10(share))
    return f"{math.ceil(share / unit) * unit:.1g}"
