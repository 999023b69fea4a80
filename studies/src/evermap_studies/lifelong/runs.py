"""Contenders, and what each of them makes of the same sessions, one map each."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from evermap.errors import DataError, NumericalError
from evermap_studies.demo.methods import METHODS
from evermap_studies.lifelong.scores import NOTHING, Row, alignment_of, session_scores
from evermap_studies.lifelong.world import World

if TYPE_CHECKING:
    from evermap.config import Config
    from evermap.maps.living import LivingMap
    from evermap.slam.estimate import Solved
    from evermap.types import FloatArray, Recording

P_CLAIMED = 0.5
"""A map claims what it believes in at least this much."""


@dataclass(frozen=True, slots=True)
class Contender:
    """One way to live with a map.

    Attributes:
        name: in tables.
        says: what it is, or what it lacks.
        overrides: of the default configuration, as `section.key=value`.
        is_told: before every session it is told which landmarks changed, and forgets them.
    """

    name: str
    says: str
    overrides: tuple[str, ...] = ()
    is_told: bool = False

    def config(self, overrides: tuple[str, ...] = ()) -> Config:
        """Its settings, after those of the world."""
        from evermap.config import load_config

        return load_config(None, ["living.accept=any", *overrides, *self.overrides])


def _switched(switches: tuple[tuple[str, str | bool], ...]) -> tuple[str, ...]:
    return tuple(f"living.{name}={str(value).lower()}" for name, value in switches)


CONTENDERS = tuple(Contender(m.label, m.says, _switched(m.switches), m.is_told) for m in METHODS)
"""Static SLAM, each paper's method alone, evermap, and the oracle."""
WHOLE = next(contender for contender in CONTENDERS if not contender.overrides)
"""evermap."""
ABLATIONS = (
    WHOLE,
    Contender("one after the other", "no joint search over what moved", ("living.search=gate",)),
    Contender("no misses", "misses say nothing", ("living.misses=false",)),
    Contender("no cliques", "every landmark by itself", ("living.cliques=false",)),
    Contender("no learned lifetimes", "anything is possible", ("living.learn_lifetimes=false",)),
    Contender("no learned sight", "the nominal field of view", ("living.learn_sight=false",)),
    Contender("no sensor calibration", "all readings are believed", ("slam.sensor_model=plain",)),
    Contender("no returns", "gone is for ever", ("living.returns=false",)),
)
"""evermap, and evermap without one of its parts."""
SIMULATED = ("slam.calibration.fix={range_slope = 0.0}",)
"""Settings for simulated worlds: without a length standard no estimator can tell the size of a building."""


@dataclass
class _Life:
    """One contender's map so far; its frame in that of the truth is known from the first session on."""

    contender: Contender
    config: Config
    living: LivingMap
    pose_truth_map: FloatArray | None = None


def live(world: World, contenders: Sequence[Contender], overrides: tuple[str, ...] = ()) -> Iterator[Row]:
    """Session after session into one map each; a row of plain JSON values for every session and contender.

    Sessions are solved alone once for all who agree on how, and brought into each map. One that fails leaves a map as
    it was, and a row with its `failure`. The time of a session is that of both halves.

    Args:
        world: sessions and their truth; the estimator sees no truth.
        contenders: who.
        overrides: settings of the world.

    Raises:
        KeyboardInterrupt: a session was interrupted.
    """
    from evermap.maps.living import LivingMap

    lives = [_Life(who, who.config(overrides), LivingMap(clock=world.recordings[0].clock)) for who in contenders]
    for number, recording in enumerate(world.recordings):
        halves = _Halves(replace(recording, truth=None, true_landmarks=None))
        for life in lives:
            scores = _session(life, halves, world, number)
            yield {"contender": life.contender.name, "session": number, **scores}


def _session(life: _Life, halves: _Halves, world: World, number: int) -> Row:
    from evermap.pipeline import bring_in

    if life.contender.is_told and number:
        life.living = life.living.without(world.changed(number))
    try:
        alone, alone_s = halves.alone(life)
        began = time.process_time()
        session = bring_in(alone, life.living, life.config)
        cpu_s = alone_s + time.process_time() - began
    except (DataError, NumericalError) as error:
        return {**NOTHING, "failure": error.one_line()}
    if session.slam.interrupted:
        raise KeyboardInterrupt
    life.living = session.living
    if life.pose_truth_map is None:
        life.pose_truth_map = alignment_of(life.living, world)
    scores = session_scores(session, world, number, life.pose_truth_map, life.config.living, P_CLAIMED)
    return {**scores, "cpu_s": cpu_s}


class _Halves:
    """A session solved alone, once for every way to do so."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._known: dict[str, tuple[Solved, float]] = {}

    def alone(self, life: _Life) -> tuple[Solved, float]:
        """The session, and processor time that it took [s]."""
        from evermap.pipeline import solve_alone

        key = life.config.slam.model_dump_json()
        if key not in self._known:
            began = time.process_time()
            alone = solve_alone(self._recording, life.living, life.config)
            self._known[key] = alone, time.process_time() - began
        return self._known[key]
