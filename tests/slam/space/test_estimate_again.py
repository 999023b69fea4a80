"""Solutions that are solved once more, of what they are the optimum of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.config import Config
from evermap.slam.space.against_map import by_itself
from evermap.slam.space.estimate import SpatialOptimum, converge_again
from evermap.slam.space.intake import prepare_space
from evermap.slam.space.solve import solve_space
from evermap.types import is_in_space
from evermap_studies.causes.drives import MAKES, as_recording, simulate


@pytest.fixture(scope="module")
def optimum() -> SpatialOptimum:
    """Of tags by their corners, which covariances count as far less than they are."""
    recording = as_recording(simulate(MAKES["corners"], 3, in_map=False))
    assert is_in_space(recording)
    return solve_space(prepare_space(recording, Config().slam.space), None).optimum


def test_what_is_solved_again_stays_and_counts_as_it_did(optimum: SpatialOptimum) -> None:
    again = converge_again(optimum, optimum.last[0].problem, optimum.estimate)
    assert np.median(optimum.smoother.problem.share) < 0.2
    np.testing.assert_array_equal(again.smoother.problem.share, optimum.smoother.problem.share)
    np.testing.assert_array_equal(again.last[0].problem.share, 1.0)
    np.testing.assert_allclose(again.noise.levels, optimum.noise.levels, rtol=0.1)
    np.testing.assert_allclose(again.estimate.place[:, :3], optimum.estimate.place[:, :3], atol=5e-4)
    ratio = by_itself(again).covariance_m2.diagonal() / by_itself(optimum).covariance_m2.diagonal()
    assert np.median(ratio) == pytest.approx(1.0, abs=0.05)


def test_its_odometry_is_no_better_than_other_evidence_had_it(optimum: SpatialOptimum) -> None:
    sober = replace(optimum.noise, translation=10.0 * optimum.noise.translation)
    again = converge_again(replace(optimum, sober=sober), optimum.last[0].problem, optimum.estimate)
    assert again.sober is not None
    assert again.sober.translation == sober.translation
    assert again.noise.translation < 1.1 * optimum.noise.translation


def test_without_what_covariances_count_nothing_is_counted(optimum: SpatialOptimum) -> None:
    plain = replace(optimum, smoother=optimum.last[0], now=optimum.last[1], fitted=None, sober=None)
    again = converge_again(plain, plain.smoother.problem, plain.estimate)
    assert again.fitted is None
