"""Whitened factors in space: their Jacobians against differences, their weights against the mixture they come from."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap.geometry import se3
from evermap.geometry.symmetry import Symmetry
from evermap.slam.space.linearise import (
    CORNERS,
    POINT,
    POSE,
    ROWS,
    SpatialSightings,
    linearise_odometry,
    linearise_sightings,
)

LEVEL = np.array([0.1, 0.05, 0.7, 2.1, 1.3, 0.4])
STEP = 1e-6


def a_sighting(
    kind: int, oriented: bool, seed: int, alike: Symmetry | None = None, *, ray: bool = False
) -> tuple[SpatialSightings, np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    pose = se3.exp(random.normal(0.0, 0.5, (1, 6)))
    mount = se3.exp(random.normal(0.0, 0.5, (1, 6)))
    measured = se3.exp(np.array([[0.3, -0.2, 3.0, *random.normal(0.0, 0.4, 3)]]))
    place = se3.retract(se3.compose(se3.compose(pose, mount), measured), random.normal(0.0, 0.05, (1, 6)))
    if not oriented:
        place[:, 3:] = [0.0, 0.0, 0.0, 1.0]
    width = 14 + (6 if oriented else 3)
    alike = Symmetry() if alike is None else alike
    seen = SpatialSightings(
        pose_row=np.zeros(1, dtype=np.int64),
        place=np.zeros(1, dtype=np.int64),
        sensor=np.zeros(1, dtype=np.int64),
        kind=np.array([kind]),
        oriented=np.array([int(oriented)]),
        measured=measured,
        root=random.normal(0.0, 3.0, (1, 3, 3)),
        sigma_rad=np.array([0.3]),
        corner=random.normal(0.0, 0.3, (1, 4, 2)),
        corner_root=random.normal(0.0, 20.0, (1, 4, 2, 2)),
        half_m=np.array([0.2]),
        first=np.array([0, ROWS[kind] * width]),
        share=np.array([1.0]),
        log_odds=np.full(3, 1e9),
        symmetry=np.ones(1, dtype=np.int64),
        axis=np.array([-1, alike.axis]),
        first_turn=np.array([0, 1, 1 + len(alike.turns)]),
        turns=np.vstack([Symmetry().turns, alike.turns]),
        ray=np.array([ray]),
    )
    return seen, pose, place, mount


def residuals(seen, pose, place, mount, velocity, delay=0.0) -> tuple[np.ndarray, np.ndarray]:
    values, weight, residual = np.zeros(seen.first[-1]), np.zeros(1), np.zeros((1, 8))
    back, by_delay = -delay * velocity[None], -velocity[None]
    linearise_sightings(pose, place, mount, back, by_delay, LEVEL, seen, False, values, weight, residual)
    rows = int(ROWS[seen.kind[0]])
    return residual[0, :rows], values.reshape(rows, -1)


KINDS = [
    (POINT, False, None), (POINT, True, None), (POSE, True, None), (CORNERS, True, None), (POINT, False, "ray"),
    (POSE, True, ("90:z", "90:x")), (POSE, True, ("axis:y",)), (POSE, True, ("axis:z", "180:x")),
]  # fmt: skip


@pytest.mark.parametrize("delay", [0.0, 0.4])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 3))])
@pytest.mark.parametrize(("kind", "oriented", "alike"), KINDS)
def test_jacobians_of_sightings_are_those_of_differences(kind, oriented, alike, seed, delay):
    ray = alike == "ray"
    symmetry = Symmetry.generate_group(() if ray else alike or ())
    seen, pose, place, mount = a_sighting(kind, oriented, seed, symmetry, ray=ray)
    place = se3.compose(place, np.append(np.zeros(3), symmetry.turns[-1])) if oriented else place
    velocity = np.random.default_rng(seed).normal(0.0, 1.0, (1, 6))
    at, block = residuals(seen, pose, place, mount, velocity, delay)
    assert block[:, -1] == pytest.approx(-at, abs=1e-9)
    earlier = se3.retract(pose, -delay * velocity)
    assert residuals(seen, earlier, place, mount, velocity)[0] == pytest.approx(at, abs=1e-9)
    dim = 6 if oriented else 3
    columns = []
    for which, size in (("pose", 6), ("place", dim), ("mount", 6)):
        for k in range(size):
            ends = []
            for sign in (1.0, -1.0):
                by = np.zeros((1, 6))
                by[0, k] = sign * STEP
                moved = {"pose": pose, "place": place.copy(), "mount": mount}
                if which == "place" and not oriented:
                    moved["place"][:, :3] += by[:, :3]
                else:
                    moved[which] = se3.retract(moved[which], by)
                ends.append(residuals(seen, **moved, velocity=velocity, delay=delay)[0])
            columns.append((ends[0] - ends[1]) / (2.0 * STEP))
    ends = [residuals(seen, pose, place, mount, velocity, delay + sign * STEP)[0] for sign in (1.0, -1.0)]
    columns.append((ends[0] - ends[1]) / (2.0 * STEP))
    assert block[:, :-1] == pytest.approx(np.column_stack(columns), abs=2e-4 * max(1.0, np.abs(block).max()))


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 4))])
@pytest.mark.parametrize(
    ("generators", "group"),
    [
        (("90:z", "90:x"), Rotation.create_group("O")),
        (("180:z", "180:x"), Rotation.create_group("D2")),
        (("axis:z", "180:x"), Rotation.create_group("D720")),
    ],
)
def test_of_what_looks_the_same_the_most_probable_counts(generators, group, seed):
    """Against the factor without symmetries, of every equivalent measurement."""
    seen, pose, place, mount = a_sighting(POSE, True, seed, Symmetry.generate_group(generators))
    turn = Rotation.from_quat(seen.measured[0, 3:])
    nothing, costs = np.zeros((1, 6)), []
    for one in group:
        measured = np.append(seen.measured[:, :3], (turn * one).as_quat())[None]
        plain = seen._replace(measured=measured, symmetry=np.zeros(1, dtype=np.int64))
        costs.append((residuals(plain, pose, place, mount, nothing)[0] ** 2).sum())
    for one in group[:: max(1, len(group) // 8)]:  # in whichever of these it came
        measured = np.append(seen.measured[:, :3], (turn * one).as_quat())[None]
        found = residuals(seen._replace(measured=measured), pose, place, mount, nothing)[0]
        assert (found**2).sum() == pytest.approx(min(costs), rel=1e-3)


def test_jacobians_of_odometry_are_those_of_differences():
    random = np.random.default_rng(5)
    pose = se3.exp(random.normal(0.0, 0.5, (2, 6)))
    increment = se3.retract(se3.between(pose[:1], pose[1:]), random.normal(0.0, 0.1, (1, 6)))
    sigma = random.uniform(0.1, 0.5, (1, 6))
    axes = np.ascontiguousarray(se3.rotation_of(se3.exp(random.normal(0.0, 1.0, (1, 6)))))
    swing = np.full(1, 3), random.normal(0.0, 1.0, (1, 3)), axes

    def at(both, log_scale=0.1):
        values, weight = np.zeros(84), np.zeros(1)
        linearise_odometry(both, increment, log_scale, *swing, sigma, 1e9, False, values, weight)
        return values.reshape(6, 14)

    block = at(pose)
    by_scale = (at(pose, 0.1 + STEP) - at(pose, 0.1 - STEP))[:, 13] / (-2.0 * STEP)
    assert block[:, 12] == pytest.approx(by_scale, abs=1e-4)
    for row in range(2):
        for k in range(6):
            ends = []
            for sign in (1.0, -1.0):
                moved, by = pose.copy(), np.zeros(6)
                by[k] = sign * STEP
                moved[row] = se3.retract(pose[row], by)
                ends.append(-at(moved)[:, 13])
            assert block[:, 6 * row + k] == pytest.approx((ends[0] - ends[1]) / (2.0 * STEP), abs=1e-4)
