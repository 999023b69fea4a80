"""The part of a large map that a session can observe, as a separate map, and its merge into the whole.

A session sees a few hundred places, however many there are. What it says is worked out on these and on what is near,
with their joint covariance, as on a small map; the rest keeps what is believed of it, told of the time when a session
was last near (`LivingMap.dated`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from evermap.config import LivingConfig
from evermap.geometry.chunked import ChunkedCovariance, Update, blocks, of_places
from evermap.maps.living import Dated, LivingMap
from evermap.maps.sessions.believe import aged
from evermap.maps.shelves import Sight, key_of, rows, splice
from evermap.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Vicinity:
    """A part of a map.

    Attributes:
        whole: the map.
        part: some of its cliques with all their places, believed as of `whole.stamp_s`, and all stays; ids are those of
            the whole.
        place: (P,) rows of the whole's places that the part has.
        cells: (N,) columns of the floor of which the part has the views.
        jointly: whether the part has the joint covariance of its places.
    """

    whole: LivingMap
    part: LivingMap
    place: IntArray
    cells: IntArray
    jointly: bool = True

    @classmethod
    def of(
        cls,
        living: LivingMap,
        cliques: IntArray,
        config: LivingConfig,
        views_within: FloatArray | None = None,
        *,
        jointly: bool = True,
    ) -> Vicinity:
        """Take some cliques (C,) of a map.

        Views matter within `(x_min, y_min, x_max, y_max)`; None for none of them. Looks alone move no place: these need
        not be known `jointly`, but each by itself.
        """
        part, place = _of_cliques(living, cliques)
        sight = _sight(living)
        lines, views = sight.lines, sight.views
        cells = np.zeros(0, dtype=np.int64)
        if views_within is not None:
            low, high = np.floor(views_within[[0, 2]] / views.like.cell_m)
            known = views.first
            cells = np.arange(max(low, known.min(initial=0)), min(high, views.last) + 1).astype(np.int64)
        near_lines, near_views = lines.near(part.sites.site_id), views.near(cells)
        part = replace(
            part,
            sight=None,
            sightlines=rows(near_lines, np.isin(near_lines.site_id, part.sites.site_id)),
            views=rows(near_views, np.isin(key_of(near_views), cells)),
        )
        if len(part.dated):
            part = replace(part, sites=aged(part, config, living.stamp_s), dated=Dated.empty())
        joint = living.covariance_m2
        covariance = of_places(joint, place, living.dim) if jointly else blocks(joint, living.dim)[place]
        return cls(living, replace(part, covariance_m2=covariance), place, cells, jointly)

    def put_back(self, part: LivingMap) -> LivingMap:
        """Return the whole map with what a session made of the part."""
        whole, before = self.whole, self.part
        elsewhere = ~np.isin(whole.sites.site_id, before.sites.site_id)
        dated = Dated(whole.sites.site_id[elsewhere], whole.believed_s()[elsewhere])
        at_site = before.sites.site_id
        places = splice(whole.places, at_site, part.places)
        sight = _sight(whole)
        lines, views = sight.lines.replaced(at_site, part.sightlines), sight.views.replaced(self.cells, part.views)
        return replace(
            part,
            members=splice(whole.members, before.members.landmark_id, part.members),
            sites=splice(whole.sites, at_site, part.sites),
            places=places,
            dated=dated[dated.stamp_s < part.stamp_s],
            covariance_m2=self._covariance(part, places),
            log_size_variance=whole.log_size_variance,
            log_size_information=whole.log_size_information,
            metres=whole.metres,
            sightlines=lines.like,
            views=views.like,
            sight=Sight(lines, views),
        )

    def _covariance(self, part: LivingMap, places: Any) -> ChunkedCovariance:
        """Return the joint covariance of all places after the session; unchanged for a session of looks alone."""
        whole = self.whole
        if part.covariance_m2 is self.part.covariance_m2:
            return _part_in_chunks(whole)
        row = LivingMap.place_row(replace(part, places=places), part.places.landmark_id, part.places.site_id)
        was = whole.place_row(places.landmark_id, places.site_id)
        if not self.jointly:  # places were dropped, none is known better
            return _part_in_chunks(whole).taken(was)
        learned = of_places(part.covariance_m2, np.arange(len(part.places)), part.dim)
        return _part_in_chunks(whole).updated(Update(places.position_m, was, row, learned))


def near(living: LivingMap, path_m: FloatArray, reach_m: float) -> tuple[IntArray, FloatArray]:
    """Return (C,) cliques with a place within reach of a path (N, 2), and the box of the path and what is in reach.

    In space (N, 3), as seen from above: sessions see what is over and under them.
    """
    from scipy.spatial import cKDTree

    path_m = path_m[:, :2]
    away, _ = cKDTree(path_m).query(living.places.position_m[:, :2], distance_upper_bound=reach_m)
    site = np.searchsorted(living.sites.site_id, living.places.site_id[np.isfinite(away)])
    box = np.concatenate([path_m.min(axis=0) - reach_m, path_m.max(axis=0) + reach_m])
    return np.unique(living.sites.clique_id[site]), box


def cliques_of(living: LivingMap, landmark_id: IntArray) -> IntArray:
    """Return the cliques of those of some landmarks that the map has."""
    return np.unique(living.members.clique_id[np.isin(living.members.landmark_id, landmark_id)])


def predict_sites(living: LivingMap, landmark_id: IntArray, config: LivingConfig, until_s: float) -> FloatArray:
    """Return (S,) probability of every site to be where its clique stands at a later instant; of a large map only what
    is believed of the cliques of some landmarks is told of that instant, the rest of when a session was last near.
    """
    if len(living.places) <= config.whole_places:
        return aged(living, config, until_s).p_here
    part, _ = _of_cliques(living, cliques_of(living, landmark_id))
    p_here = living.sites.p_here.copy()
    p_here[np.searchsorted(living.sites.site_id, part.sites.site_id)] = aged(part, config, until_s).p_here
    return p_here


def _of_cliques(living: LivingMap, cliques: IntArray) -> tuple[LivingMap, IntArray]:
    """Some cliques of a map, without their covariance, and (P,) rows of their places."""
    sites = living.sites[np.isin(living.sites.clique_id, cliques)]
    place = np.flatnonzero(np.isin(living.places.site_id, sites.site_id))
    part = replace(
        living,
        members=living.members[np.isin(living.members.clique_id, cliques)],
        sites=sites,
        places=living.places[place],
        dated=living.dated[np.isin(living.dated.site_id, sites.site_id)],
    )
    return part, place


def in_chunks(living: LivingMap, config: LivingConfig) -> LivingMap:
    """Return the map with its covariance in chunks and its sight on shelves, if it is a large one."""
    if len(living.places) <= config.whole_places:
        return living
    sight = _sight(living)
    return replace(
        living, covariance_m2=_part_in_chunks(living), sightlines=sight.lines.like, views=sight.views.like, sight=sight
    )


def _part_in_chunks(living: LivingMap) -> ChunkedCovariance:
    covariance = living.covariance_m2
    if isinstance(covariance, ChunkedCovariance):
        return covariance
    every = np.arange(len(living.places))
    return ChunkedCovariance.of_dense(living.places.position_m, of_places(covariance, every, living.dim))


def _sight(living: LivingMap) -> Sight:
    return Sight.of(living.sightlines, living.views) if living.sight is None else living.sight
