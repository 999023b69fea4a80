"""Landmarks that were turned in their places between sessions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from evermap.config import OverlayConfig
from evermap.geometry import se3
from evermap.geometry.symmetry import Symmetries
from evermap.maps.living import LivingMap, Places
from evermap.maps.sessions.placing import Turned
from evermap.pipeline import run_session
from evermap.types import ChangeKind, MapChange, SpatialRecording
from evermap_studies.causes.drives import MAKES, Event, as_recording, simulate

MAKE = replace(MAKES["corners"], duration_s=30.0)
DAY_S = 86400.0
TURNED = 16
"""Row of the tag that is turned, seen some twenty times a drive."""


def odds(off_rad: list[float], sigma_rad: float = 0.003, settings: OverlayConfig | None = None) -> np.ndarray:
    """Log odds that landmarks are unmoved which seem turned, each about another axis."""
    count = len(off_rad)
    axis = Rotation.random(count, random_state=1).apply([1.0, 0.0, 0.0])
    seen = Rotation.from_rotvec(axis * np.array(off_rad)[:, None]).as_quat()
    spread = np.broadcast_to(sigma_rad**2 * np.eye(3), (count, 3, 3))
    one, none = np.arange(count), np.zeros(count, dtype=np.int64)
    places = Places(one, one, np.zeros((count, 3)), none, none, np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), spread)
    turned = Turned(se3.identity(), seen, spread, Symmetries.none(count))
    return turned.log_odds(one, places, settings or OverlayConfig())


def test_what_is_turned_shows_beside_what_is_not() -> None:
    found = odds([0.2, *[0.01] * 8])
    assert found[0] < -20.0
    assert (found[1:] > 5.0).all()


def test_a_landmark_alone_may_seem_turned_by_as_much_as_any() -> None:
    """And its own reading is no evidence of how much the others do."""
    alone, beside = odds([0.2]), odds([0.2, 0.01])
    assert alone[0] > -1.0
    assert odds([0.2, np.nan])[0] == pytest.approx(alone[0])
    assert beside[0] < alone[0] - 3.0
    assert odds([2.0, 0.01])[1] == pytest.approx(odds([0.01])[0], abs=0.2)


def test_where_all_seem_turned_a_little_more_is_no_turn() -> None:
    found = odds([0.25, *np.linspace(0.1, 0.25, 12).tolist()])
    assert found[0] > -2.0


def test_odds_are_those_of_one_level_that_all_others_show() -> None:
    """By the densities of scipy, each level by itself."""
    off_rad, sigma_rad = [0.3, 0.02, 0.1, 0.05], 0.01
    settings = OverlayConfig(stood_rad=(0.02, 0.15), turned_rad=(0.5, 0.5))

    def density(off: float, level_rad: float) -> float:
        spread = (sigma_rad**2 * 2.0 + level_rad**2) * np.eye(3)
        return float(multivariate_normal.pdf([off, 0.0, 0.0], cov=spread))

    found = odds(off_rad, sigma_rad, settings)
    for one, off in enumerate(off_rad):
        weight = np.array([
            np.prod([density(other, level) + density(other, 0.5) for k, other in enumerate(off_rad) if k != one])
            for level in settings.stood_rad
        ])  # fmt: skip
        stood = weight @ [density(off, level) for level in settings.stood_rad] / weight.sum()
        assert found[one] == pytest.approx(np.log(stood / density(off, 0.5)), abs=1e-9)


def test_what_is_not_known_well_was_not_turned() -> None:
    assert odds([0.2, *[0.01] * 8], sigma_rad=0.2)[0] > -1.0


def drive(day: int, turn_rad: float) -> SpatialRecording:
    """A drive of a day, in which a tag is turned about the vertical."""
    site = simulate(MAKE, 3, in_map=False).site
    assert site is not None
    pose = site.pose[TURNED].copy()
    pose[3:] = se3.compose(se3.from_angles([0.0, 0.0, turn_rad]), se3.turn(pose[3:]))[3:]
    events = [Event(TURNED, -np.inf, pose)] if turn_rad else []
    read = as_recording(simulate(replace(MAKE, duration_s=30.0 + day), 3, events, in_map=False))
    assert isinstance(read, SpatialRecording)
    assert read.odometry is not None
    return replace(
        read,
        frames=replace(read.frames, stamp_s=read.frames.stamp_s + day * DAY_S),
        odometry=replace(read.odometry, stamp_s=read.odometry.stamp_s + day * DAY_S),
        truth=None,
    )


@pytest.mark.parametrize("degrees", [pytest.param(20.0, marks=pytest.mark.slow), 40.0])
def test_a_tag_that_is_turned_in_its_place_and_back_is_said_to_be(degrees: float) -> None:
    """By 40 degrees: nothing was said, and of the turn back that it had vanished, with all that saw it rejected."""
    living: LivingMap | None = None
    changes: list[tuple[MapChange, ...]] = []
    for day, turn in enumerate([0.0, degrees, degrees, 0.0]):
        session = run_session(drive(day, np.radians(turn)), living)
        living = session.living
        changes.append(session.changes)
    assert not changes[0]
    assert not changes[2]
    for told in (changes[1], changes[3]):
        (change,) = told
        assert change.kind is ChangeKind.MOVED
        assert change.landmark_ids == (TURNED + 1,)
        assert change.rotation_rad == pytest.approx(np.radians(degrees), abs=0.02)
        assert change.probability > 0.99
        assert np.linalg.norm(change.displacement_m) < 0.03
