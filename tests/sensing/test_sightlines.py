"""Lines of sight and views: the tables' laws, the kinds of lines against other roads to them, a simulated building."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import betabinom

from evermap.config import SightConfig
from evermap.errors import InputError
from evermap.geometry import se2
from evermap.sensing.sightlines import (
    HEADINGS,
    Glimpses,
    SightLines,
    Views,
    nominal_lines,
    offsets,
    session_rate,
)
from evermap.sensing.visibility import NominalField
from evermap.types import BoolArray, FloatArray, IntArray, Recording
from evermap_studies.sim.config import BuildingConfig
from evermap_studies.sim.world import simulate_building

RULES = SightConfig()
BLOCKED, HIDDEN_LOOKS, MOST_LOOKS = RULES.p_blocked_detect, RULES.hidden_looks, RULES.most_looks
MOST_SESSIONS, NEIGHBOUR, STRENGTH = RULES.most_sessions, RULES.neighbour, RULES.strength
P_HIDDEN = np.array(RULES.p_hidden)

PLACES = np.array([2, 2, 3, 7], dtype=np.int64), np.array([10, 11, 12, 10], dtype=np.int64)
"""Sites and landmarks of the places of a map."""
ONE = np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64)
seeds = st.integers(0, 10**6)


def cells_of(offset_m: FloatArray, cell_m: float = 0.5) -> IntArray:
    """Cells of sensors that stand so far from their places."""
    return SightLines.empty(cell_m).cells(offset_m, np.zeros_like(offset_m))


def looked_along(table: SightLines, hits: int, looks: int, offset_m: tuple[float, float] = (3.2, 0.2)) -> SightLines:
    """After looks at the only place of a map."""
    cell = np.repeat(cells_of(np.array([offset_m])), looks)
    return table.learned(ONE, np.zeros(looks, np.int64), cell, np.arange(looks) < hits, np.ones(looks))


def random_looks(
    rng: np.random.Generator, n: int, reach_m: float = 2.0
) -> tuple[IntArray, IntArray, BoolArray, FloatArray]:
    """Places, cells, hits and weights."""
    place = rng.integers(0, len(PLACES[0]), n)
    return place, cells_of(rng.uniform(-reach_m, reach_m, (n, 2))), rng.random(n) < 0.5, rng.uniform(0.01, 1.0, n)


def counts(table: SightLines) -> dict[tuple[int, int, int], tuple[float, float]]:
    """Hits and looks by site, landmark and cell."""
    rows = zip(
        *(getattr(table, name).tolist() for name in ("site_id", "landmark_id", "cell", "hits", "looks")), strict=True
    )
    return {(site, name, cell): (hits, looks) for site, name, cell, hits, looks in rows}


@pytest.mark.parametrize("cell_m", [1.0, 0.5])
def test_a_cell_is_a_square_of_the_floor_counted_from_the_place(cell_m: float) -> None:
    rng = np.random.default_rng(0)
    place = rng.uniform(-1e4, 1e4, (2000, 2))
    square = rng.integers(-40, 40, (2000, 2))
    square = np.concatenate([square] * 2)  # the same squares, other points in them
    sensor = np.concatenate([place] * 2) + (square + rng.uniform(0.01, 0.99, square.shape)) * cell_m
    found = SightLines.empty(cell_m).cells(sensor, np.concatenate([place] * 2))
    pairs = set(zip(map(tuple, square.tolist()), found.tolist(), strict=True))
    assert len(pairs) == len(np.unique(square, axis=0)) == len(np.unique(found))
    np.testing.assert_allclose(offsets(found, cell_m), (square + 0.5) * cell_m)


@pytest.mark.parametrize(
    ("sensor", "place"), [((np.nan, 0.0), (0.0, 0.0)), ((0.0, 0.0), (np.inf, 0.0)), ((0.0, 0.0), (2e3, 0.0))]
)
def test_places_out_of_reach_are_refused(sensor: tuple[float, float], place: tuple[float, float]) -> None:
    pairs = np.array([(1.0, 2.0), sensor]), np.array([(1.0, 2.0), place])
    with pytest.raises(InputError, match="row 1"):
        SightLines.empty().cells(*pairs)


@given(seeds, st.floats(-900.0, 900.0), st.floats(-900.0, 900.0))
def test_a_map_that_is_shifted_as_a_whole_keeps_its_lines(seed: int, x_m: float, y_m: float) -> None:
    rng = np.random.default_rng(seed)
    place_m = rng.uniform(-20, 20, (len(PLACES[0]), 2))
    place, _, hit, weight = random_looks(rng, 40)
    away = (rng.integers(-8, 8, (40, 2)) + rng.uniform(0.01, 0.99, (40, 2))) * 0.5
    tables = [
        SightLines.empty().learned(PLACES, place, SightLines.empty().cells(at[place] + away, at[place]), hit, weight)
        for at in (place_m, place_m + (x_m, y_m))
    ]
    assert counts(tables[0]) == counts(tables[1])


@given(seeds, st.integers(0, 60), st.integers(0, 60))
def test_halves_one_after_the_other_are_the_whole_and_all_is_counted(seed: int, before: int, after: int) -> None:
    rng = np.random.default_rng(seed)
    place, cell, hit, weight = random_looks(rng, before + after)
    whole = SightLines.empty().learned(PLACES, place, cell, hit, weight)
    first = SightLines.empty().learned(PLACES, place[:before], cell[:before], hit[:before], weight[:before])
    frozen = first.hits.copy()
    halves = first.learned(PLACES, place[before:], cell[before:], hit[before:], weight[before:])
    np.testing.assert_array_equal(first.hits, frozen)

    hits, looks = Counter[tuple[int, int, int]](), Counter[tuple[int, int, int]]()
    for p, c, h, w in zip(place.tolist(), cell.tolist(), hit.tolist(), weight.tolist(), strict=True):
        line = int(PLACES[0][p]), int(PLACES[1][p]), c
        hits[line] += w * h
        looks[line] += w
    for table in (whole, halves):
        found = counts(table)
        assert list(found) == sorted(looks)
        for line, told in found.items():
            assert told == pytest.approx((hits[line], looks[line]), rel=1e-9, abs=1e-12)


@given(seeds, st.integers(1, 60))
def test_the_order_of_looks_and_of_lines_does_not_matter(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    place, cell, hit, weight = random_looks(rng, n)
    order = rng.permutation(n)
    one = SightLines.empty().learned(PLACES, place, cell, hit, weight)
    other = SightLines.empty().learned(PLACES, place[order], cell[order], hit[order], weight[order])
    assert list(counts(one)) == list(counts(other))
    np.testing.assert_allclose([*counts(one).values()], [*counts(other).values()], rtol=1e-9)
    nominal = rng.uniform(0.2, 0.9, n)
    lines, p_clear, seen = one.lines(PLACES, place, cell, nominal)
    mixed, mixed_clear, mixed_seen = one.lines(PLACES, place[order], cell[order], nominal[order])
    np.testing.assert_allclose(mixed_clear, p_clear[order])
    np.testing.assert_array_equal(mixed_seen, seen[order])
    np.testing.assert_allclose(mixed.p_detect, lines.p_detect[order])


@given(seeds, st.integers(1, 60))
def test_names_of_sites_mean_nothing_and_lines_to_what_is_no_more_are_left_out(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    place, cell, hit, weight = random_looks(rng, n)
    table = SightLines.empty().learned(PLACES, place, cell, hit, weight)
    kept = np.flatnonzero(rng.random(len(PLACES[0])) < 0.6)
    fewer = PLACES[0][kept], PLACES[1][kept]
    none = np.zeros(0, dtype=np.int64)
    after = table.learned(fewer, none, none, np.zeros(0, np.bool_), np.zeros(0))
    names = set(zip(*(column.tolist() for column in fewer), strict=True))
    assert counts(after) == {line: told for line, told in counts(table).items() if line[:2] in names}


def test_old_looks_fade() -> None:
    """A line that was clear for long is known to be blocked after as many looks as are remembered."""
    table = looked_along(SightLines.empty(), 5000, 5000)
    assert (table.hits[0], table.looks[0]) == (MOST_LOOKS, MOST_LOOKS)
    for _ in range(1000):
        table = looked_along(table, 0, 1)
    # each look takes one part in MOST_LOOKS + 1 of what was known
    assert table.hits[0] == pytest.approx(MOST_LOOKS * (MOST_LOOKS / (MOST_LOOKS + 1.0)) ** 1000)
    lines, p_clear, _ = table.lines(ONE, np.zeros(1, np.int64), table.cell, np.array([0.8]))
    assert p_clear[0] < 0.05
    assert lines.p_detect[0] < 0.05


@given(seeds, st.integers(0, 30), st.floats(0.2, 0.95))
def test_lines_are_what_the_beta_binomial_says(seed: int, n: int, nominal: float) -> None:
    """Counts of a line and of the eight around it, each look a whole one; the kinds' rates as they were learned."""
    rng = np.random.default_rng(seed)
    square = rng.integers(4, 8, (n, 2))
    cell = cells_of((square + 0.5) * 0.5)
    hit = rng.random(n) < rng.choice([0.05, 0.8])
    table = SightLines.empty().learned(ONE, np.zeros(n, np.int64), cell, hit, np.ones(n))
    asked = rng.integers(3, 9, (5, 2))
    lines, p_clear, seen = table.lines(ONE, np.zeros(5, np.int64), cells_of((asked + 0.5) * 0.5), np.full(5, nominal))
    rate, share = table._kinds(nominal)
    for k, at in enumerate(asked):
        gap = np.abs(square - at).max(axis=1) if n else np.zeros(0)
        worth = np.where(gap == 0, 1.0, np.where(gap == 1, NEIGHBOUR, 0.0))
        hits, misses = float(worth @ hit), float(worth @ ~hit)
        free = rate[round(float(np.hypot(*(at + 0.5))))]
        # beta functions for numbers of looks that are no integers; compared with scipy's law where they are
        posterior = share * _beta_binomial(hits, misses, free)
        posterior /= posterior + (1.0 - share) * _beta_binomial(hits, misses, BLOCKED)
        assert p_clear[k] == pytest.approx(posterior, rel=1e-9, abs=1e-12)
        assert seen[k] == (hits > 0.0)
        assert lines.hits[k] == pytest.approx(hits + STRENGTH * free)
        assert lines.misses[k] == pytest.approx(misses + STRENGTH * (1.0 - free))
        assert lines.p_detect[k] == pytest.approx((hits + STRENGTH * free) / (hits + misses + STRENGTH))


