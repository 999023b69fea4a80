"""A living map on duty: hours of driving with everything going wrong. No crash, no nan, no growth, no collapse."""

from __future__ import annotations

import tracemalloc
from contextlib import suppress
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from evermap.cli.bench import load_benchmarks
from evermap.errors import DataError
from evermap.geometry import se2
from evermap.maps.living import LivingMap
from evermap.maps.sessions.session import Session
from evermap.metrics.trajectory import align_points
from evermap.pipeline import run_session
from evermap.types import Recording, rows_of
from evermap_studies.sim import BuildingConfig, DriveConfig, OdometryConfig, SimulatedSensor, simulate_building
from evermap_studies.worlds.faults import FAULTLESS, NOTHING, STRANGER, FaultConfig, StreamFaults, with_faults

LARGEST_FACTOR = 1.5
"""Median pose error with a bad day's faults, over that without any."""
LEAST_SHARE = 0.7
"""Median precision and recall with them, over those without: a session that went wrong bends the map for a while."""


@pytest.fixture(scope="module")
def soak() -> ModuleType:
    load_benchmarks()  # puts the checkout on the path
    import benchmarks.soak

    return benchmarks.soak


@pytest.fixture(scope="module")
def visits() -> tuple[Recording, ...]:
    """Three short patrols of a small building."""
    config = BuildingConfig(
        days=3,
        patrol_s=40.0,
        length_m=12.0,
        rooms_per_side=1,
        change_rate=2.0,
        drive=DriveConfig(truth_hz=20.0),
        odometry=OdometryConfig(rate_hz=10.0),
        sensor=SimulatedSensor(rate_hz=2.0),
    )
    return simulate_building(config, seed=1).sessions


@pytest.fixture(scope="module")
def known(visits: tuple[Recording, ...]) -> Session:
    return run_session(visits[0])


rate = st.sampled_from([0.0, 0.02, 0.2])
per_h = st.sampled_from([0.0, 100.0])
streams = st.builds(
    StreamFaults,
    p_dropped=rate, p_twice=rate, p_late=rate, p_misstamped=rate, p_stamp_garbled=rate, outages_per_h=per_h,
    outage_s=st.sampled_from([2.0, 20.0]), jumps_per_h=per_h, jump_s=st.sampled_from([2.0, 60.0]),
)  # fmt: skip
mixes = st.builds(
    FaultConfig,
    frames=streams, odometry=streams, p_wrong_identity=rate, p_shuffled=rate, p_impossible=rate, freezes_per_h=per_h,
    p_spike=rate, p_odometry_impossible=rate, clock_jumps_per_h=per_h, p_empty=rate,
)  # fmt: skip


@pytest.mark.slow
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(faults=mixes, seed=st.integers(0, 10_000))
def test_whatever_goes_wrong_in_a_session_its_numbers_are_numbers(
    soak: ModuleType, visits: tuple[Recording, ...], known: Session, faults: FaultConfig, seed: int
) -> None:
    """In the map as it was, and from scratch; or the session is refused in one line and the map stays."""
    for living in (known.living, LivingMap()):
        with suppress(DataError):  # nothing can be estimated: no odometry, fewer than two frames
            session = run_session(with_faults(visits[1], faults, seed), living)
            assert list(soak.problems(session)) == []


@pytest.mark.parametrize("n_known", [0, 1])
def test_a_session_that_shows_no_two_places_of_the_map_leaves_it(
    visits: tuple[Recording, ...], known: Session, n_known: int
) -> None:
    """All identities but one are misread: nobody can say where that was."""
    detections = visits[1].detections
    familiar = np.unique(detections.landmark_id)[:n_known]
    misread = np.where(np.isin(detections.landmark_id, familiar), 0, STRANGER) + detections.landmark_id
    session = run_session(replace(visits[1], detections=replace(detections, landmark_id=misread)), known.living)
    np.testing.assert_array_equal(session.living.places.position_m, known.living.places.position_m)
    assert any("map" in warning for warning in session.slam.warnings)


@pytest.mark.slow
def test_a_few_sessions_of_faults_do_not_spoil_the_map(soak: ModuleType) -> None:
    """Quick version of the soak below: fewer sessions, the same demands but for memory."""
    recordings = soak.world(0.2, seed=3)
    faulty, plain = soak.soak(recordings, FaultConfig(), seed=3), soak.soak(recordings)
    assert faulty.defects == plain.defects == []
    assert plain.refused == []
    assert np.nanmedian(faulty.rmse_m) < LARGEST_FACTOR * np.median(plain.rmse_m)
    assert faulty.n_landmarks[-1] < 1.5 * plain.n_landmarks[-1]


@pytest.mark.parametrize("silent_s", [(40.0, 50.0), (25.0, 60.0)])
def test_a_map_begins_with_what_is_sure_of_a_session(soak: ModuleType, silent_s: tuple[float, float]) -> None:
    """The odometry falls silent while the robot drives: nothing of the map may be where that only guesses."""
    recording = soak.world(0.05, seed=1)[0]
    since_s = recording.odometry.stamp_s - recording.odometry.stamp_s[0]
    heard = (since_s < silent_s[0]) | (since_s > silent_s[1])
    landmarks = run_session(replace(recording, odometry=rows_of(recording.odometry, heard))).living.landmarks()
    truth = recording.true_landmarks
    assert truth is not None
    place_m = truth.position_m[np.searchsorted(truth.landmark_id, landmarks.landmark_id)]
    off_m = np.hypot(*(se2.transform(align_points(landmarks.position_m, place_m), landmarks.position_m) - place_m).T)
    assert len(landmarks) > 15
    assert off_m.max() < 0.6


