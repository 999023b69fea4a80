"""Every key of `slam.association` is read from the settings that a caller passes, not from defaults."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from space.corridors import tagged_corridor

from evermap.config import AssociationConfig, Config, Section, SlamConfig
from evermap.maps.sessions.nameless import number_in
from evermap.slam.association import describe_doubts, with_identities
from evermap.slam.association.constellation import LocalMap
from evermap.slam.association.place_index import PlaceIndex
from evermap.types import UNKNOWN, AssociationEvidence
from evermap_studies.sim.park import ParkConfig, simulate_park


class Watched:
    """A section that records which of its keys are read."""

    def __init__(self, section: Section, read: set[str], prefix: str = "") -> None:
        self._section, self._read, self._prefix = section, read, prefix

    def __getattr__(self, name: str) -> Any:
        value, key = getattr(self._section, name), self._prefix + name
        if isinstance(value, Section):
            return Watched(value, self._read, f"{key}.")
        self._read.add(key)
        return value


def keys(section: Section, prefix: str) -> Iterator[str]:
    for name in type(section).model_fields:
        value, key = getattr(section, name), prefix + name
        yield from keys(value, f"{key}.") if isinstance(value, Section) else [key]


@pytest.mark.slow
def test_every_key_is_read_from_the_settings_of_the_caller() -> None:
    """A park with some identities and a radius, again without these in a map of over 100 trees; a map that lies over
    another one; tags, and points of a map, in space.
    """
    wild = ParkConfig(drive_m=150.0, n_trees=105, n_cars=2, steering_noise_rad=0.05)  # as if wheels slip
    park, rng = simulate_park(wild), np.random.default_rng(0)
    seen, read = park.detections, set[str]()
    radius = 0.1 * rng.normal(size=seen.landmark_id.max() + 2)[seen.landmark_id] + 0.02 * rng.normal(size=len(seen))
    some = np.where(rng.random(len(seen)) < 0.1, seen.landmark_id, UNKNOWN)
    mixed = replace(seen, landmark_id=some, features=radius[:, None], feature_names=("radius_m",))
    settings: Any = Watched(SlamConfig(unknown_ids="empty"), read)
    with_identities(replace(park, detections=mixed), settings)
    describe_doubts(AssociationEvidence(0.5, 1, 1, 1, 10.0, 0.0), settings.association)
    settings = Watched(SlamConfig(unknown_ids=True), read)
    config: Any = SimpleNamespace(slam=settings, living=Config().living)
    assert park.true_landmarks is not None
    number_in(park, park.true_landmarks, config)
    place = rng.uniform(0.0, 40.0, (40, 2))
    index = PlaceIndex(place, np.tile(1e-4 * np.eye(2), (40, 1, 1)), settings=settings)
    assert len(index.pairs(LocalMap(place, 1e-4 * np.eye(80)), density=0.01, probability=0.97)) == len(place)
    with_identities(tagged_corridor(0, n_frames=40).recording, settings)
    point = rng.uniform(0.0, 10.0, (20, 3))
    PlaceIndex(point, np.tile(1e-4 * np.eye(3), (20, 1, 1)), settings=settings).motions(point, 0.01)
    every = {*keys(AssociationConfig(), "association."), "fewest_sightings", "outlier_log_odds"}
    assert every - read == set()


def test_thresholds_that_are_changed_change_the_association() -> None:
    """Without merging, and with ten sightings to a landmark, other landmarks are found."""
    park = simulate_park(ParkConfig(drive_m=60.0, n_trees=25, n_cars=0), seed=2)
    plain = SlamConfig(unknown_ids=True)
    few = SlamConfig(unknown_ids=True, fewest_sightings=10)
    apart = SlamConfig(unknown_ids=True, association={"p_match": 1.0 - 1e-12, "p_return": 1.0 - 1e-12})
    found = [with_identities(park, each).detections.landmark_id for each in (plain, few, apart)]
    assert np.bincount(found[1][found[1] != UNKNOWN])[1:].min() >= 10
    assert np.bincount(found[0][found[0] != UNKNOWN])[1:].min() < 10
    assert not np.array_equal(found[0], found[2])
