"""Hand-made maps and sessions, and what holds of every living map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evermap.config import LivingConfig
from evermap.maps.living import LivingMap, Sites
from evermap.maps.sessions.extend import Extended, Found, extended
from evermap.types import FloatArray

SIGMA_M = 0.01


def found(
    landmark_id: Sequence[int],
    position_m: Sequence[Sequence[float]] | FloatArray,
    *,
    place: Sequence[int] | None = None,
    class_id: Sequence[int] | None = None,
    covariance_m2: FloatArray | None = None,
    probability: float = 0.95,
    first_s: float = 0.0,
    last_s: float = 1.0,
) -> Found:
    """Landmarks of a session; new ones unless told their places."""
    count = len(landmark_id)
    return Found(
        np.array(landmark_id, dtype=np.int64),
        np.zeros(count, dtype=np.int64) if class_id is None else np.array(class_id, dtype=np.int64),
        np.full(count, -1) if place is None else np.array(place, dtype=np.int64),
        np.full(count, probability),
        np.array(position_m, dtype=np.float64),
        SIGMA_M**2 * np.eye(2 * count) if covariance_m2 is None else covariance_m2,
        np.full(count, -1),
        np.full(count, first_s),
        np.full(count, last_s),
    )


def begun(session: Found, config: LivingConfig | None = None) -> Extended:
    """A first session."""
    return extended(LivingMap(), Sites.empty(), session, config or LivingConfig(), 0.0)


def next_map(living: LivingMap, session: Found, config: LivingConfig | None = None) -> Extended:
    """A further one."""
    return extended(living, living.sites, session, config or LivingConfig(), 0.0)


def assert_consistent(living: LivingMap) -> None:
    """What `maps.living` promises of its tables."""
    members, sites, places = living.members, living.sites, living.places
    assert (np.diff(members.landmark_id) > 0).all()
    assert (np.diff(sites.site_id) > 0).all()
    pairs = list(zip(places.site_id.tolist(), places.landmark_id.tolist(), strict=True))
    assert pairs == sorted(set(pairs))
    assert set(places.site_id.tolist()) == set(sites.site_id.tolist()), "a site is where its places are"
    assert set(sites.clique_id.tolist()) == set(members.clique_id.tolist()), "a body stands, or stood, somewhere"
    body = dict(zip(members.landmark_id.tolist(), members.clique_id.tolist(), strict=True))
    of_site = dict(zip(sites.site_id.tolist(), sites.clique_id.tolist(), strict=True))
    assert all(body[landmark] == of_site[site] for site, landmark in pairs), "a place is one of its own body's"
    assert members.clique_id.max(initial=-1) < living.n_cliques_ever
    assert sites.site_id.max(initial=-1) < living.n_sites_ever
    for clique in np.unique(sites.clique_id):
        assert sites.p_here[sites.clique_id == clique].sum() <= 1.0 + 1e-9
    assert living.covariance_m2.shape == (2 * len(places), 2 * len(places))
    np.testing.assert_array_equal(living.covariance_m2, living.covariance_m2.T)
    if len(places):
        assert np.linalg.eigvalsh(living.covariance_m2).min() > -1e-9
    assert (sites.since_s <= sites.seen_s).all()
