"""The best rigid motion between points, in the plane and in space."""

import numpy as np
import pytest
from groups import CASES
from scipy.spatial.transform import Rotation

from evermap.geometry import se3
from evermap.geometry.rigid import rigid

both = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)


@both
def test_weighted_fits_are_those_of_repeated_points_and_many_go_at_once(case) -> None:
    rng = np.random.default_rng(0)
    source, target = rng.normal(size=(2, 5, 6, case.group.point_dim))
    times = rng.integers(1, 4, size=(5, 6))
    found = rigid(source, target, times.astype(float))
    for k in range(5):
        alone = rigid(np.repeat(source[k], times[k], axis=0), np.repeat(target[k], times[k], axis=0))
        np.testing.assert_allclose(found[k], alone, atol=1e-12)


@both
@pytest.mark.parametrize("seed", range(5))
def test_noisy_fits_are_gtsams(case, seed) -> None:
    rng = np.random.default_rng(seed)
    g = case.group
    target = rng.normal(size=(9, g.point_dim))
    source = g.transform(g.exp(rng.normal(0, 2, g.dim)), target + rng.normal(0, 0.3, target.shape)) + 20.0
    found = rigid(source, target)
    np.testing.assert_allclose(case.matrix(found), case.peer.Align(target.T, source.T).matrix(), atol=1e-12)
    np.testing.assert_allclose(found, g.normalise_poses(found), atol=1e-15)


@pytest.mark.parametrize("seed", range(5))
def test_weighted_fits_in_space_are_scipys_never_reflections(seed) -> None:
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(2, 7, 3))  # no motion at all: half of them would fit better mirrored
    weight = rng.uniform(0.1, 3.0, 7)
    found = rigid(source, target, weight)
    a, b = (points - weight @ points / weight.sum() for points in (source, target))
    expected, _ = Rotation.align_vectors(b, a, weights=weight)
    np.testing.assert_allclose(se3.rotation_of(found), expected.as_matrix(), atol=1e-10)
    middle = weight @ source / weight.sum()
    np.testing.assert_allclose(se3.transform(found, middle), weight @ target / weight.sum(), atol=1e-12)


@both
@pytest.mark.parametrize("points", ["one", "the same", "on a line", "on a plane"])
def test_points_that_leave_a_motion_open_are_met_by_one_of_the_best(case, points) -> None:
    g, rng = case.group, np.random.default_rng(1)
    spread = {"one": [0.0] * 3, "the same": [0.0] * 3, "on a line": [1.0, 0, 0], "on a plane": [1.0, 1, 0]}[points]
    source = rng.normal(size=(1 if points == "one" else 6, g.point_dim)) * spread[: g.point_dim] + 3.0
    target = g.transform(g.exp(rng.normal(size=g.dim)), source)
    found = rigid(source, target)
    np.testing.assert_allclose(g.transform(found, source), target, atol=1e-12)
    if not np.any(spread):
        np.testing.assert_allclose(g.rotation_of(found), np.eye(g.point_dim), atol=1e-12)
