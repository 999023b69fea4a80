"""What counts as in its place when two maps are laid over each other, and as far from what is stated."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap.config import SlamConfig
from evermap.explain.causes import list_suspects
from evermap.explain.causes.suspect import Inputs, Suspect
from evermap.explain.competition import _rank
from evermap.explain.put_right import find_put_right
from evermap.explain.screens import _by_shape
from evermap.explain.shape import compare_shapes
from evermap.types import Cause, Landmarks, ParameterEstimate

from .worlds import World

CONFIG = SlamConfig()


def flat(count: int, spread_m: float, sigma_m: float = 0.001) -> Landmarks:
    """Landmarks on a circle; the root of the mean square from their middle is its radius."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False) + 0.3 * np.sin(np.arange(count))
    at = spread_m * np.column_stack([np.cos(angle), np.sin(angle)])
    found = Landmarks.at(np.arange(count), at)
    return replace(found, covariance_m2=np.broadcast_to(sigma_m**2 * np.eye(2), (count, 2, 2)).copy())


def with_first_moved(places: Landmarks, by_m: float) -> Landmarks:
    at = places.position_m.copy()
    at[0] *= 1.0 + by_m / np.linalg.norm(at[0])
    return replace(places, position_m=at)


@pytest.mark.parametrize(
    ("spread_m", "sigma_m", "by_m", "stays"),
    [
        (10.0, 0.001, 0.4, True),  # between two landmarks the error is halved: 2 % of the spread
        (10.0, 0.001, 0.8, False),  # 4 %
        (0.3, 0.001, 0.03, True),  # of a small place, 5 %: 15 mm
        (0.3, 0.001, 0.06, False),
        (10.0, 0.3, 2.0, True),  # known to .3 m along each axis only
        (10.0, 0.3, 3.5, False),
        (1.0, 1.0, 0.3, True),  # known to a metre, in a place of one: no more than a fifth of it
        (1.0, 1.0, 0.6, False),
    ],
)
def test_a_landmark_is_in_its_place(spread_m: float, sigma_m: float, by_m: float, stays: bool) -> None:
    found = flat(12, spread_m, sigma_m)
    agreement = compare_shapes(found, with_first_moved(found, by_m))
    assert agreement.placed == (1.0 if stays else pytest.approx(11 / 12))


def test_a_shape_needs_four_landmarks() -> None:
    assert compare_shapes(flat(4, 5.0), flat(4, 5.0)) == (4, 1.0, 1.0)
    assert compare_shapes(flat(4, 5.0)[:3], flat(4, 5.0)) == (3, 0.0, 0.0)


@pytest.mark.parametrize(("turned_deg", "share"), [(15.0, 1.0), (25.0, 0.5)])
def test_a_tag_is_turned_as_in_the_map(turned_deg: float, share: float) -> None:
    survey = World().map_in_space()
    assert survey.rotation is not None
    by = Rotation.from_euler("z", turned_deg, degrees=True)
    agreement = compare_shapes(survey, replace(survey, rotation=(Rotation.from_quat(survey.rotation) * by).as_quat()))
    assert agreement == (16, 1.0, share)


@pytest.mark.parametrize(
    ("name", "value", "code", "ratio"),
    [
        ("range_slope", 0.07, "range-scale", 1.0 / 1.07),
        ("range_scale", 1.07, "range-scale", 1.0 / 1.07),
        ("odometry_forward_scale", 0.9, "odometry-scale", 0.9),
        ("odometry_turn_scale", 1.1, "turn-scale", 1.1),
    ],
)
def test_a_scale_that_the_estimator_found_is_told_as_a_ratio(name: str, value: float, code: str, ratio: float) -> None:
    """A slope of ranges is what they are longer by; the others are ratios."""
    recording = World(seconds=4.0).plane()
    usual = 0.0 if name == "range_slope" else 1.0
    state = ParameterEstimate(name, value, 0.001, usual, 0.005, "1", p_needed=1.0)

    def put_right(value: float) -> tuple[Cause, ...]:
        result: Any = SimpleNamespace(
            parameters=(replace(state, value=value),), trajectory=SimpleNamespace(frame="first_pose")
        )
        return find_put_right(result, Inputs.of(recording, None), SlamConfig())

    (cause,) = put_right(value)
    assert (cause.code, cause.value) == (code, pytest.approx(ratio))
    assert put_right(usual + 0.01) == ()


@pytest.mark.parametrize(
    ("unknown_ids", "code"), [(False, "map-identities"), ("empty", "map-identities"), (True, "map-site")]
)
def test_without_identities_a_map_of_another_site_is_not_one_of_other_identities(unknown_ids: Any, code: str) -> None:
    world = World(seconds=4.0)
    recording, survey = world.plane(), world.map_in_plane()
    other = replace(survey, landmark_id=survey.landmark_id + 1000)
    result: Any = SimpleNamespace(parameters=(), trajectory=SimpleNamespace(frame="first_pose"), landmarks=survey)
    config = SlamConfig(unknown_ids=unknown_ids)
    assert [one.code for one in find_put_right(result, Inputs.of(recording, other), config)] == [code]
    few: Any = SimpleNamespace(**{**vars(result), "landmarks": flat(4, 3.0)})
    assert len(find_put_right(few, Inputs.of(recording, other), config)) == (unknown_ids is not True)


def test_a_map_of_another_site_is_asked_before_all_else() -> None:
    """Nothing of it is in its place, in no scale either; one that is larger is of this site, whatever it is."""
    world = World(seconds=4.0)
    recording, found = world.plane(), flat(12, 6.0)
    here = replace(found, position_m=found.position_m[np.random.default_rng(1).permutation(12)] * 1.3)
    larger = replace(found, position_m=1.4 * found.position_m)
    alone: Any = SimpleNamespace(landmarks=found)
    for given, state, expected in ((here, 0.2, ["map-site"]), (larger, -np.log(1.4), []), (larger, 0.0, ["map-site"])):
        inputs = Inputs.of(recording, given)
        suspects = list_suspects(inputs)
        scale = next(one for one in suspects if one.code == "map-scale")
        asked = _by_shape(alone, inputs, suspects, [(np.inf, scale, state)])
        assert asked is not None
        assert [one.code for gain, one, _ in asked if gain == np.inf] == expected


def test_a_map_that_lies_nowhere_is_left_out_first() -> None:
    """And in a turn of its own: no other cause is solved for where it explains all."""
    site, size, clock = (
        Suspect(code, "", 1e-3, lambda inputs, _: inputs, str, str, sigma, of_map=of_map)
        for code, sigma, of_map in (("map-site", 0.0, True), ("tag-size", 0.3, False), ("clock", 0.5, False))
    )
    asked: Any = ([(np.inf, size, 0.2), (np.inf, site, 0.0)], [(9.0, clock, 0.1)])
    screens = [lambda *_, found=found: found for found in asked]
    nothing: Any = None
    turns = [[one.code for _, one, _ in turn] for turn in _rank(nothing, nothing, [], CONFIG, screens)]
    assert turns[0] == ["map-site"]
    assert turns[1:] == [["tag-size", "map-site"], ["clock"]]
