"""Groups of turns against scipy's, and the nearest of what looks the same against all of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap.geometry import se3
from evermap.geometry.symmetry import Symmetries, Symmetry

FINE = np.linspace(-np.pi, np.pi, 20_000, endpoint=False)


def turned(random: np.random.Generator, count: int) -> np.ndarray:
    return np.hstack([random.normal(0.0, 1.0, (count, 3)), Rotation.random(count, rng=random).as_quat()])


@pytest.mark.parametrize(
    ("generators", "group"),
    [
        ("180:z", "C2"), (("180:z", "180:x"), "D2"), ("90:z", "C4"), (("90:z", "180:x"), "D4"), ("51.43:z", "C7"),
        (("72:z", "180:x"), "D5"), (("90:z", "90:x"), "O"),
    ],
)  # fmt: skip
def test_generators_make_the_groups_that_scipy_lists(generators, group):
    found = Rotation.from_quat(Symmetry.generate_group(generators).turns)
    expected = Rotation.create_group(group)
    assert len(found) == len(expected)
    off = np.array([[(a.inv() * b).magnitude() for b in expected] for a in found])
    assert off.min(axis=1) == pytest.approx(0.0, abs=1e-7)
    assert off.min(axis=0) == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize(
    ("generators", "problem"),
    [
        ("axis:w", "unknown symmetry 'axis:w'"),
        ("half:z", "unknown symmetry"),
        ("180", "unknown symmetry"),
        ("50:z", "not an integer fraction of a full turn"),
        ("-90:z", "not an integer fraction"),
        ("nan:z", "not an integer fraction"),
        (("axis:z", "axis:x"), "'any'"),
        (("axis:z", "90:x"), "'any'"),
        (("72:z", "90:x"), "do not generate a finite group"),
    ],
)
def test_other_texts_are_refused(generators, problem):
    with pytest.raises(ValueError, match=problem):
        Symmetry.generate_group(generators)


def about(axis: str, flip: str | None) -> Rotation:
    """All turns about an axis, finely, and those upside down."""
    each = Rotation.from_euler(axis, FINE[:, None])
    return each if flip is None else Rotation.concatenate([each, each * Rotation.from_euler(flip, np.pi)])


@pytest.mark.parametrize(
    ("generators", "group"),
    [
        (("90:z", "90:x"), Rotation.create_group("O")),
        ("120:y", Rotation.from_euler("y", np.array([[0.0], [2.0], [4.0]]) * np.pi / 3.0)),
        ("axis:x", about("x", None)),
        (("axis:z", "180:x"), about("z", "x")),
    ],
)
def test_the_nearest_of_all_is_found(generators, group):
    random = np.random.default_rng(5)
    pose, reference = turned(random, 12), turned(random, 12)
    symmetry = Symmetry.generate_group(generators)
    found = symmetry.nearest(pose, reference)
    assert np.array_equal(found[:, :3], pose[:, :3])
    least = symmetry.angle_between(pose, reference)
    for k in range(len(pose)):
        one, other = (Rotation.from_quat(poses[k, 3:]) for poses in (pose, reference))
        every = ((one * group).inv() * other).magnitude()
        assert least[k] == pytest.approx(every.min(), abs=2e-4)
        assert se3.angle_between(found[k], reference[k]) == pytest.approx(least[k], abs=1e-7)
        same = (one * group).inv() * Rotation.from_quat(found[k, 3:])
        assert same.magnitude().min() < 2e-4  # it looks like it


def test_a_ball_has_no_orientation():
    random = np.random.default_rng(6)
    pose, reference = turned(random, 3), turned(random, 3)
    symmetry = Symmetry.generate_group("any")
    assert symmetry.free
    assert not symmetry.angle_between(pose, reference).any()
    assert np.array_equal(symmetry.nearest(pose, reference)[:, 3:], reference[:, 3:])


def test_things_have_the_symmetries_of_their_classes():
    alike = Symmetries.of_classes({"can": ("axis:z",), "box": ("180:z",)}, ["box", "mug", "can", "can"])
    assert alike.axis.tolist() == [-1, -1, 2, 2]
    assert alike.unseen.tolist() == [[0, 0, 0], [0, 0, 0], [0, 0, 1], [0, 0, 1]]
    still = se3.identity(4)
    by = se3.retract(still, np.eye(6)[5] * np.array([np.pi, np.pi, 1.0, -2.0])[:, None])
    assert alike.angle_between(by, still) == pytest.approx([0.0, np.pi, 0.0, 0.0], abs=1e-7)
    assert se3.angle_between(alike.nearest(by, still), still) == pytest.approx([0.0, np.pi, 0.0, 0.0], abs=1e-7)
    assert se3.angle_between(alike.twisted(by, still), still) == pytest.approx([np.pi, np.pi, 0.0, 0.0], abs=1e-7)
    assert alike.angle_between(by[None], np.stack([still, by]))[1] == pytest.approx(0.0, abs=1e-7)
    assert alike[np.array([2])].axis.tolist() == [2]
