"""Recordings as a faulty robot would have logged them: what a live system loses, repeats, delays and garbles.

What comes out keeps the *order of arrival* and breaks the contract of `Recording` on purpose: stamps run back and
repeat, values are no numbers, detections stand in frames of every order. `evermap.slam.cleaning.clean` mends that.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np

from evermap.types import UNKNOWN, BoolArray, Detections, FloatArray, Frames, IntArray, Odometry, Recording, rows_of
from evermap_studies.sim.config import require_within

Item = TypeVar("Item")

IMPOSSIBLE: tuple[float, ...] = (math.nan, math.inf, -math.inf, -1.0, 0.0, 1e30, -1e30, 1e9)
"""What stands where a number should be."""
STRANGER: int = 1_000_000
"""Identities from here on belong to nothing: misread codes."""


@dataclass(frozen=True, slots=True)
class StreamFaults:
    """What happens to the messages of one sensor on their way; the defaults are a bad day.

    Attributes:
        p_dropped: probability of a message to be lost.
        p_twice: to arrive twice.
        p_late: to arrive late, after newer ones, by up to `late_s`; its stamp is right.
        p_misstamped: to be stamped when it arrives instead of when it was taken, up to `late_s` after it.
        late_s: largest delay.
        p_stamp_garbled: probability that a stamp is not a number, or any number.
        outages_per_h: mean number of stretches in an hour without any message.
        outage_s: mean length of one, exponential.
        jumps_per_h: mean number of times in an hour that this sensor's clock is set forward or back.
        jump_s: largest step of it, uniform in both directions.
    """

    p_dropped: float = 0.02
    p_twice: float = 0.02
    p_late: float = 0.02
    p_misstamped: float = 0.002
    late_s: float = 2.0
    p_stamp_garbled: float = 0.0005
    outages_per_h: float = 6.0
    outage_s: float = 3.0
    jumps_per_h: float = 3.0
    jump_s: float = 60.0

    def check(self, where: str) -> None:
        """Raise `ConfigError` if a field is out of range."""
        _check(self, where)


@dataclass(frozen=True, slots=True)
class FaultConfig:
    """Everything that goes wrong with a recording; probabilities are independent of each other.

    Attributes:
        frames, odometry: on the way of the two sensors' messages.
        p_wrong_identity: probability that a detection carries the identity of any other landmark of the recording, or,
            in one of five cases, one that belongs to nothing.
        p_shuffled: probability that all identities of a frame are permuted.
        p_impossible: probability that a range or a bearing, each, is one of `IMPOSSIBLE`.
        freezes_per_h: mean number of times in an hour that the sensor repeats its last reading with new stamps.
        freeze_s: mean length of that, exponential.
        p_spike: probability that an odometry row has a velocity of up to `spike_mps` [m/s and rad/s], either sign.
        spike_mps: largest spike.
        p_odometry_impossible: probability that a velocity, each, is one of `IMPOSSIBLE` but 0 and -1.
        clock_jumps_per_h: mean number of times in an hour that the clock of the whole robot is set, by up to
            `clock_jump_s` in both directions.
        clock_jump_s: largest step of it.
        p_empty: probability that odometry, frames or detections, one of them, are missing altogether.
    """

    frames: StreamFaults = field(default_factory=StreamFaults)
    odometry: StreamFaults = field(default_factory=StreamFaults)
    p_wrong_identity: float = 0.02
    p_shuffled: float = 0.01
    p_impossible: float = 0.005
    freezes_per_h: float = 6.0
    freeze_s: float = 2.0
    p_spike: float = 0.002
    spike_mps: float = 30.0
    p_odometry_impossible: float = 0.002
    clock_jumps_per_h: float = 3.0
    clock_jump_s: float = 60.0
    p_empty: float = 0.02

    def check(self) -> None:
        """Raise `ConfigError` if a field is out of range."""
        _check(self, "")
        self.frames.check("frames")
        self.odometry.check("odometry")


NOTHING = StreamFaults(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""All messages arrive, once and in order."""
FAULTLESS = FaultConfig(NOTHING, NOTHING, *(0.0,) * 11)
"""Nothing goes wrong; to be `replace`d in part."""


class Arrivals(NamedTuple):
    """Messages in the order of their arrival.

    Attributes:
        row: (A,) which message, some never, some twice.
        stamp_s: (A,) what is stamped on it.
    """

    row: IntArray
    stamp_s: FloatArray