def _beta_binomial(hits: float, misses: float, rate: float) -> float:
    from scipy.special import beta

    a, b = STRENGTH * rate, STRENGTH * (1.0 - rate)
    return float(beta(a + hits, b + misses) / beta(a, b))


@pytest.mark.parametrize(("hits", "looks"), [(0, 0), (1, 1), (0, 3), (2, 5), (30, 40)])
def test_a_single_line_is_as_scipy_has_it(hits: int, looks: int) -> None:
    table = looked_along(SightLines.empty(), hits, looks)
    rate, share = table._kinds(0.8)
    cell = cells_of(np.array([(3.2, 0.2)]))
    length = round(float(np.hypot(6.5, 0.5)))
    of_kind = [betabinom.pmf(hits, looks, STRENGTH * r, STRENGTH * (1.0 - r)) for r in (rate[length], BLOCKED)]
    _, p_clear, _ = table.lines(ONE, np.zeros(1, np.int64), cell, np.array([0.8]))
    assert p_clear[0] == pytest.approx(share * of_kind[0] / (share * of_kind[0] + (1.0 - share) * of_kind[1]), rel=1e-9)


@given(seeds, st.integers(0, 40), st.floats(0.05, 0.99))
def test_a_line_along_and_around_which_nothing_was_seen_is_never_known_to_be_clear(
    seed: int, n: int, nominal: float
) -> None:
    rng = np.random.default_rng(seed)
    place, cell, hit, weight = random_looks(rng, n)
    table = SightLines.empty().learned(PLACES, place, cell, hit, weight)
    square = rng.integers(-6, 6, (40, 2))
    asked = rng.integers(0, len(PLACES[0]), 40)
    _, p_clear, seen = table.lines(PLACES, asked, cells_of((square + 0.5) * 0.5), np.full(40, nominal))
    of_hits = np.column_stack([place, np.floor(offsets(cell, 0.5) / 0.5)])[hit].tolist()
    near = {(int(p), int(x) + dx, int(y) + dy) for p, x, y in of_hits for dx in (-1, 0, 1) for dy in (-1, 0, 1)}
    np.testing.assert_array_equal(
        seen, [(p, *at) in near for p, at in zip(asked.tolist(), square.tolist(), strict=True)]
    )
    assert ((p_clear > 0.0) & (p_clear < 1.0)).all()
    none, p_unknown, never = SightLines.empty().lines(PLACES, asked, cells_of(square + 0.5), np.full(40, nominal))
    np.testing.assert_allclose(p_unknown, 0.5)  # not clear, not blocked: unknown
    assert not never.any()
    np.testing.assert_array_equal(none.p_free, 1.0)


