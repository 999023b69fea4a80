"""Sessions of one robot whose clocks start anew: they cannot all be true, and enter a map only by the user's word."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import evermap as em
from evermap.config import Config, LivingConfig
from evermap.errors import DataError
from evermap.maps.store import open_store
from evermap.runs.session_clock import shift_stamps
from evermap.runs.sessions import TwiceError
from evermap.types import Clock, Recording
from evermap_studies.sim import BuildingConfig, simulate_building

GAP_S = 86_400.0
LAID = Config(living=LivingConfig(clock_gap_s=GAP_S))


def at_zero(recording: Recording) -> Recording:
    shifted = shift_stamps(recording, -float(recording.frames.stamp_s[0]))
    return replace(shifted, clock=Clock.RECORDING, warnings=recording.warnings)


SESSIONS = [at_zero(one) for one in simulate_building(BuildingConfig(days=2, patrol_s=35.0), 3).sessions]


def test_overlapping_sessions_of_one_robot_are_refused_or_laid_after_each_other(tmp_path: Path) -> None:
    with open_store(tmp_path / "site.evermap", create=True) as store:
        em.enter_session(store, SESSIONS[0]).commit(store)
        with pytest.raises(DataError, match=r"overlaps that of the session .* living\.clock_gap_s=SECONDS"):
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
            em.enter_session(store, shift_stamps(replace(SESSIONS[1], robot="a"), 5.0))


def test_one_robot_is_not_at_two_places_at_once_on_any_clock(tmp_path: Path) -> None:
    first, second = (
        replace(one, robot="a") for one in simulate_building(BuildingConfig(days=2, patrol_s=35.0), 3).sessions
    )
    assert first.clock is Clock.UNIX
    begun_s = [float(one.frames.stamp_s[0]) for one in (first, second)]
    at_once = shift_stamps(second, begun_s[0] - begun_s[1] + 10.0)
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
    unset = shift_stamps(second, begins_s - float(second.frames.stamp_s[0]))
    with open_store(tmp_path / "site.evermap", create=True) as store:
        with pytest.raises(DataError, match="its clock was not set"):
            em.enter_session(store, unset)
        em.enter_session(store, first).commit(store)
        with pytest.raises(DataError, match="its clock was not set"):
            em.enter_session(store, unset)


def test_a_shift_moves_every_stamp_and_nothing_else() -> None:
    later = shift_stamps(SESSIONS[0], 7.0)
    assert later.odometry is not None
    np.testing.assert_allclose(later.odometry.stamp_s - SESSIONS[0].odometry.stamp_s, 7.0)
    np.testing.assert_allclose(later.frames.stamp_s - SESSIONS[0].frames.stamp_s, 7.0)
    assert later.detections is SESSIONS[0].detections


def test_without_a_store_an_overlap_is_a_remark() -> None:
    living = em.run_session(SESSIONS[0]).living
    told = em.run_session(SESSIONS[1], living).recording.warnings
    assert any("overlaps what the map has seen" in remark for remark in told)
    later = shift_stamps(SESSIONS[1], living.stamp_s + 10.0)
    assert not any("overlaps" in remark for remark in em.run_session(later, living).recording.warnings)
