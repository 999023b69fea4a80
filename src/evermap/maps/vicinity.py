"""The part of a large map that a session can touch, as a map of its own, and what becomes of it put back.

A session sees a few hundred places, however many there are. What it says is worked out on these and on what is near,
with their joint covariance, as on a small map; the rest keeps what is believed of it, told of the time when somebody
was last near (`LivingMap.dated`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
from scipy.spatial import cKDTree

from evermap.config import LivingConfig
from evermap.geometry.chunked import ChunkedCovariance, Update, of_places
from evermap.maps.living import Dated, LivingMap
from evermap.maps.sessions.believe import aged
from evermap.sensing.sightlines import HEADINGS, SightLines, Views
from evermap.types import BoolArray, FloatArray, IntArray

Table = TypeVar("Table")


@dataclass(frozen=True, slots=True)
class Vicinity:
    """A part of a map.

    Attributes:
        whole: the map.
        part: some of its cliques with all their places, believed as of `whole.stamp_s`, and all stays; ids are those of
            the whole.
        place: (P,) rows of the whole's places that the part has.
        views: (V,) views of the whole that the part has.
    """

    whole: LivingMap
    part: LivingMap
    place: IntArray
    views: BoolArray

    @classmethod
    def of(
        cls, living: LivingMap, cliques: IntArray, config: LivingConfig, views_within: FloatArray | None = None
    ) -> Vicinity:
        """Take some cliques of a map.

        Args:
            living: the map.
            cliques: (C,) their ids, of any order.
            config: by which beliefs age.
            views_within: (4,) `(x_min, y_min, x_max, y_max)` of the views that matter; None for none of them.
        """
        part, place = _of_cliques(living, cliques)
        lines = living.sightlines
        views: BoolArray = np.zeros(len(living.views), dtype=np.bool_)
        if views_within is not None:
            eye = living.views.pose[:, :2]
            views = np.asarray(((eye >= views_within[:2]) & (eye <= views_within[2:])).all(axis=1))
        lines = _rows(lines, np.isin(lines.site_id, part.sites.site_id))
        part = replace(part, sightlines=lines, views=_rows(living.views, views))
        if len(part.dated):
            part = replace(part, sites=aged(part, config, living.stamp_s), dated=Dated.empty())
        return cls(living, replace(part, covariance_m2=of_places(living.covariance_m2, place)), place, views)

    def put_back(self, part: LivingMap) -> LivingMap:
        """Return the whole map with what a session made of the part."""
        whole, before = self.whole, self.part
        elsewhere = ~np.isin(whole.sites.site_id, before.sites.site_id)
        dated = Dated(whole.sites.site_id[elsewhere], whole.believed_s()[elsewhere])
        at_site = before.sites.site_id
        places = _spliced(whole.places, "site_id", at_site, part.places)
        return replace(
            part,
            members=_spliced(whole.members, "landmark_id", before.members.landmark_id, part.members),
            sites=_spliced(whole.sites, "site_id", at_site, part.sites),
            places=places,
            dated=dated[dated.stamp_s < part.stamp_s],
            covariance_m2=self._covariance(part, places),
            log_size_variance=whole.log_size_variance,
            log_size_information=whole.log_size_information,
            sightlines=_spliced(whole.sightlines, "site_id", at_site, part.sightlines),
            views=_views(_rows(whole.views, ~self.views), part.views),
        )

    def _covariance(self, part: LivingMap, places: Any) -> ChunkedCovariance:
        """The joint covariance of all places after the session."""
        whole = self.whole
        row = LivingMap.place_row(replace(part, places=places), part.places.landmark_id, part.places.site_id)
        was = whole.place_row(places.landmark_id, places.site_id)
        before = whole.covariance_m2
        if not isinstance(before, ChunkedCovariance):
            before = ChunkedCovariance.of_dense(
                whole.places.position_m, of_places(before, np.arange(len(whole.places)))
            )
        learned = of_places(part.covariance_m2, np.arange(len(part.places)))
        return before.updated(Update(places.position_m, was, row, learned))


def near(living: LivingMap, path_m: FloatArray, reach_m: float) -> tuple[IntArray, FloatArray]:
    """Return (C,) cliques with a place within reach of a path (N, 2), and the box of the path and what is in reach."""
    away, _ = cKDTree(path_m).query(living.places.position_m, distance_upper_bound=reach_m)
    site = np.searchsorted(living.sites.site_id, living.places.site_id[np.isfinite(away)])
    box = np.concatenate([path_m.min(axis=0) - reach_m, path_m.max(axis=0) + reach_m])
    return np.unique(living.sites.clique_id[site]), box


def cliques_of(living: LivingMap, landmark_id: IntArray) -> IntArray:
    """Return the cliques of those of some landmarks that the map has."""
    return np.unique(living.members.clique_id[np.isin(living.members.landmark_id, landmark_id)])


def predicted_of(living: LivingMap, landmark_id: IntArray, config: LivingConfig, until_s: float) -> FloatArray:
    """Return (S,) probability of every site to be where its clique stands at a later instant; of a large map only what
    is believed of the cliques of some landmarks is told of that instant, the rest of when somebody was last near.
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
    """Return the map with its covariance in chunks, if it is a large one."""
    if isinstance(living.covariance_m2, ChunkedCovariance) or len(living.places) <= config.whole_places:
        return living
    covariance = of_places(living.covariance_m2, np.arange(len(living.places)))
    return replace(living, covariance_m2=ChunkedCovariance.of_dense(living.places.position_m, covariance))


def _rows(table: Table, rows: BoolArray) -> Table:
    """Some rows of a table whose other fields are of the whole."""
    columns: dict[str, Any] = {name: getattr(table, name)[rows] for name in _columns(table)}
    return replace(table, **columns)  # type: ignore[type-var]


def _columns(table: Any) -> list[str]:
    """Fields with a row for each of the table's: of lines of sight and of views some are of the whole."""
    if isinstance(table, SightLines):
        return ["site_id", "landmark_id", "cell", "hits", "looks"]
    if isinstance(table, Views):
        return ["cell", "heading", "stamp_s", "frames"]
    return [item.name for item in fields(table)]


def _spliced(table: Table, key: str, gone: IntArray, new: Table) -> Table:
    """A table sorted by a key without some keys and with the rows of another one, which keeps its other fields."""
    kept = np.flatnonzero(~np.isin(getattr(table, key), gone))
    at = np.searchsorted(getattr(table, key)[kept], getattr(new, key))
    columns: dict[str, Any] = {
        name: np.insert(getattr(table, name)[kept], at, getattr(new, name), axis=0) for name in _columns(table)
    }
    return replace(new, **columns)  # type: ignore[type-var]


def _views(others: Views, near: Views) -> Views:
    """Views of two places, sorted by cell and heading."""
    lowest = np.minimum(others.cell.min(axis=0, initial=0), near.cell.min(axis=0, initial=0))
    height = int(max(others.cell[:, 1].max(initial=0), near.cell[:, 1].max(initial=0)) - lowest[1]) + 1
    key, own = (
        ((views.cell[:, 0] - lowest[0]) * height + views.cell[:, 1] - lowest[1]) * HEADINGS + views.heading
        for views in (others, near)
    )
    at = np.searchsorted(key, own)
    columns: dict[str, Any] = {
        name: np.insert(getattr(others, name), at, getattr(near, name), axis=0) for name in _columns(near)
    }
    return replace(near, **columns)