def test_both_kinds_are_found() -> None:
    """Of lines that are drawn from the model the share and the rates come out."""
    rng = np.random.default_rng(2)
    n, per_line = 3000, 12
    places = np.arange(n), np.arange(n)  # one line to each: no neighbours
    cell = cells_of(np.full((n, 2), (2.7, 0.2)))
    free = rng.random(n) < 0.3
    rate = np.where(
        free,
        rng.beta(STRENGTH * 0.7, STRENGTH * 0.3, n),
        rng.beta(STRENGTH * BLOCKED, STRENGTH * (1.0 - BLOCKED), n),
    )
    hit = rng.random((per_line, n)) < rate
    table = SightLines.empty().learned(
        places, np.tile(np.arange(n), per_line), np.tile(cell, per_line), hit.ravel(), np.ones(n * per_line)
    )
    clear, share = table._kinds(0.9)
    assert share == pytest.approx(0.3, abs=0.04)
    assert clear[6] == pytest.approx(0.7, abs=0.04)  # cells (5, 0): between middles 5.5 and a half
    # and a line of the same length to a new place is clear as often, and then shows as much
    lines, p_clear, _ = table.lines(ONE, ONE[0], cells_of(np.array([[0.2, 2.7]])), np.array([0.9]))
    assert p_clear[0] == pytest.approx(0.3, abs=0.04)
    assert lines.p_detect[0] == pytest.approx(0.7, abs=0.04)


