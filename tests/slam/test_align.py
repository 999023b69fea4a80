"""A robot finds its place in a map of which a part is no longer true."""

import numpy as np
import pytest

from evermap import se2
from evermap.slam.align import consensus


@pytest.mark.parametrize("seed", range(8))
def test_the_motion_of_the_majority_is_found_whatever_the_others_do(seed):
    rng = np.random.default_rng(seed)
    target = rng.uniform(-8, 8, (11, 2))
    pose = np.array([*rng.uniform(-5, 5, 2), rng.uniform(-np.pi, np.pi)])
    source = se2.transform(se2.inverse(pose), target)
    moved = rng.permutation(11)[:5]
    source[moved] += rng.uniform(2, 9, (5, 1)) * np.array([1.0, -1.0])
    found, agree = consensus(source, target)
    assert np.flatnonzero(~agree).tolist() == sorted(moved)
    assert se2.log(se2.between(pose, found)) == pytest.approx(np.zeros(3), abs=1e-9)


def test_noise_is_averaged_over_all_that_agree():
    rng = np.random.default_rng(0)
    target = rng.uniform(-8, 8, (30, 2))
    found, agree = consensus(target + rng.normal(0, 0.05, target.shape), target)
    assert agree.all()
    assert np.abs(found[:2]).max() < 4 * 0.05 / np.sqrt(30)


def test_nothing_agrees_where_no_two_distances_match():
    source = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]])
    _, agree = consensus(source, 5 * source)
    assert not agree.any()
