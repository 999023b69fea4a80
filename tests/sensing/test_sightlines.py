"""Lines of sight: the table's laws, the two kinds of lines against other roads to them, and a simulated building."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import beta as beta_distribution
from scipy.stats import binom

from evermap import se2
from evermap.errors import InputError
from evermap.sensing import sightlines
from evermap.sensing.sightlines import MOST_LOOKS, SightLines, nominal_lines
from evermap.sensing.visibility import detection_probability
from evermap.sim.config import BuildingConfig
from evermap.sim.world import simulate_building
from evermap.types import BoolArray, FloatArray, IntArray, Recording


def test_a_key_is_a_pair_of_cells() -> None:
    rng = np.random.default_rng(0)
    for cell_m in (1.0, 0.5):
        table = SightLines.empty(cell_m)
        sensor = rng.uniform(-1e4, 1e4, (2000, 2))
        landmark = sensor + rng.uniform(-30.0, 30.0, (2000, 2))
        sensor, landmark = np.concatenate([sensor] * 2), np.concatenate([landmark] * 2)
        inside = rng.random((2, 2000, 2))  # the same cells, other places in them
        sensor[2000:] = (np.floor(sensor[:2000] / cell_m) + inside[0]) * cell_m
        landmark[2000:] = (np.floor(landmark[:2000] / cell_m) + inside[1]) * cell_m
        cells = np.floor(np.column_stack([sensor, landmark]) / cell_m)
        _, expected = np.unique(cells, axis=0, return_inverse=True)
        _, found = np.unique(table.rows(sensor, landmark), return_inverse=True)
        assert len(set(zip(expected.ravel().tolist(), found.tolist(), strict=True))) == len(np.unique(expected))
        assert len(np.unique(found)) == len(np.unique(expected))


@pytest.mark.parametrize(
    ("sensor", "landmark"), [((np.nan, 0.0), (0.0, 0.0)), ((0.0, 0.0), (np.inf, 0.0)), ((0.0, 0.0), (2e3, 0.0)),
                             ((1e6, 0.0), (1e6, 0.0))]
)  # fmt: skip
def test_places_out_of_reach_are_refused(sensor: tuple[float, float], landmark: tuple[float, float]) -> None:
    places = np.array([(1.0, 2.0), sensor]), np.array([(1.0, 2.0), landmark])
    with pytest.raises(InputError, match="row 1"):
        SightLines.empty().rows(*places)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 60), st.integers(0, 60))
def test_laws_of_the_table(seed: int, before: int, after: int) -> None:
    rng = np.random.default_rng(seed)
    n = before + after
    keys = SightLines.empty().rows(rng.uniform(0.0, 3.0, (n, 2)), rng.uniform(0.0, 6.0, (n, 2)))
    hit, weight = rng.random(n) < 0.5, rng.random(n)
    whole = SightLines.empty().learned(keys, hit, weight)
    first = SightLines.empty().learned(keys[:before], hit[:before], weight[:before])
    frozen = first.hits.copy()
    halves = first.learned(keys[before:], hit[before:], weight[before:])
    np.testing.assert_array_equal(first.hits, frozen)
    np.testing.assert_array_equal(whole.key, halves.key)
    np.testing.assert_allclose(whole.hits, halves.hits, rtol=1e-12)
    np.testing.assert_allclose(whole.looks, halves.looks, rtol=1e-12)
    assert (np.diff(whole.key) > 0).all()
    assert ((whole.hits >= 0.0) & (whole.hits <= whole.looks * (1 + 1e-12)) & (whole.looks <= MOST_LOOKS)).all()

    if n:
        p = rng.uniform(0.2, 0.9, n)
        found = whole.lines(keys, p)
        assert ((found.p_free > 0.0) & (found.p_free < 1.0) & (found.hits > 0.0) & (found.misses > 0.0)).all()
        assert ((found.p_detect > 0.0) & (found.p_detect < 1.0)).all()
        order = rng.permutation(n)
        mixed = whole.lines(keys[order], p[order])
        for there, again in zip(found[:3], mixed[:3], strict=True):
            np.testing.assert_allclose(again, there[order])


def test_old_looks_fade() -> None:
    """A line that was free for long is known to be blocked after as many looks as are remembered."""
    key = SightLines.empty().rows(np.zeros((1, 2)), np.array([[3.0, 0.0]]))
    table = SightLines.empty()
    for hit, n in ((True, 5000), (False, 1000)):
        for _ in range(n):
            table = table.learned(key, np.array([hit]), np.ones(1))
    assert table.looks[0] <= MOST_LOOKS
    assert table.lines(key, np.array([0.8])).p_detect[0] < 0.05


@pytest.mark.parametrize(("hits", "looks"), [(0, 0), (1, 1), (0, 3), (2, 5), (30, 40)])
def test_a_line_is_known_as_integration_over_both_kinds_has_it(hits: int, looks: int) -> None:
    """One line, by integration over both kinds' distributions, with the shares and rates that it is given."""
    table = SightLines.empty()
    key = table.rows(np.zeros((1, 2)), np.array([[3.0, 0.0]]))
    for k in range(looks):
        table = table.learned(key, np.array([k < hits]), np.ones(1))
    kinds = table._kinds(0.8)
    s = sightlines.STRENGTH
    parts = [
        (share, beta_distribution(s * rate, s * (1 - rate)))
        for share, rate in ((kinds.p_free[3], kinds.free[3]), (1 - kinds.p_free[3], kinds.blocked))
    ]

    def moment(k: int) -> FloatArray:
        """Of the rate, unnormalised, by kind; by quantiles, since a density may be infinite at 0."""
        return np.array(
            [
                w * quad(lambda u, d=d: d.ppf(u) ** k * binom.pmf(hits, looks, d.ppf(u)), 0.0, 1.0, limit=400)[0]
                for w, d in parts
            ]
        )

    weight, rate = moment(0), moment(1)
    line = table.lines(key, np.array([0.8]))
    assert line.p_free[0] == pytest.approx(weight[0] / weight.sum(), rel=1e-5)
    assert line.hits[0] / (line.hits[0] + line.misses[0]) == pytest.approx(rate[0] / weight[0], rel=1e-5)
    assert line.hits[0] + line.misses[0] == pytest.approx(looks + s)