def test_nominal_lines_do_not_learn() -> None:
    lines = nominal_lines(np.array([0.7, 0.2]))
    np.testing.assert_array_equal(lines.p_free, 1.0)
    np.testing.assert_allclose((lines.hits + 100) / (lines.hits + lines.misses + 1000), [0.7, 0.2], rtol=1e-4)


@given(seeds, st.integers(1, 12))
def test_how_often_places_are_hidden_is_a_beta_mean_of_what_was_counted(seed: int, sessions: int) -> None:
    rng = np.random.default_rng(seed)
    table, hidden, shown = SightLines.empty(), np.zeros(3), np.zeros(3)
    for _ in range(sessions):
        one, other = rng.uniform(0.0, 5.0, (2, 3))
        table = table.after_session(one, other)
        hidden, shown = hidden + one, shown + other
    expected = (HIDDEN_LOOKS * P_HIDDEN + hidden) / (HIDDEN_LOOKS + hidden + shown)
    np.testing.assert_allclose(table.p_hidden, expected)
    np.testing.assert_allclose(SightLines.empty().p_hidden, P_HIDDEN)
    # looks keep it
    after = looked_along(table, 3, 5)
    np.testing.assert_array_equal(after.p_hidden, table.p_hidden)


@pytest.mark.parametrize("rate", [0.15, 0.5, 1.0, 1.5])
def test_the_rate_of_a_session_is_found(rate: float) -> None:
    """To 5 %, whatever the lines' own rates are; at most 1."""
    rng = np.random.default_rng(4)
    p_detect = rng.uniform(0.2, 0.6, 40_000)
    hit = rng.random(40_000) < rate * p_detect
    assert session_rate(hit, p_detect, np.ones(40_000)) == pytest.approx(min(rate, 1.0), rel=0.05)


@given(seed=seeds, n=st.integers(0, 40))
def test_the_rate_of_a_session_is_the_mean_over_spike_and_slab(seed: int, n: int) -> None:
    """By quadrature over the log of the factor, each look by itself."""
    rng = np.random.default_rng(seed)
    p_detect, hit = (rng.integers(0, 100, n) + 0.5) / 100.0, rng.random(n) < 0.3
    weight = rng.random(n)

    def likelihood(factor: FloatArray) -> FloatArray:
        p = np.minimum(factor[:, None] * p_detect, RULES.highest_rate)
        return np.asarray(np.prod(np.where(hit, p, 1.0 - p) ** weight, axis=1))

    log = np.arange(-4.0, 0.0001, 0.01)
    prior = np.exp(-0.5 * (log / RULES.rate_sigma) ** 2)
    slab = likelihood(np.exp(log)) * prior / prior.sum()
    spike = float(likelihood(np.ones(1))[0])
    expected = (spike + np.exp(log) @ slab) / (spike + slab.sum()) if n else 1.0
    assert session_rate(hit, p_detect, weight) == pytest.approx(expected, rel=1e-9)
    assert session_rate(hit, p_detect, weight, SightConfig(rate_sigma=0.0)) == 1.0


