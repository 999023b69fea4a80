"""A session of a living map is asked what it held as stated, as a recording by itself is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evermap.config import Config
from evermap.maps.living import LivingMap
from evermap.maps.sessions.session import without_doubted
from evermap.maps.store import open_store
from evermap.pipeline import run_session
from evermap.runs.replay import enter_again, list_steps
from evermap.runs.sessions import enter_session
from evermap.types import AnyRecording, ChangeKind, Verdict, VerdictKind
from evermap_studies.causes import mistakes as wrong
from evermap_studies.causes.drives import MAKES, Make, as_recording, simulate
from evermap_studies.causes.mistakes import Mistake
from evermap_studies.worlds.parking import Parking

MAKE = replace(MAKES["corners"], duration_s=30.0)
DAY_S = 86400.0


def drive(day: int, mistake: Mistake = wrong.nothing, make: Make = MAKE, happen: Any = None) -> AnyRecording:
    """A drive of a day past the same landmarks, with other noise of its sensor on each, after what happens to them."""
    make = replace(make, duration_s=30.0 + day)
    made = simulate(make, 3, in_map=False)
    if happen is not None:
        made = wrong.identities_stay(
            simulate(make, 3, happen(made, np.random.default_rng(1)), in_map=False), np.random.default_rng()
        )
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


ANY = Config.model_validate({"living": {"accept": "any"}})
LASER = MAKES["laser"]


@pytest.fixture(scope="module")
def lit() -> LivingMap:
    """A map of one drive past poles, in the plane."""
    return run_session(drive(0, make=LASER)).living


def refused_drive(day: int = 1) -> AnyRecording:
    """Two poles were taken away, and ranges are 5 % long."""
    return drive(day, wrong.readings(1.05), LASER, wrong.vanishes(2))


def test_what_does_not_enter_the_map_reports_no_change(lit: LivingMap) -> None:
    right = run_session(drive(1, make=LASER, happen=wrong.vanishes(2)), lit)
    assert [change.kind for change in right.changes] == [ChangeKind.VANISHED] * 2
    assert not right.refusal(Config().living)
    session = run_session(refused_drive(), lit)
    assert session.found
    assert session.slam.verdict is not None
    assert session.refusal(Config().living) == session.slam.verdict.text
    assert "0.95" in session.slam.verdict.message or "range_slope = 0.05" in session.slam.verdict.message
    assert (session.changes, session.slam.changes, session.slam.alternatives) == ((), (), ())
    assert not len(session.slam.gone)
    believed = run_session(refused_drive(), lit, ANY)
    assert not believed.refusal(ANY.living)
    assert believed.changes == believed.slam.changes
    assert [change.landmark_ids for change in believed.changes] == [change.landmark_ids for change in right.changes]
    assert set(believed.slam.gone.landmark_id) == {change.landmark_ids[0] for change in right.changes}


def test_what_a_map_has_not_believed_before_stays_gone(lit: LivingMap) -> None:
    """A session that is refused takes back what it says itself, not what others have said."""
    since = run_session(drive(1, make=LASER, happen=wrong.vanishes(2)), lit)
    refused = run_session(refused_drive(2), since.living)
    assert set(refused.slam.gone.landmark_id) == set(since.slam.gone.landmark_id) != set()
    assert not refused.changes


def test_what_is_set_aside_by_its_own_solution_reports_no_change(lit: LivingMap) -> None:
    """Its result, which is its own, may have found some in the map that was given for that."""
    entered = run_session(refused_drive(), lit, ANY)
    lost = replace(entered, found=False, set_aside=("too few", "another map"))
    kept = without_doubted(lost, lit, ANY.living)
    assert (kept.changes, kept.slam.changes, len(kept.slam.gone)) == ((), (), 0)
    assert kept.refusal(ANY.living) == "too few"


def test_a_session_of_the_map_reports_its_changes_whatever_is_asked_of_new_ones(tmp_path: Path) -> None:
    with open_store(tmp_path / "poles.evermap", create=True) as store:
        for recording in (drive(0, make=LASER), refused_drive()):
            entered = enter_session(store, recording, ANY)
            entered.commit(store, ANY)
        refused = enter_session(store, refused_drive(2))
        assert refused.changes == refused.session.changes == ()
        steps = list_steps(store, store.head())
        again = enter_again(store, steps[1], store.load(1), Config())
        assert [change.landmark_ids for change in again.changes] == [one.landmark_ids for one in entered.changes] != []
