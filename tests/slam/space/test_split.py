"""Places of their own for landmarks that are not where their identity is."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from space.corridors import tagged_corridor

from evermap.config import Config
from evermap.geometry import se3
from evermap.slam.space.intake import prepare_space
from evermap.slam.space.repair import split
from evermap.slam.space.solve import solve_space


@pytest.mark.parametrize("seen_at_all", [True, False])
def test_a_place_that_is_split_off_is_turned_as_most_of_its_detections_say(seen_at_all: bool) -> None:
    """One detection, by which it begins, saw the tag turned by a radian, as that of a tag that is seen small may."""
    world = tagged_corridor(1, n_tags=8, n_frames=100)
    optimum = solve_space(prepare_space(world.recording, Config().slam.space), None).optimum
    problem, true, tag = optimum.smoother.problem, optimum.estimate.place.copy(), 3
    mine = np.flatnonzero(problem.place == tag)
    measured = problem.measured.copy()
    measured[mine[0]] = se3.compose(measured[mine[0]], se3.exp([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
    wrong = true.copy()
    wrong[tag, :3] += [4.0, 0.0, 0.0]
    weight = np.ones(len(problem.place))
    weight[mine] = 0.0
    if seen_at_all:  # as if another tag with its number were there
        weight[mine[-5:]] = 1.0
    asked = SimpleNamespace(
        smoother=SimpleNamespace(problem=replace(problem, measured=measured)),
        estimate=replace(optimum.estimate, place=wrong),
        now=SimpleNamespace(weight=weight),
    )
    found = split(asked, np.arange(len(true)), np.zeros(len(true), dtype=np.bool_))
    assert found is not None
    larger, estimate, identity = found
    row = len(true) if seen_at_all else tag
    assert (len(estimate.place), identity[row]) == (len(true) + seen_at_all, tag)
    assert (larger.place[mine[0]], larger.place[mine[-1]]) == (row, tag)
    off = se3.log(se3.between(true[tag], estimate.place[row]))
    assert np.linalg.norm(off[:3]) < 0.2
    assert np.linalg.norm(off[3:]) < 0.3
