"""Stamps that are late by another delay each: all landmarks that a frame shows are off along the way at once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evermap import Config, run_slam
from evermap.explain.jitter import LEAST_S, LEAST_SHARE, SURELY, find_jitter, measure_jitter
from evermap.slam.plane import in_its_space
from evermap.types import VerdictKind

from .worlds import World


def stamp_on_arrival(recording: Any, sigma_s: float, seed: int = 1) -> Any:
    frames = recording.frames
    late_s = np.random.default_rng(seed).exponential(sigma_s, len(frames))
    return replace(recording, frames=replace(frames, stamp_s=np.sort(frames.stamp_s + late_s)))


def make(kind: str, **more: Any) -> Any:
    world = World(seed=3, **{"seconds": 40.0} | more)
    return world.plane() if kind == "plane" else world.space(corners=kind == "corners")


@pytest.mark.parametrize(
    ("kind", "in_map"),
    [
        ("plane", False),
        ("plane", True),
        ("poses", False),
        *(
            pytest.param(*one, marks=pytest.mark.slow)
            for one in (("poses", True), ("corners", False), ("corners", True))
        ),
    ],
)
def test_stamps_of_arrival_are_named_and_such_a_run_enters_no_map(kind: str, in_map: bool) -> None:
    given = make(kind)
    wrong = stamp_on_arrival(given, 0.08)
    result = run_slam(wrong, prior_map=given.true_landmarks if in_map else None)
    (cause,) = [one for one in result.causes if one.code == "clock-jitter"]
    assert LEAST_S < cause.value < 0.1  # a lower bound
    assert cause.probability == 1.0
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SENSOR_SUSPECT
    assert cause.message in result.verdict.message


@pytest.mark.parametrize(
    "more",
    [{}, {"late_s": 0.15}, {"wheels": 1.1}, {"turns": 1.1}, {"longer": 1.1}, {"drift": 0.06}, {"bias_radps": 0.02}],
)
@pytest.mark.parametrize("kind", ["plane", pytest.param("corners", marks=pytest.mark.slow)])
def test_what_lasts_or_is_each_landmarks_own_is_no_jitter(kind: str, more: dict[str, float]) -> None:
    given = make(kind, **more)
    result = run_slam(given)
    assert not find_jitter(result, in_its_space(given, Config().slam))


@pytest.mark.parametrize("kind", ["plane", "corners"])
def test_noise_of_detections_is_no_jitter(kind: str) -> None:
    """Ten times as much in all directions, of each landmark its own."""
    given, random = make(kind), np.random.default_rng(4)
    seen = given.detections
    if kind == "plane":
        noise = {"range_m": seen.range_m * (1.0 + 0.04 * random.normal(size=len(seen)))}
        noise["bearing_rad"] = seen.bearing_rad + 0.04 * random.normal(size=len(seen))
    else:
        noise = {"corner_px": seen.corner_px + 3.0 * random.normal(size=seen.corner_px.shape)}
    noisy = replace(given, detections=replace(seen, **noise))
    assert not find_jitter(run_slam(noisy), noisy)


def test_the_more_stamps_vary_the_more_is_found() -> None:
    """Of small delays that are no exponential's, what is found is their standard deviation."""
    given, random = make("plane"), np.random.default_rng(2)
    found = []
    for sigma_s in (0.01, 0.02):
        late_s = sigma_s * random.choice([-1.0, 1.0], len(given.frames))
        wrong = replace(given, frames=replace(given.frames, stamp_s=given.frames.stamp_s + late_s))
        result = run_slam(wrong)
        jitter = measure_jitter(result, wrong)
        assert jitter is not None
        found.append(jitter.sigma_s)
        assert bool(find_jitter(result, wrong)) == (sigma_s > LEAST_S)
        assert jitter.surely > SURELY
    assert found == pytest.approx([0.01, 0.02], rel=0.3)


def test_two_cameras_whose_mounts_are_off_see_in_turns_and_show_no_jitter() -> None:
    """What the one sees is elsewhere by the other, back and forth, from frame to frame."""
    given = make("corners")
    front, back = given.sensors
    by = np.array(front.mount_robot_sensor) + [0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    wrong = replace(given, sensors=(replace(front, mount_robot_sensor=tuple(by.tolist())), back))
    assert not find_jitter(run_slam(given), wrong)


def test_detections_of_a_single_landmark_tell_no_jitter() -> None:
    given = stamp_on_arrival(make("plane"), 0.08)
    seen = given.detections
    result = run_slam(given)
    first = np.unique(seen.frame, return_index=True)[1]
    kept = np.isin(result.innovations.detection, first)
    few = replace(result, innovations=result.innovations[np.flatnonzero(kept)])
    assert measure_jitter(few, given) is None


def test_a_little_jitter_beside_the_noise_of_detections_is_let_be() -> None:
    """It is as sure in a long drive, and no landmark or pose is further off for it."""
    given, random = stamp_on_arrival(make("plane", seconds=160.0), 0.02), np.random.default_rng(4)
    seen = given.detections
    noisy = seen.bearing_rad + 0.05 * random.normal(size=len(seen))
    wrong = replace(
        given, detections=replace(seen, bearing_rad=noisy, range_m=seen.range_m * (1.0 + noisy - seen.bearing_rad))
    )
    result = run_slam(wrong)
    jitter = measure_jitter(result, wrong)
    assert jitter is not None
    assert jitter.surely > SURELY
    assert jitter.sigma_s > LEAST_S
    assert jitter.share < LEAST_SHARE
    assert not find_jitter(result, wrong)


def test_of_few_frames_jitter_is_not_certain() -> None:
    """The same as of a whole drive, in the first seconds of it."""
    wrong = stamp_on_arrival(make("plane"), 0.06)
    result = run_slam(wrong)
    early = result.innovations.stamp_s < result.innovations.stamp_s[0] + 6.0
    few = replace(result, innovations=result.innovations[np.flatnonzero(early)])
    whole, part = measure_jitter(result, wrong), measure_jitter(few, wrong)
    assert whole is not None
    assert part is not None
    assert whole.surely > SURELY > part.surely
    assert min(part.sigma_s / LEAST_S, part.share / LEAST_SHARE) > 1.0
    assert find_jitter(result, wrong)
    assert not find_jitter(few, wrong)
