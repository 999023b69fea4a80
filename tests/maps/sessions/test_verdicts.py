"""A session of a living map is asked what it held as stated, as a recording by itself is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evermap import pipeline
from evermap.config import Config
from evermap.explain.trial import share_rejected
from evermap.maps.living import LivingMap
from evermap.maps.sessions import solve
from evermap.maps.sessions.session import Session, without_doubted
from evermap.maps.store import open_store
from evermap.pipeline import run_session
from evermap.runs.replay import enter_again, list_steps
from evermap.runs.sessions import TwiceError, enter_session
from evermap.types import AnyRecording, ChangeKind, Verdict, VerdictKind
from evermap_studies.causes import mistakes as wrong
from evermap_studies.causes.drives import MAKES, SITES, Make, as_recording, simulate
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
    assert find_held(first.slam.verdict) == 0.0
    return first.living


def find_held(verdict: Verdict | None) -> float:
    assert verdict is not None
    return next((one.value for one in verdict.symptoms if one.code == "held"), np.nan)


def test_a_session_by_corners_is_as_exact_in_a_map_as_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """What corners are worth in covariances, beside others of their tag, is not what places are estimated with: a tenth
    of the detections of another way past the same tags was rejected, and pixels were 1.7 times as noisy.
    """
    make = MAKES["corners"]
    site = SITES[make.site](np.random.default_rng([0, 99]))
    monkeypatch.setitem(SITES, make.site, lambda _: site)
    first, second = (as_recording(simulate(make, seed, in_map=False)) for seed in (1000, 2000))
    begun, alone = run_session(first), run_session(second)
    entered = run_session(second, begun.living)
    assert share_rejected(entered.slam) <= share_rejected(alone.slam) + 0.002
    assert sigma_px(entered) == pytest.approx(sigma_px(alone), rel=0.03)
    assert np.median(entered.living.covariance_m2.diagonal()) < np.median(begun.living.covariance_m2.diagonal())


def sigma_px(session: Session) -> float:
    return next(one.value for one in session.slam.parameters if one.name == "sigma_corner_px")


def test_late_cameras_are_named_in_a_map_too(living: LivingMap) -> None:
    session = run_session(drive(1, wrong.late(0.15)), living)
    assert [cause.code for cause in session.slam.causes] == ["clock", "clock"]
    assert [cause.value for cause in session.slam.causes] == pytest.approx([0.15, 0.15], abs=0.003)
    assert not session.refusal(Config().living)


@pytest.mark.parametrize(
    ("mistake", "line", "value"),
    [
        (wrong.mounted(yaw=0.15), "mounts of all sensors are -0.1", -0.15),
        (wrong.sized(1.05), "tags are 0.16", 1.0 / 1.05),
    ],
)
@pytest.mark.slow
def test_what_a_session_held_wrongly_keeps_it_out_of_the_map(
    living: LivingMap, mistake: Mistake, line: str, value: float
) -> None:
    """Both were sound, seven and eleven times as far off as with the right statement, and entered by themselves. Now
    the sensor is suspected, and the session is as far off as a right one.
    """
    session = run_session(drive(1, mistake), living)
    (cause,) = session.slam.causes
    assert cause.value == pytest.approx(value, abs=0.003)
    assert cause.probability > 0.99
    assert session.refusal(Config().living)
    assert apart_m(session, run_session(drive(1), living)) < 0.006
    verdict = session.slam.verdict
    assert verdict is not None
    assert verdict.kind is VerdictKind.SENSOR_SUSPECT
    assert line in verdict.message


def test_a_right_session_holds_what_is_right(living: LivingMap) -> None:
    session = run_session(drive(1), living)
    assert find_held(session.slam.verdict) == 0.0
    assert session.slam.verdict is not None
    assert session.slam.verdict.kind is VerdictKind.SOUND


def test_nothing_is_asked_where_no_cause_is(living: LivingMap) -> None:
    settings = Config.model_validate({"slam": {"explain": {"on": False}}})
    assert np.isnan(find_held(run_session(drive(1), living, settings).slam.verdict))


def test_traffic_is_not_asked_in_a_map_either() -> None:
    street = Parking.of(3)
    random = np.random.default_rng(3)
    for slot in range(0, len(street.slot), 2):
        street.park(random, slot, -1e6, 1e6)
    session = run_session(street.drive(1, 0.0, (0.0, 0.4)))
    assert session.found
    assert np.isnan(find_held(session.slam.verdict))


ANY = Config.model_validate({"living": {"accept": "any"}})
LASER = MAKES["laser"]


@pytest.fixture(scope="module")
def lit() -> LivingMap:
    """A map of one drive past poles, in the plane."""
    return run_session(drive(0, make=LASER)).living


def make_refused_drive(day: int = 1) -> AnyRecording:
    """Two poles were taken away, and ranges are 5 % long."""
    return drive(day, wrong.readings(1.05), LASER, wrong.vanishes(2))


@pytest.fixture(scope="module")
def since(lit: LivingMap) -> Session:
    """A drive after two poles were taken away."""
    return run_session(drive(1, make=LASER, happen=wrong.vanishes(2)), lit)


@pytest.fixture(scope="module", name="believed")
def enter_refused_drive(lit: LivingMap) -> Session:
    """The drive that is refused, in a map that takes any."""
    return run_session(make_refused_drive(), lit, ANY)


def test_what_does_not_enter_the_map_reports_no_change(lit: LivingMap, since: Session, believed: Session) -> None:
    right = since
    assert [change.kind for change in right.changes] == [ChangeKind.VANISHED] * 2
    assert not right.refusal(Config().living)
    session = run_session(make_refused_drive(), lit)
    assert session.found
    assert session.slam.verdict is not None
    assert session.refusal(Config().living) == session.slam.verdict.text
    assert "0.95" in session.slam.verdict.message or "range_slope = 0.05" in session.slam.verdict.message
    assert (session.changes, session.slam.changes, session.slam.alternatives) == ((), (), ())
    assert not len(session.slam.gone)
    assert not believed.refusal(ANY.living)
    assert believed.changes == believed.slam.changes
    assert [change.landmark_ids for change in believed.changes] == [change.landmark_ids for change in right.changes]
    assert set(believed.slam.gone.landmark_id) == {change.landmark_ids[0] for change in right.changes}


def test_what_a_map_has_not_believed_before_stays_gone(since: Session) -> None:
    """A session that is refused takes back what it says itself, not what others have said."""
    refused = run_session(make_refused_drive(2), since.living)
    assert set(refused.slam.gone.landmark_id) == set(since.slam.gone.landmark_id) != set()
    assert not refused.changes


def test_what_is_set_aside_by_its_own_solution_reports_no_change(lit: LivingMap, believed: Session) -> None:
    """Its result, which is its own, may have found some in the map that was given for that."""
    lost = replace(believed, found=False, set_aside=("too few", "another map"))
    kept = without_doubted(lost, lit, ANY.living)
    assert (kept.changes, kept.slam.changes, len(kept.slam.gone)) == ((), (), 0)
    assert kept.refusal(ANY.living) == "too few"


def test_a_session_of_the_map_reports_its_changes_whatever_is_asked_of_new_ones(tmp_path: Path) -> None:
    with open_store(tmp_path / "poles.evermap", create=True) as store:
        for recording in (drive(0, make=LASER), make_refused_drive()):
            entered = enter_session(store, recording, ANY)
            entered.commit(store, ANY)
        refused = enter_session(store, make_refused_drive(2))
        assert refused.changes == refused.session.changes == ()
        steps = list_steps(store, store.head())
        again = enter_again(store, steps[1], store.load(1), Config())
        assert [change.landmark_ids for change in again.changes] == [one.landmark_ids for one in entered.changes] != []


def apart_m(one: Session, other: Session) -> float:
    """Root mean square of how far apart two solutions have the robot in the same frames [m]."""
    here, there = (each.slam.trajectory.pose_world_robot[:, :2] for each in (one, other))
    return float(np.sqrt(np.mean(np.sum(np.square(here - there), axis=1))))


@pytest.fixture(scope="module")
def right(lit: LivingMap) -> Session:
    return run_session(drive(1, make=LASER), lit)


def test_a_late_sensor_is_put_right_as_in_a_recording_by_itself(lit: LivingMap, right: Session) -> None:
    """It was 'weak', 7.6 cm off, and kept out: nothing said which of two clocks was right."""
    session = run_session(drive(1, wrong.late(0.1), LASER), lit)
    assert [(cause.code, cause.subject) for cause in session.slam.causes] == [("clock", "sensor")]
    assert session.slam.causes[0].value == pytest.approx(0.1, abs=0.01)
    assert not session.refusal(Config().living)
    assert apart_m(session, right) < 0.01
    delay_s = {state.name: state.value for state in session.slam.parameters}["odometry_delay_s"]
    assert delay_s == pytest.approx(-0.1, abs=0.01)  # of the stamps that were given


def test_a_late_sensor_begins_a_map_as_one_in_time_does() -> None:
    session = run_session(drive(0, wrong.late(0.1), LASER))
    assert [cause.code for cause in session.slam.causes] == ["clock"]
    assert not session.refusal(Config().living)


def test_what_moved_before_a_late_session_is_reported_where_it_is(lit: LivingMap) -> None:
    happen = wrong.moves(1, shift_m=0.5)
    late, in_time = (run_session(drive(1, wrong.late(by_s), LASER, happen), lit) for by_s in (0.1, 0.0))
    (moved,), (expected,) = late.changes, in_time.changes
    assert (moved.kind, moved.landmark_ids) == (expected.kind, expected.landmark_ids)
    assert np.allclose(moved.displacement_m, expected.displacement_m, atol=0.01)


def test_a_right_session_is_asked_for_no_cause(lit: LivingMap, right: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solve, "find_causes", None)
    again = run_session(drive(1, make=LASER), lit)
    assert np.array_equal(again.slam.trajectory.pose_world_robot, right.slam.trajectory.pose_world_robot)


@pytest.mark.parametrize(
    ("of_map", "nats", "told", "is_refused"),
    [(False, np.nan, ["clock"], False), (True, 50.0, ["clock"], True), (True, np.nan, [], True)],
)
def test_a_session_is_entered_anew_for_causes_of_its_own_alone(
    lit: LivingMap, monkeypatch: pytest.MonkeyPatch, of_map: bool, nats: float, told: list[str], is_refused: bool
) -> None:
    """What is wrong with the map is named, and leaves the session as it is, and refused as it is."""
    solved = list[Any]()
    localise = pipeline._localise
    monkeypatch.setattr(pipeline, "_localise", lambda *given: solved.append(given) or localise(*given))
    find = solve.find_causes

    def find_in_map(*given: Any, **more: Any) -> Any:
        found = find(*given, **more)
        (taken,) = found.best.taken
        taken = replace(taken, suspect=replace(taken.suspect, of_map=of_map))
        causes = tuple(replace(cause, nats=nats) for cause in found.causes)
        return replace(found, best=replace(found.best, taken=(taken,)), causes=causes)

    monkeypatch.setattr(solve, "find_causes", find_in_map)
    session = run_session(drive(1, wrong.late(0.1), LASER), lit)
    assert len(solved) == (not of_map)
    assert [cause.code for cause in session.slam.causes] == told
    assert bool(session.refusal(Config().living)) == is_refused


def test_what_was_held_is_suspected(living: LivingMap, lit: LivingMap, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing explains it, the session is refused as it is."""
    asked = list[bool]()
    monkeypatch.setattr(solve, "find_causes", lambda *_, is_suspected: asked.append(is_suspected))
    session = run_session(drive(1, wrong.mounted(yaw=0.15)), living)
    assert find_held(session.slam.verdict) > 0.5
    assert (session.slam.causes, bool(session.refusal(Config().living))) == ((), True)
    run_session(drive(1, wrong.late(0.1), LASER), lit)
    assert asked == [True, False]


def test_a_copy_of_a_late_session_is_in_the_map_already(tmp_path: Path) -> None:
    """Its stamps are put right in the map, and are as given where the session is asked for."""
    late = drive(1, wrong.late(0.1), LASER)
    with open_store(tmp_path / "poles.evermap", create=True) as store:
        for recording in (drive(0, make=LASER), late):
            enter_session(store, recording).commit(store)
        assert store.log()[-1].provenance.stamp_from_s == late.frames.stamp_s[0]
        with pytest.raises(TwiceError, match="has the same frames and readings"):
            enter_session(store, replace(late, name="copy"))
