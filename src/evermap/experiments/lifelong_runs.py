"""Contenders, and what each of them makes of the same sessions, one map each."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from evermap.demo.methods import METHODS
from evermap.errors import DataError, NumericalError
from evermap.experiments.lifelong_scores import NOTHING, Row, alignment_of, session_scores
from evermap.experiments.lifelong_world import World

if TYPE_CHECKING:
    from evermap.config import Config
    from evermap.maps.living import LivingMap

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

        return load_config(None, [*overrides, *self.overrides])


def _switched(switches: tuple[tuple[str, str | bool], ...]) -> tuple[str, ...]:
    return tuple(f"living.{name}={str(value).lower()}" for name, value in switches)


CONTENDERS = tuple(Contender(m.label, m.says, _switched(m.switches), m.is_told) for m in METHODS)
"""Static SLAM, each paper's method alone, evermap, and who is told."""
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


def live(
    world: World,
    contender: Contender,
    overrides: tuple[str, ...] = (),
) -> Iterator[Row]:
    """Session after session into one map; a row of plain JSON values each.

    A session that fails leaves the map as it was, and a row with its `failure`.

    Args:
        world: sessions and their truth; the estimator sees no truth.
        contender: who.
        overrides: settings of the world.

    Raises:
        DataError: nothing comes out of the first session.
        KeyboardInterrupt: a session was interrupted.
    """
    from evermap.pipeline import run_session

    config = contender.config(overrides)
    living: LivingMap | None = None
    pose_truth_map = None
    for number, recording in enumerate(world.recordings):
        if contender.is_told and living is not None:
            living = living.without(world.changed(number))
        began = time.process_time()
        try:
            session = run_session(replace(recording, truth=None, true_landmarks=None), living, config)
        except (DataError, NumericalError) as error:
            if living is None:
                raise
            yield {"session": number, **NOTHING, "failure": error.one_line()}
            continue
        cpu_s = time.process_time() - began
        if session.slam.interrupted:
            raise KeyboardInterrupt
        living = session.living
        if pose_truth_map is None:
            pose_truth_map = alignment_of(living, world)
        row = session_scores(session, world, number, pose_truth_map, P_CLAIMED)
        yield {"session": number, **row, "cpu_s": cpu_s}