def test_both_kinds_are_found() -> None:
    """Of lines that are drawn from the model the shares and rates come out."""
    rng = np.random.default_rng(2)
    n, per_line = 3000, 12
    landmark = np.column_stack([np.full(n, 5.5), np.zeros(n)])
    sensor = np.column_stack([np.zeros(n), np.zeros(n)]) + np.arange(n)[:, None] * [0.0, 1.0]
    key = SightLines.empty().rows(sensor, landmark + sensor)
    free = rng.random(n) < 0.3
    s = sightlines.STRENGTH
    rate = np.where(free, rng.beta(s * 0.7, s * 0.3, n), rng.beta(s * 0.05, s * 0.95, n))
    hit = rng.random((per_line, n)) < rate
    table = SightLines.empty().learned(np.tile(key, per_line), hit.ravel(), np.ones(n * per_line))
    kinds = table._kinds(0.9)
    assert kinds.p_free[5] == pytest.approx(0.3, abs=0.04)
    assert kinds.free[5] == pytest.approx(0.7, abs=0.04)
    assert kinds.blocked == pytest.approx(0.05, abs=0.02)
    # and a line of the same length that was never looked along is expected to be as they are
    line = table.lines(SightLines.empty().rows(np.zeros((1, 2)), np.array([[0.0, 5.2]])), np.array([0.9]))
    assert line.p_detect[0] == pytest.approx(0.3 * 0.7 + 0.7 * 0.05, abs=0.03)


def test_nominal_lines_do_not_learn() -> None:
    lines = nominal_lines(np.array([0.7, 0.2]))
    np.testing.assert_array_equal(lines.p_free, 1.0)
    np.testing.assert_allclose((lines.hits + 100) / (lines.hits + lines.misses + 1000), [0.7, 0.2], rtol=1e-4)


def looks_of(recording: Recording) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, IntArray]:
    """Of a simulated session, from true poses at what truly is there: sensor, landmark, nominal rate, hit, order."""
    landmarks, truth, d = recording.true_landmarks, recording.truth, recording.detections
    assert landmarks is not None
    assert truth is not None
    row = np.clip(np.searchsorted(truth.stamp_s, recording.frames.stamp_s), 0, len(truth) - 1)
    pose = truth.pose_world_robot[row]
    p = detection_probability(pose, landmarks.position_m, recording.sensor)
    hit = np.zeros(p.shape, dtype=np.bool_)
    known = np.isin(d.landmark_id, landmarks.landmark_id)
    hit[d.frame[known], np.searchsorted(landmarks.landmark_id, d.landmark_id[known])] = True
    frame, column = np.nonzero(p >= 0.3 * recording.sensor.p_detect)
    eye = se2.compose(pose, np.asarray(recording.sensor.mount_robot_sensor))[:, :2]
    return eye[frame], landmarks.position_m[column], p[frame, column], hit[frame, column], column


def test_sessions_to_come_are_predicted_better_than_by_the_field_of_view() -> None:
    """In a building with walls that nobody told of: log score and calibration of every session before it is learned.

    Measured for this seed: -0.82 nats a look by the nominal field, of which -0.66 is what the overall rate of hits
    gives; learned -0.64 in the first session, -0.37 in the last.
    """
    simulation = simulate_building(BuildingConfig(), 0)
    table = SightLines.empty()
    score: list[tuple[float, float, float]] = []
    predicted, came = [], []
    for session, recording in enumerate(simulation.sessions):
        sensor, landmark, nominal, hit, _ = looks_of(recording)
        key = table.rows(sensor, landmark)
        p = table.lines(key, nominal).p_detect
        log_score = [np.where(hit, np.log(q), np.log1p(-q)).mean() for q in (nominal, np.full(len(hit), hit.mean()), p)]
        score.append((log_score[0], log_score[1], log_score[2]))
        if session >= 2:
            predicted.append(p)
            came.append(hit)
        table = table.learned(key, hit, np.ones(len(hit)))
    by_field, by_rate, learned = np.array(score).T
    assert (learned > by_field + 0.15).all()
    assert (learned[1:] > by_rate[1:] + 0.1).all()
    assert (learned[-2:] > by_field[-2:] + 0.4).all()
    p, hit = np.concatenate(predicted), np.concatenate(came)
    for low in np.arange(0.0, 1.0, 0.2):
        inside = (p >= low) & (p < low + 0.2)
        assert hit[inside].mean() == pytest.approx(p[inside].mean(), abs=0.1)
    assert len(table) < 4000  # of 28,000 looks
