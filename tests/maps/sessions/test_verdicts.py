"""A session of a living map is asked what it held as stated, as a recording by itself is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.config import Config
from evermap.maps.living import LivingMap
from evermap.pipeline import run_session
from evermap.types import AnyRecording, Verdict, VerdictKind
from evermap_studies.causes import mistakes as wrong
from evermap_studies.causes.drives import MAKES, as_recording, simulate
from evermap_studies.causes.mistakes import Mistake
from evermap_studies.worlds.parking import Parking

MAKE = replace(MAKES["corners"], duration_s=30.0)
DAY_S = 86400.0


def drive(day: int, mistake: Mistake = wrong.nothing) -> AnyRecording:
    """A drive of a day past the same tags, with other noise of its camera on each."""
    made = simulate(replace(MAKE, duration_s=30.0 + day), 3, in_map=False)
    read = as_recording(mistake(made, np.random.default_rng(1)))
    assert read.odometry is not None
    frames = replace(read.frames, stamp_s=read.frames.stamp_s + day * DAY_S)
    odometry = replace(read.odometry, stamp_s=read.odometry.stamp_s + day * DAY_S)
    return replace(read, frames=frames, odometry=odometry, truth=None)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def living() -> LivingMap:
    first = run_session(drive(0))
    assert held_of(first.slam.verdict) == 0.0
    return first.living


def held_of(verdict: Verdict | None) -> float:
    assert verdict is not None
    return next((one.value for one in verdict.symptoms if one.code == "held"), np.nan)


@pytest.mark.parametrize(
    ("mistake", "line"),
    [
        (wrong.mounted(yaw=0.15), "mounts of all sensors are -0.1"),
        (wrong.sized(1.05), "tags are 0.16"),
    ],
)
def test_what_a_session_held_wrongly_keeps_it_out_of_the_map(living: LivingMap, mistake: Mistake, line: str) -> None:
    """Both were sound, seven and eleven times as far off as with the right statement, and entered by themselves."""
    session = run_session(drive(1, mistake), living)
    verdict = session.slam.verdict
    assert verdict is not None
    assert verdict.kind is VerdictKind.SENSOR_SUSPECT
    assert line in verdict.message


def test_a_right_session_holds_what_is_right(living: LivingMap) -> None:
    session = run_session(drive(1), living)
    assert held_of(session.slam.verdict) == 0.0
    assert session.slam.verdict is not None
    assert session.slam.verdict.kind is VerdictKind.SOUND


def test_nothing_is_asked_where_no_cause_is(living: LivingMap) -> None:
    settings = Config.model_validate({"slam": {"explain": {"on": False}}})
    assert np.isnan(held_of(run_session(drive(1), living, settings).slam.verdict))


def test_traffic_is_not_asked_in_a_map_either() -> None:
    street = Parking.of(3)
    random = np.random.default_rng(3)
    for slot in range(0, len(street.slot), 2):
        street.park(random, slot, -1e6, 1e6)
    session = run_session(street.drive(1, 0.0, (0.0, 0.4)))
    assert session.found
    assert np.isnan(held_of(session.slam.verdict))