class ClockSteps(NamedTuple):
    """A clock that is set forward (+) or back (-), by `by_s` (K,) at `at_s` (K,)."""

    at_s: FloatArray
    by_s: FloatArray

    def error_s(self, stamp_s: FloatArray) -> FloatArray:
        """(N,) by how much the clock is wrong at stamps (N,)."""
        error: FloatArray = np.where(stamp_s[:, None] >= self.at_s, self.by_s, 0.0).sum(axis=1)
        return error

    @classmethod
    def drawn(cls, stamp_s: FloatArray, per_h: float, largest_s: float, rng: np.random.Generator) -> ClockSteps:
        """At random instants between the first and the last stamp, uniform within `largest_s`."""
        at_s = _instants(stamp_s, per_h, rng)
        return cls(at_s, rng.uniform(-largest_s, largest_s, len(at_s)))


RIGHT = ClockSteps(np.zeros(0), np.zeros(0))
"""A clock that nobody sets."""


def arrivals(
    stamp_s: FloatArray, faults: StreamFaults, rng: np.random.Generator, clock: ClockSteps = RIGHT
) -> Arrivals:
    """Which messages arrive, in which order, and with what stamps.

    Args:
        stamp_s: (N,) when they were taken, increasing.
        faults: what happens on the way.
        rng: of the faults.
        clock: of the whole robot; the sensor's own steps come on top.
    """
    count = len(stamp_s)
    chance = rng.random((5, count))
    delay = rng.uniform(0.0, faults.late_s, count)
    own_clock = ClockSteps.drawn(stamp_s, faults.jumps_per_h, faults.jump_s, rng)
    stamps = stamp_s + own_clock.error_s(stamp_s) + clock.error_s(stamp_s)
    lost = (chance[0] < faults.p_dropped) | within(stamp_s, faults.outages_per_h, faults.outage_s, rng)
    misstamped = chance[3] < faults.p_misstamped
    late = misstamped | (chance[2] < faults.p_late)
    stamps = np.where(misstamped, stamps + delay, stamps)
    garbled = chance[4] < faults.p_stamp_garbled
    stamps[garbled] = rng.choice([*IMPOSSIBLE, 0.5 * float(stamp_s[-1]) if count else 0.0], int(garbled.sum()))
    row = np.repeat(np.arange(count), np.where(lost, 0, np.where(chance[1] < faults.p_twice, 2, 1)))
    order = np.argsort((stamp_s + np.where(late, delay, 0.0))[row], kind="stable")
    return Arrivals(row[order], stamps[row[order]])


def faulty_stream(
    messages: Iterable[tuple[float, Item]], faults: StreamFaults, seed: int
) -> Iterator[tuple[float, Item]]:
    """Messages `(stamp_s, content)` in the order and with the stamps in which they arrive.

    Args:
        messages: by increasing stamp; all of them are taken first.
        faults: what happens on the way.
        seed: same seed, same faults.

    Raises:
        ConfigError: a field of `faults` is out of range.
    """
    faults.check("faults")
    sent = list(messages)
    arrived = arrivals(np.array([stamp for stamp, _ in sent]), faults, np.random.default_rng(seed))
    for row, stamp in zip(arrived.row.tolist(), arrived.stamp_s.tolist(), strict=True):
        yield stamp, sent[row][1]


def with_faults(recording: Recording, config: FaultConfig | None = None, seed: int = 0) -> Recording:
    """The recording as a faulty robot would have logged it, in the order of arrival.

    Args:
        recording: what happened; its truth stays as it is, on the true clock.
        config: rates and sizes; the default is a bad day.
        seed: same seed, same faults. Each kind of fault has its own stream of random numbers.

    Raises:
        ConfigError: a field is out of range.
    """
    config = config or FaultConfig()
    config.check()
    frame_rng, odometry_rng, reading_rng, clock_rng, empty_rng = (
        np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(5)
    )
    clock = ClockSteps.drawn(recording.odometry.stamp_s, config.clock_jumps_per_h, config.clock_jump_s, clock_rng)
    frames, detections = _faulty_frames(recording, config, frame_rng, reading_rng, clock)
    odometry = _faulty_odometry(recording.odometry, config, odometry_rng, clock)
    missing = ("odometry", "frames", "detections")[int(empty_rng.integers(3))]
    if empty_rng.random() < config.p_empty:
        if missing == "odometry":
            odometry = rows_of(odometry, np.zeros(0, dtype=np.int64))
        if missing == "frames":
            frames = replace(frames, stamp_s=np.zeros(0))
        if missing != "odometry":
            detections = rows_of(detections, np.zeros(0, dtype=np.int64))
    return replace(recording, odometry=odometry, frames=frames, detections=detections)