@pytest.mark.slow
def test_the_same_faults_make_the_same_map(visits: tuple[Recording, ...]) -> None:
    def maps() -> list[LivingMap]:
        living, after = LivingMap(), []
        for row, visit in enumerate(visits):
            living = run_session(with_faults(visit, replace(FaultConfig(), p_empty=0.0), row), living).living
            after.append(living)
        return after

    for one, other in zip(maps(), maps(), strict=True):
        assert _bytes_of(one) == _bytes_of(other)


def _bytes_of(value: object) -> bytes:
    """All numbers of nested dataclasses, in order."""
    if isinstance(value, np.ndarray):
        return value.tobytes()
    if isinstance(value, tuple):
        return b"".join(map(_bytes_of, value))
    names = getattr(value, "__dataclass_fields__", None)
    return repr(value).encode() if names is None else b"".join(_bytes_of(getattr(value, name)) for name in names)


def test_defects_are_seen(soak: ModuleType, known: Session) -> None:
    """The checks of the soak themselves: what is put wrong is reported."""
    assert list(soak.problems(known)) == []
    living = known.living
    p_here = living.sites.p_here.copy()
    p_here[0] = 1.5
    skew = living.covariance_m2.copy()
    skew[0, 1] += 1e-3
    negative = living.covariance_m2 - 1.0 * np.eye(len(living.covariance_m2))
    gone = living.places.position_m.copy()
    gone[0, 0] = np.nan
    for wrong, said in (
        (replace(living, sites=replace(living.sites, p_here=p_here)), "not a probability"),
        (replace(living, covariance_m2=skew), "not symmetric"),
        (replace(living, covariance_m2=negative), "not positive semidefinite"),
        (replace(living, places=replace(living.places, position_m=gone)), "not finite"),
    ):
        assert any(said in line for line in soak.problems(replace(known, living=wrong)))


@pytest.mark.slow
def test_sessions_leave_nothing_behind(soak: ModuleType) -> None:
    """All that Python and numpy have allocated, after sessions that bring nothing new: to the map, and else nothing."""
    first, recording = soak.world(0.1, seed=0)[:2]
    living = run_session(first).living
    held = []
    for seed in range(12):
        if seed == 4:
            tracemalloc.start()
        run_session(with_faults(recording, replace(FAULTLESS, frames=NOTHING, p_wrong_identity=0.02), seed), living)
        if seed >= 4:
            held.append(tracemalloc.get_traced_memory()[0] / 1e6)
    tracemalloc.stop()
    assert held[-1] - held[2] < 0.5, held


@pytest.mark.slow
@pytest.mark.experiment
def test_24_hours_of_faults(soak: ModuleType) -> None:
    """480 sessions, 24 hours of driving in ten days, with all faults and without."""
    recordings = soak.world(24.0, seed=0)
    faulty, plain = soak.soak(recordings, FaultConfig()), soak.soak(recordings)
    assert faulty.driven_s > 23.9 * 3600.0
    assert faulty.defects == plain.defects == []
    assert plain.refused == []
    # of a hundred sessions two have no odometry, frames or detections at all
    assert len(faulty.refused) < 0.04 * len(recordings)
    ours, theirs = faulty.summary(), plain.summary()
    assert ours["rmse_median_m"] < LARGEST_FACTOR * theirs["rmse_median_m"]
    assert ours["precision"] > LEAST_SHARE * theirs["precision"]
    assert ours["recall"] > LEAST_SHARE * theirs["recall"]
    # the map grows with what has come and gone, and with strangers; the process grows by no more than that and noise
    assert faulty.growth_mb() < 20.0 + 3e-3 * (faulty.map_kb[-1] - faulty.map_kb[len(recordings) // 4])


def test_lies_of_a_robot(soak: ModuleType, visits: tuple[Recording, ...]) -> None:
    """Each of them changes what it says it does, and no truth."""
    from benchmarks.liars import LIES, lie

    honest, rng = visits[0], np.random.default_rng(0)
    told = {kind: lie(honest, kind, visits[1], rng) for kind in LIES}
    before = honest.detections
    np.testing.assert_array_equal(told["nothing"].detections.range_m, before.range_m)
    np.testing.assert_allclose(told["ranges 10 %"].detections.range_m, 1.1 * before.range_m)
    np.testing.assert_allclose(told["ranges 0.3 m"].detections.range_m, before.range_m + 0.3)
    np.testing.assert_allclose(told["bearings 6 degrees"].detections.bearing_rad, before.bearing_rad + 0.1)
    grown = told["drifts"].detections.range_m / before.range_m
    assert grown[0] < grown[-1] < 1.1
    assert told["sees 2.5 m"].detections.range_m.max() < 2.5
    assert 0.2 < len(told["detects a third"].detections) / len(before) < 0.5
    assert 0.05 < len(told["detects a seventh"].detections) / len(before) < 0.25
    assert 0.1 < np.mean(told["misreads"].detections.landmark_id != before.landmark_id) < 0.2
    assert told["another building"] is visits[1]