def test_a_session_that_detects_little_teaches_the_same_rate_of_a_line() -> None:
    """A third of the detections over a third of the looks; and it is predicted with a third of the rate."""
    rng = np.random.default_rng(1)
    row, cell = np.zeros(900, dtype=np.int64), np.full(900, cells_of(np.array([[1.0, 0.0]]))[0])
    usual = SightLines.empty().learned(ONE, row, cell, rng.random(900) < 0.9, np.ones(900))
    poor = SightLines.empty().learned(ONE, row, cell, rng.random(900) < 0.3, np.ones(900), 1.0 / 3.0)
    one = np.zeros(1, dtype=np.int64), cell[:1], np.array([0.9])
    rates = [lines.lines(ONE, *one)[0].p_detect[0] for lines in (usual, poor)]
    assert rates == pytest.approx([0.9, 0.9], abs=0.06)
    assert usual.lines(ONE, *one)[0].at(1.0 / 3.0, 0.98).p_detect[0] == pytest.approx(rates[0] / 3.0)


def test_how_often_places_are_hidden_fades() -> None:
    """Doors that were shut for years, and stand open since."""
    table = SightLines.empty()
    for hidden, n in ((20.0, 300), (0.0, 500)):
        for _ in range(n):
            table = table.after_session(np.full(3, hidden), np.full(3, 20.0 - hidden))
    assert (table.hidden + table.shown <= MOST_SESSIONS * (1 + 1e-12)).all()
    assert (table.p_hidden < 0.02).all()


