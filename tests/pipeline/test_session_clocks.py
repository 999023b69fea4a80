"""Sessions of one robot whose clocks start anew: they cannot all be true, and enter a map only by the user's word."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import evermap as em
from evermap.config import Config, LivingConfig
from evermap.errors import ConfigError, DataError
from evermap.maps.store import open_store
from evermap.runs.session_clock import shift_stamps, start_at
from evermap.runs.sessions import TwiceError
from evermap.types import UNKNOWN, Clock, Measurements, Recording
from evermap_studies.sim import BuildingConfig, simulate_building

GAP_S = 86_400.0
LAID = Config(living=LivingConfig(clock_gap_s=GAP_S))


def at_zero(recording: Recording) -> Recording:
    shifted = shift_stamps(recording, -float(recording.frames.stamp_s[0]), "at 0")
    return replace(shifted, clock=Clock.RECORDING, warnings=recording.warnings)


SESSIONS = [at_zero(one) for one in simulate_building(BuildingConfig(days=2, patrol_s=35.0), 3).sessions]


def test_overlapping_sessions_of_one_robot_are_refused_or_laid_after_each_other(tmp_path: Path) -> None:
    with open_store(tmp_path / "site.evermap", create=True) as store:
        em.enter_session(store, SESSIONS[0]).commit(store)
        with pytest.raises(
            DataError,
            match=r"overlaps .* --start .* living\.clock_gap_s=SECONDS",
        ):
            em.enter_session(store, SESSIONS[1])
        assert store.head() == 1

        entered = em.enter_session(store, SESSIONS[1], LAID)
        entered.commit(store, LAID)
        first, second = (one.provenance for one in store.log() if one.number in (1, 2))
        if first.stamp_from_s > second.stamp_from_s:
            first, second = second, first
        assert second.stamp_from_s == pytest.approx(first.stamp_to_s + GAP_S)
        assert any("put forward by" in remark for remark in entered.session.recording.warnings)
        assert entered.session.slam.trajectory.stamp_s[0] >= GAP_S
        with pytest.raises(TwiceError):  # whatever its stamps have become
            em.enter_session(store, SESSIONS[1], LAID)


def test_robots_with_names_of_their_own_may_drive_at_once(tmp_path: Path) -> None:
    with open_store(tmp_path / "site.evermap", create=True) as store:
        em.enter_session(store, replace(SESSIONS[0], robot="a")).commit(store)
        em.enter_session(store, replace(SESSIONS[1], robot="b")).commit(store)
        with pytest.raises(DataError, match="overlaps"):
            em.enter_session(store, shift_stamps(replace(SESSIONS[1], robot="a"), 5.0, "later"))


def test_one_robot_is_not_at_two_places_at_once_on_any_clock(tmp_path: Path) -> None:
    first, second = (
        replace(one, robot="a") for one in simulate_building(BuildingConfig(days=2, patrol_s=35.0), 3).sessions
    )
    assert first.clock is Clock.UNIX
    begun_s = [float(one.frames.stamp_s[0]) for one in (first, second)]
    at_once = shift_stamps(second, begun_s[0] - begun_s[1] + 10.0, "at once")
    with open_store(tmp_path / "site.evermap", create=True) as store:
        em.enter_session(store, first).commit(store)
        with pytest.raises(DataError, match="overlaps that of the session"):
            em.enter_session(store, at_once)
        with pytest.raises(DataError, match="overlaps"):  # a gap is laid between clocks that start anew alone
            em.enter_session(store, at_once, LAID)
        em.enter_session(store, replace(at_once, robot="b"))
        em.enter_session(store, second)


@pytest.mark.parametrize("begins_s", [0.0, 5.0e7])
def test_a_clock_that_was_not_set_is_asked_about(tmp_path: Path, begins_s: float) -> None:
    first, second = simulate_building(BuildingConfig(days=2, patrol_s=35.0), 3).sessions
    unset = shift_stamps(second, begins_s - float(second.frames.stamp_s[0]), "unset")
    with open_store(tmp_path / "site.evermap", create=True) as store:
        with pytest.raises(DataError, match="its clock was not set"):
            em.enter_session(store, unset)
        em.enter_session(store, first).commit(store)
        with pytest.raises(DataError, match="its clock was not set"):
            em.enter_session(store, unset)


def test_a_shift_moves_every_stamp_and_nothing_else() -> None:
    later = shift_stamps(SESSIONS[0], 7.0, "later")
    assert later.odometry is not None
    np.testing.assert_allclose(later.odometry.stamp_s - SESSIONS[0].odometry.stamp_s, 7.0)
    np.testing.assert_allclose(later.frames.stamp_s - SESSIONS[0].frames.stamp_s, 7.0)
    assert later.detections is SESSIONS[0].detections


def test_without_a_store_an_overlap_is_a_remark() -> None:
    living = em.run_session(SESSIONS[0]).living
    told = em.run_session(SESSIONS[1], living).recording.warnings
    assert any("overlaps what the map has seen" in remark for remark in told)
    later = shift_stamps(SESSIONS[1], living.stamp_s + 10.0, "later")
    assert not any("overlaps" in remark for remark in em.run_session(later, living).recording.warnings)


def test_the_user_says_when_recordings_on_clocks_of_their_own_began(tmp_path: Path) -> None:
    with open_store(tmp_path / "site.evermap", create=True) as store:
        for session, date in zip(SESSIONS[:2], ("2026-11-28T09:00Z", "2026-11-29T10:30+01:00"), strict=True):
            em.enter_session(store, start_at(session, date)).commit(store)
        spans = sorted(one.provenance.stamp_from_s for one in store.log() if one.number in (1, 2))
        assert store.load(store.head()).clock is Clock.UNIX
    assert spans == pytest.approx([1795856400.0, 1795944600.0])


def test_every_part_of_a_recording_begins_at_the_date_that_is_said() -> None:
    session = SESSIONS[0]
    assert session.truth is not None
    closures = Measurements("closures", np.array([3.0]), {"to_stamp_s": np.array([9.0])}, np.array([UNKNOWN]))
    at = start_at(replace(session, measurements=(closures,)), "1970-01-02T00:00")
    assert at.clock is Clock.LOCAL_WALL
    assert at.truth is not None
    by_s = 86_400.0 - session.frames.stamp_s[0]
    for now, was in ((at.frames, session.frames), (at.odometry, session.odometry), (at.truth, session.truth)):
        np.testing.assert_allclose(now.stamp_s, was.stamp_s + by_s, rtol=0, atol=1e-6)
    assert at.measurements[0].stamp_s == pytest.approx([3.0 + by_s])
    assert at.measurements[0].columns["to_stamp_s"] == pytest.approx([9.0 + by_s])
    with pytest.raises(ConfigError, match="'yesterday' is no date"):
        start_at(session, "yesterday")
