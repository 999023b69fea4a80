"""A mount that is tilted against what is stated shows in heights of landmarks, and is asked in space."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from evermap.config import Config
from evermap.slam.plane import in_its_space, is_tilted
from evermap.types import is_in_space
from evermap_studies.causes.drives import MAKES, Drive, as_recording, simulate
from evermap_studies.causes.mistakes import mounted

CONFIG = Config()


def look_through(tilt: tuple[float, float], noise: float = 0.02, count: int = 400, wrong: float = 0.0) -> np.ndarray:
    """How far apart two sightings are, over their range, through a mount that is tilted; a share has wrong heights."""
    random = np.random.default_rng(3)
    apart = random.normal(0.0, [0.3, 0.2, 0.0], (count, 3))
    apart[:, 2] = apart[:, :2] @ tilt + noise * random.normal(size=count)
    apart[random.random(count) < wrong, 2] += 1.0
    return apart


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_mount_is_tilted_by_more_than_any_robots(axis: int, sign: float) -> None:
    for by, expected in ((0.0, False), (0.04, False), (0.06, True), (0.17, True)):
        tilt = (sign * by, 0.01) if axis == 0 else (0.01, sign * by)
        assert is_tilted(look_through(tilt)) is expected


def test_wrong_heights_tilt_nothing_and_hide_no_tilt() -> None:
    assert not is_tilted(look_through((0.03, 0.0), wrong=0.25))
    assert is_tilted(look_through((0.07, 0.0), wrong=0.25))


def test_a_tilt_is_told_where_it_is_known() -> None:
    """Of 20 pairs with heights that are off by .3 of their range nobody knows, nor of those that go one way alone."""
    assert not is_tilted(look_through((0.1, 0.0), noise=0.3, count=20))
    assert not is_tilted(look_through((0.1, 0.1))[:2])
    assert not is_tilted(look_through((0.1, 0.0)) * [1.0, 0.0, 1.0])


def driven(seed: int, **off: float) -> Any:
    drive: Drive = simulate(MAKES["poses"], seed, in_map=False)
    return as_recording(mounted(**off)(drive, np.random.default_rng(0)) if off else drive)


@pytest.mark.parametrize("off", [{}, {"pitch": 0.02}, {"yaw": 0.14}])
def test_mounts_that_see_heights_stand_are_of_the_plane(off: dict[str, float]) -> None:
    assert not is_in_space(in_its_space(driven(4, **off), CONFIG.slam))


@pytest.mark.parametrize("seed", [4, pytest.param(5, marks=pytest.mark.slow)])
@pytest.mark.parametrize("pitch", [-0.17, 0.08])
def test_mounts_that_are_pitched_are_asked_in_space(seed: int, pitch: float) -> None:
    assert is_in_space(in_its_space(driven(seed, pitch=pitch), CONFIG.slam))