@given(seeds, st.integers(1, 4))
def test_views_are_the_last_session_of_each_cell_and_heading(seed: int, sessions: int) -> None:
    """Against a dictionary."""
    rng = np.random.default_rng(seed)
    views, last = Views.empty(), dict[tuple[int, int, int], tuple[float, int]]()
    for k in range(sessions):
        pose = np.column_stack([rng.uniform(-1.5, 1.5, (30, 2)), rng.uniform(-7.0, 7.0, 30)])
        stamp_s = 100.0 * k + rng.random()
        frozen = views.stamp_s.copy()
        after = views.seen_from(pose, stamp_s)
        np.testing.assert_array_equal(views.stamp_s, frozen)
        views = after
        now = Counter(
            (int(np.floor(x / 0.5)), int(np.floor(y / 0.5)), int(np.degrees(turn) % 360.0 // (360.0 / HEADINGS)))
            for x, y, turn in pose.tolist()
        )
        last |= {view: (stamp_s, frames) for view, frames in now.items()}
    found = zip(views.cell.tolist(), views.heading.tolist(), views.stamp_s.tolist(), views.frames.tolist(), strict=True)
    rows = [((*cell, heading), (stamp, int(frames))) for cell, heading, stamp, frames in found]
    assert rows == sorted(last.items())
    assert len(views) == len(last)
    # poses stand for their cells
    again = Views.empty().seen_from(views.pose, 7.0)
    np.testing.assert_array_equal(again.cell, views.cell)
    np.testing.assert_array_equal(again.heading, views.heading)


def test_views_of_no_frame_are_those_of_before() -> None:
    views = Views.empty().seen_from(np.array([[0.2, 0.3, 0.1]]), 5.0)
    after = views.seen_from(np.zeros((0, 3)), 9.0)
    assert after.stamp_s.tolist() == [5.0]
    assert len(Views.empty()) == 0


def looks_of(recording: Recording) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, IntArray]:
    """Of a simulated session, from true poses at what truly is there: sensor, place, nominal rate, hit, landmark."""
    landmarks, truth, d = recording.true_landmarks, recording.truth, recording.detections
    assert landmarks is not None
    assert truth is not None
    row = np.clip(np.searchsorted(truth.stamp_s, recording.frames.stamp_s), 0, len(truth) - 1)
    pose = truth.pose_world_robot[row]
    p = NominalField(recording.sensor).p_detect(pose, landmarks.position_m)
    hit = np.zeros(p.shape, dtype=np.bool_)
    known = np.isin(d.landmark_id, landmarks.landmark_id)
    hit[d.frame[known], np.searchsorted(landmarks.landmark_id, d.landmark_id[known])] = True
    frame, column = np.nonzero(p >= 0.3 * recording.sensor.p_detect)
    eye = se2.compose(pose, np.asarray(recording.sensor.mount_robot_sensor))[:, :2]
    name = landmarks.landmark_id[column]
    return eye[frame], landmarks.position_m[column], p[frame, column], hit[frame, column], name


def test_sessions_to_come_are_predicted_better_than_by_the_field_of_view() -> None:
    """In a building with walls that nobody told of: log score and calibration of every session before it is learned.

    Measured for this seed: -0.82 nats a look by the nominal field, of which -0.66 is what the overall rate of hits
    gives; learned -0.64 in the first session, -0.36 in the last. Along lines that are known to be clear .678 are hits
    where .661 were predicted.
    """
    simulation = simulate_building(BuildingConfig(), 0)
    table = SightLines.empty()
    sites = dict[tuple[int, float, float], int]()
    names = list[int]()
    score: list[tuple[float, float, float]] = []
    predicted, came, known = [], [], []
    for session, recording in enumerate(simulation.sessions):
        sensor, place_m, nominal, hit, landmark = looks_of(recording)
        for name, (x, y) in zip(landmark.tolist(), place_m.tolist(), strict=True):
            if sites.setdefault((name, x, y), len(sites)) == len(names):
                names.append(name)
        place = np.array([sites[n, x, y] for n, (x, y) in zip(landmark.tolist(), place_m.tolist(), strict=True)])
        places = np.arange(len(names)), np.array(names)
        cell = table.cells(sensor, place_m)
        lines, p_clear, seen = table.lines(places, place, cell, nominal)
        p = p_clear * lines.p_detect + (1.0 - p_clear) * BLOCKED
        log_score = [np.where(hit, np.log(q), np.log1p(-q)).mean() for q in (nominal, np.full(len(hit), hit.mean()), p)]
        score.append((log_score[0], log_score[1], log_score[2]))
        if session >= 2:
            predicted.append(p)
            came.append(hit)
            known.append(seen & (p_clear >= 0.9))
        table = table.learned(places, place, cell, hit, np.ones(len(hit)))
    by_field, by_rate, learned = np.array(score).T
    assert (learned > by_field + 0.15).all()
    assert (learned[1:] > by_rate[1:] + 0.1).all()
    assert (learned[-2:] > by_field[-2:] + 0.4).all()
    p, hit, clear = np.concatenate(predicted), np.concatenate(came), np.concatenate(known)
    assert clear.mean() > 0.3
    assert hit[clear].mean() == pytest.approx(p[clear].mean(), abs=0.03)  # what is judged by
    for low in np.arange(0.0, 1.0, 0.2):
        inside = (p >= low) & (p < low + 0.2)
        assert hit[inside].mean() == pytest.approx(p[inside].mean(), abs=0.12)
    assert len(table) < 8000  # of 28,000 looks


def test_of_glimpses_in_one_cell_the_newest_is_kept() -> None:
    table = Glimpses.empty().joined(np.array([[1.1, -0.2], [1.2, -0.3], [4.0, 4.0]]), 10.0)
    assert len(table) == 2  # the first two are in one cell
    table = table.joined(np.array([[1.4, -0.1], [1.6, -0.1]]), 20.0).joined(np.zeros((0, 2)), 30.0)
    np.testing.assert_array_equal(table.position_m, [[1.4, -0.1], [1.6, -0.1], [4.0, 4.0]])
    np.testing.assert_array_equal(table.stamp_s, [20.0, 20.0, 10.0])
    assert table.last_near(np.array([3.5, 3.5]), 0.8) == 10.0
    assert table.last_near(np.array([2.6, 2.0]), 5.0) == 20.0
    assert table.last_near(np.array([3.5, 3.5]), 0.6) == -np.inf
    assert Glimpses.empty().last_near(np.zeros(2), 1e9) == -np.inf


def test_views_after_an_instant_are_those_of_sessions_that_ended_later() -> None:
    pose = np.array([[0.1, 0.1, 0.1], [3.0, 0.1, 0.1]])
    views = Views.empty().seen_from(pose, 10.0).seen_from(pose[:1], 20.0)
    assert views.after(9.0) is views
    assert views.after(10.0).stamp_s.tolist() == [20.0]
    assert views.after(10.0).cell.tolist() == [[0, 0]]
    assert len(views.after(20.0)) == 0