def within(stamp_s: FloatArray, per_h: float, mean_s: float, rng: np.random.Generator) -> BoolArray:
    """(N,) mask of stamps in stretches that begin at random, `per_h` an hour, with exponential lengths."""
    inside = np.zeros(len(stamp_s), dtype=np.bool_)
    for start in _instants(stamp_s, per_h, rng):
        inside |= (stamp_s >= start) & (stamp_s < start + rng.exponential(mean_s))
    return inside


def _instants(stamp_s: FloatArray, per_h: float, rng: np.random.Generator) -> FloatArray:
    """Random instants between the first and the last stamp."""
    if len(stamp_s) == 0:
        return np.zeros(0)
    return rng.uniform(stamp_s[0], stamp_s[-1], rng.poisson(per_h * float(stamp_s[-1] - stamp_s[0]) / 3600.0))


def _faulty_frames(
    recording: Recording,
    config: FaultConfig,
    rng: np.random.Generator,
    reading_rng: np.random.Generator,
    clock: ClockSteps,
) -> tuple[Frames, Detections]:
    """The sensor freezes and misreads, then its messages go through the stream."""
    frames, detections = recording.frames, recording.detections
    frozen = within(frames.stamp_s, config.freezes_per_h, config.freeze_s, reading_rng)
    # a frozen frame shows what the last frame showed that was not
    shown = np.maximum.accumulate(np.where(frozen, 0, np.arange(len(frames)))) if len(frames) else np.zeros(0, np.int64)
    detections = _misread(detections, config, reading_rng)
    arrived = arrivals(frames.stamp_s, config.frames, rng, clock)
    first = np.searchsorted(detections.frame, np.arange(len(frames) + 1))
    source = shown[arrived.row]
    length = first[source + 1] - first[source]
    frame = np.repeat(np.arange(len(source)), length)
    within_frame = np.arange(len(frame)) - np.repeat(np.cumsum(length) - length, length)
    seen = rows_of(detections, np.repeat(first[source], length) + within_frame)
    return replace(frames, stamp_s=arrived.stamp_s), replace(seen, frame=frame.astype(np.int64))


def _misread(detections: Detections, config: FaultConfig, rng: np.random.Generator) -> Detections:
    """Identities and values that are wrong."""
    count = len(detections)
    if count == 0:
        return detections
    known = np.unique(detections.landmark_id[detections.landmark_id != UNKNOWN])
    identity = detections.landmark_id.copy()
    wrong = (rng.random(count) < config.p_wrong_identity) & (len(known) > 0)
    strange = rng.random(count) < 0.2
    other = rng.choice(known, count) if len(known) else np.zeros(count, dtype=np.int64)
    identity[wrong] = np.where(strange, STRANGER + rng.integers(1_000_000, size=count), other)[wrong]
    frames = np.unique(detections.frame)
    for frame in frames[rng.random(len(frames)) < config.p_shuffled]:
        rows = np.flatnonzero(detections.frame == frame)
        identity[rows] = rng.permutation(identity[rows])
    return replace(
        detections,
        landmark_id=identity,
        range_m=_garbled(detections.range_m, config.p_impossible, IMPOSSIBLE, rng),
        bearing_rad=_garbled(detections.bearing_rad, config.p_impossible, IMPOSSIBLE, rng),
    )


def _faulty_odometry(odometry: Odometry, config: FaultConfig, rng: np.random.Generator, clock: ClockSteps) -> Odometry:
    """Encoders spike and garble, then their messages go through the stream."""
    wild = tuple(value for value in IMPOSSIBLE if value not in (0.0, -1.0))
    columns: dict[str, Any] = {}
    for name in ("forward_mps", "lateral_mps", "angular_radps"):
        column = getattr(odometry, name)
        spike = (rng.random(len(column)) < config.p_spike) & (name != "lateral_mps")
        column = np.where(spike, rng.uniform(-config.spike_mps, config.spike_mps, len(column)), column)
        columns[name] = _garbled(column, config.p_odometry_impossible, wild, rng)
    arrived = arrivals(odometry.stamp_s, config.odometry, rng, clock)
    return replace(rows_of(replace(odometry, **columns), arrived.row), stamp_s=arrived.stamp_s)


def _garbled(values: FloatArray, p: float, by: tuple[float, ...], rng: np.random.Generator) -> FloatArray:
    return np.where(rng.random(len(values)) < p, rng.choice(by, len(values)), values)


def _check(config: StreamFaults | FaultConfig, where: str) -> None:
    """Probabilities lie in [0, 1]; rates and sizes are finite and not negative."""
    for item in fields(config):
        value = getattr(config, item.name)
        if isinstance(value, StreamFaults):
            continue
        name = f"{where}.{item.name}" if where else item.name
        require_within(value, name, 0.0, 1.0 if item.name.startswith("p_") else 1e6)
