"""Looks of a session at places that were never detected: which count as misses, and what all of them say."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.config import LooksConfig
from evermap.maps.sessions.looks import Watch, weigh_misses
from evermap.maps.sessions.spatial import find_looks
from evermap.sensing.visibility import LooksAt
from evermap.types import BoolArray, FloatArray

RULES = LooksConfig()
P_DETECT, FRAMES = 0.9, 4
MISSED = RULES.p_flanked_hidden + (1.0 - RULES.p_flanked_hidden) * (1.0 - P_DETECT) ** FRAMES
"""How probable it is that a landmark between two that are seen is missed in all frames from one position."""
LEFT, RIGHT, MIDDLE = 0.8 * RULES.flank_rad, -0.8 * RULES.flank_rad, 0.0


def watched(eyes: list[tuple[float, float]], places: FloatArray, seen: BoolArray, frames: int = FRAMES) -> Watch:
    """From each of some positions in some frames, of all places; those that are seen are detected in each."""
    count = len(eyes) * frames
    eye = np.column_stack([np.repeat(np.asarray(eyes), frames, axis=0), np.zeros(count)])
    pose, place = (part.ravel() for part in np.meshgrid(np.arange(count), np.arange(len(places)), indexing="ij"))
    listed = LooksAt(pose, place, np.full(len(pose), P_DETECT), seen[place])
    return Watch(np.arange(float(count)), listed, eye)


def around(eye: tuple[float, float], bearings: list[float], ranges: list[float]) -> FloatArray:
    return np.asarray(eye) + np.column_stack([np.cos(bearings), np.sin(bearings)]) * np.asarray(ranges)[:, None]


@pytest.mark.parametrize(
    ("bearings", "ranges", "counts"),
    [
        pytest.param([LEFT, RIGHT], [5.0, 5.0], True, id="between two"),
        pytest.param([LEFT, RIGHT], [5.0, 0.9 * RULES.flank_share * 4.9], False, id="one of them is in front"),
        pytest.param([LEFT, RIGHT], [5.0, 1.1 * RULES.flank_share * 4.9], True, id="one is in front, but little"),
        pytest.param([LEFT, 0.5 * LEFT], [5.0, 5.0], False, id="both on one side"),
        pytest.param([RIGHT, 0.5 * RIGHT], [5.0, 5.0], False, id="both on the other side"),
        pytest.param([LEFT, 1.2 * RULES.flank_rad * -1.0], [5.0, 5.0], False, id="one is far to the side"),
    ],
)
def test_a_miss_counts_between_what_is_seen_on_both_sides_of_it(
    bearings: list[float], ranges: list[float], *, counts: bool
) -> None:
    eye = (0.3, 0.2)
    places, seen = around(eye, [*bearings, MIDDLE], [*ranges, 4.9]), np.array([True, True, False])
    watch = watched([eye], places, seen)
    found, p_missed = weigh_misses(watch, places, ~seen, np.ones(3, dtype=np.bool_))
    np.testing.assert_array_equal(found, counts & ~watch.listed.hit)
    np.testing.assert_allclose(p_missed, [1.0, 1.0, MISSED if counts else 1.0], rtol=1e-12)


def test_misses_from_several_positions_multiply_down_to_what_is_hidden_from_all() -> None:
    """Three places in a row, ten metres ahead of positions along a line beside it: the middle one is not seen."""
    places, seen = np.array([[-1.0, 10.0], [0.0, 10.0], [1.0, 10.0]]), np.array([True, False, True])
    apart, rules = 3.0 * RULES.elsewhere_m, RULES.model_copy(update={"p_always_hidden": 1e-5})
    for count, settings, wanted in (
        (1, rules, MISSED),
        (2, rules, MISSED**2),
        (3, rules, MISSED**3),
        (4, rules, 1e-5),
        (4, RULES, RULES.p_always_hidden),
    ):
        eyes = [(apart * (k - 0.5 * count), 0.1) for k in range(count)]
        watch = watched(eyes, places, seen)
        _, p_missed = weigh_misses(watch, places, ~seen, np.ones(3, dtype=np.bool_), settings)
        np.testing.assert_allclose(p_missed, [1.0, wanted, 1.0], rtol=1e-9)


def test_too_few_looks_from_a_position_are_chance() -> None:
    eye = (0.3, 0.2)
    places, seen = around(eye, [LEFT, RIGHT, MIDDLE], [5.0, 5.0, 4.9]), np.array([True, True, False])
    _, p_missed = weigh_misses(watched([eye], places, seen, frames=1), places, ~seen, np.ones(3, dtype=np.bool_))
    np.testing.assert_array_equal(p_missed, 1.0)


def test_what_faces_an_unknown_way_must_be_missed_from_around_it() -> None:
    """Of a tag whose orientation is not known, seen from one side only, that is no evidence; from all around it is."""
    sides = np.arange(4) * 0.5 * np.pi
    eyes = [*map(tuple, 5.0 * np.column_stack([np.cos(sides), np.sin(sides)]))]
    places = np.vstack([[0.0, 0.0], around((0.0, 0.0), [*(sides + 0.25 * np.pi)], [1.0] * 4)])
    seen = np.arange(5) > 0
    for some, wanted in ((eyes[:1], 1.0), (eyes, RULES.p_always_hidden)):
        watch = watched(some, places, seen)
        _, p_missed = weigh_misses(watch, places, ~seen, np.zeros(5, dtype=np.bool_))
        assert p_missed[0] == pytest.approx(wanted, rel=1e-9)
    _, p_missed = weigh_misses(watched(eyes[:1], places, seen), places, ~seen, ~seen)
    assert p_missed[0] == pytest.approx(MISSED, rel=1e-9)


def test_beyond_the_usual_range_a_miss_says_nothing() -> None:
    eye = (0.3, 0.2)
    places, seen = around(eye, [LEFT, RIGHT, MIDDLE], [5.0, 5.0, 5.2]), np.array([True, True, False])
    found, p_missed = weigh_misses(watched([eye], places, seen), places, ~seen, np.ones(3, dtype=np.bool_))
    assert not found.any()
    np.testing.assert_array_equal(p_missed, 1.0)


def look_at(frames: int, hertz: float, *, in_turns: bool, seed: int) -> tuple[FloatArray, BoolArray, BoolArray]:
    """Stamps (F,) with jitter, in which frames two cameras look (F, 2), and in which they see something: for spells."""
    rng = np.random.default_rng(seed)
    stamp_s = 100.0 + np.arange(frames) / hertz + rng.uniform(-0.002, 0.002, frames)
    looks = np.ones((frames, 2), dtype=np.bool_)
    if in_turns:
        looks[:, 0], looks[:, 1] = np.arange(frames) % 2 == 0, np.arange(frames) % 2 == 1
    spell = np.arange(frames) // 20
    sees = np.column_stack([spell % 2 == 0, spell % 3 == 0])
    return stamp_s, looks, looks & sees


@pytest.mark.parametrize("in_turns", [True, False])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 3))])
def test_two_cameras_look_at_their_beat_also_where_they_see_nothing(in_turns: bool, seed: int) -> None:
    stamp_s, looks, seen = look_at(400, 10.0, in_turns=in_turns, seed=seed)
    assert not seen[looks].all()
    np.testing.assert_array_equal(find_looks(stamp_s, seen, RULES), looks)


def test_where_a_camera_has_seen_nothing_for_long_it_is_not_known_when_it_looks() -> None:
    stamp_s, looks, seen = look_at(400, 10.0, in_turns=True, seed=0)
    seen[120:320, 1] = False
    found = find_looks(stamp_s, seen, RULES)
    assert not (found & ~looks).any()
    np.testing.assert_array_equal(found[:, 0], looks[:, 0])
    last, first = (int(np.flatnonzero(rows)[k]) for rows, k in ((seen[:120, 1], -1), (seen[:, 1], 0)))
    assert first < last
    assert found[last : last + 2 * 30 + 1, 1].sum() == 31
    assert not found[last + 62 : 318 - 60, 1].any()


def test_a_few_views_tell_no_beat() -> None:
    stamp_s, _, seen = look_at(400, 10.0, in_turns=True, seed=0)
    seen[40:, 1] = False
    assert seen[:, 1].sum() <= 20
    np.testing.assert_array_equal(find_looks(stamp_s, seen, RULES)[:, 1], seen[:, 1])
