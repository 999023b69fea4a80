"""Association of landmarks without identity with a map in the plane.

A session is associated by itself (`slam.association`). Where it lies in the map follows from the constellation of what
stands: one way to lay it over the map must be far better than all others, and than being elsewhere. From there its
landmarks are assigned to those of the map, one to one, in the joint Gaussian of both, with all that is assigned held,
against 'new': by class, by how probably each still stands at a place, and by how little a landmark that was moved may
be off. What returns to its place is taken for what stood there, and two of a class that were exchanged for not moved:
nothing can tell. With these names the session goes into the map as any other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from evermap.config import Config, OverlayConfig
from evermap.geometry import se2
from evermap.geometry.chunked import blocks, of_places
from evermap.geometry.rigid import rigid
from evermap.maps.living import EXISTS, LivingMap
from evermap.maps.sessions.believe import aged
from evermap.maps.sessions.box_search import TESTED_M2
from evermap.maps.sessions.gaussian import drifted
from evermap.maps.sessions.placing import SMALLEST_P, one_to_one
from evermap.slam.association.assignment import alike
from evermap.slam.association.associator import density_of_unmet
from evermap.slam.association.consensus import Candidates, consensus
from evermap.slam.association.constellation import LocalMap, agreed_pairs
from evermap.slam.association.identify import ALL_TRIED, Associated, associated
from evermap.slam.association.jcbb import gates
from evermap.slam.association.place_index import PlaceIndex
from evermap.slam.intake import beliefs
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray, Recording, landmark_id_of

WINDOW = 12
"""Landmarks, met one after the other, that are looked for in the map together."""
GROUP, MOST_HELD, MOST_PAIRS = 24, 100, 400
"""Landmarks that are assigned together, those near them that hold them, and pairs that are weighed, at most."""
HELD_NATS = 100.0
"""Log odds of a certain match."""
GATE = float(gates(1, 0.9999)[1])
"""Squared distance beyond which a landmark is not at a place."""


@dataclass(frozen=True, slots=True)
class _Stood:
    """Candidate places of a map: (P,) rows.

    Attributes:
        row: of the map's places; landmark: (P,) row of the map's members.
        position_m, covariance_m2: (P, 2), (P, 2, 2).
        class_id: of its landmark.
        p: probability that it is there when the session begins; p_away: that it is at no known place.
    """

    row: IntArray
    landmark: IntArray
    position_m: FloatArray
    covariance_m2: FloatArray
    class_id: IntArray
    p: FloatArray
    p_away: FloatArray

    @classmethod
    def of(cls, living: LivingMap, p_site: FloatArray) -> _Stood:
        """Return those of a map, by beliefs (S,) in its sites."""
        places, members = living.places, living.members
        member = np.searchsorted(members.landmark_id, places.landmark_id)
        p_away = np.clip(1.0 - living.p_of_sites(p_site)[member], SMALLEST_P, 1.0)
        p = np.clip(p_site[np.searchsorted(living.sites.site_id, places.site_id)], SMALLEST_P, 1.0)
        row = np.arange(len(places))
        return cls(row, member, places.position_m, living.place_covariance_m2(row), members.class_id[member], p, p_away)


def without_ids(recording: Recording) -> Recording:
    """Return a recording without the ids of its detections."""
    detections = recording.detections
    nobody = np.full_like(detections.landmark_id, UNKNOWN)
    return replace(recording, detections=replace(detections, landmark_id=nobody), landmark_names={})


def named_in(recording: Recording, living: LivingMap, config: Config) -> Recording:
    """Return a recording with landmark ids by geometry: those of a map where its landmarks were met, new ones else.

    Args:
        recording: with the map's class numbers; detections with a landmark id keep it (see `without_ids`).
        living: the map.
        config: settings.

    Raises:
        DataError: too few frames with detections, or too many for the memory.
    """
    found = associated(recording, *beliefs(recording.sensor, config.slam), keep_ids=True, settings=config.slam)
    start_s = float(recording.frames.stamp_s[0])
    landmark_id = found.assignment.name
    if len(living.places):
        p_site = aged(living, config.living, start_s).p_here
        member = _Assigned(found, living, _Stood.of(living, p_site), config).members()
        known = (member >= 0) & (landmark_id == UNKNOWN)
        landmark_id[known] = living.members.landmark_id[member[known]]
    names = _new_names(found, recording, landmark_id, start_s)
    for row, text in names.items():
        landmark_id[row] = landmark_id_of(text)
    texts = {landmark_id_of(text): text for text in names.values()}
    return replace(found.named(recording, landmark_id), landmark_names={**recording.landmark_names, **texts})


def _new_names(found: Associated, recording: Recording, landmark_id: IntArray, start_s: float) -> dict[int, str]:
    """Return names of new landmarks: class, number in the session, and its first stamp."""
    start = f"{start_s:.3f}".rstrip("0").rstrip(".")
    kind, words = found.assignment.of_kind[:, 0], recording.class_names
    new = np.flatnonzero(landmark_id == UNKNOWN).tolist()
    return {row: f"{words[kind[row]] if kind[row] >= 0 else 'landmark'}-{row + 1}@{start}" for row in new}


class Where(NamedTuple):
    """Landmarks of a session in a map, each predicted by all matched ones except itself.

    Attributes:
        position_m, covariance_m2: (K, 2), (K, 2, 2).
        drift_m: standard deviation of unmoved landmarks between sessions, each axis.
        joint_m2: (2 K, 2 K) covariance of all, given all matched ones.
    """

    position_m: FloatArray
    covariance_m2: FloatArray
    drift_m: float
    joint_m2: FloatArray


def held_at(
    local: LocalMap, held: IntArray, position_m: FloatArray, covariance_m2: FloatArray, config: OverlayConfig
) -> Where:
    """Return the landmarks of a session in the map, given that some of them are at places of the map.

    Gaussian conditioning of the session, with a motion that is free, on the differences of those that are held. Of each
    of these the difference is predicted by the others alone, from the inverse of the covariance of all.

    Args:
        local: the session, in a frame of its own.
        held: (H,) rows of those that are held.
        position_m: (H, 2) their places.
        covariance_m2: (2 H, 2 H) of these.
        config: how far what stands may be off; the most probable is taken.
    """
    motion = rigid(local.place[held], position_m)
    at, count = se2.transform(motion, local.place), len(local.place)
    turn = np.kron(np.eye(count), se2.rotation(motion[2]))
    freedom = se2.rigid_directions(at - at[held].mean(axis=0)) * np.array(
        [config.free_m, config.free_m, config.free_rad]
    )
    spread = turn @ local.covariance @ turn.T + freedom @ freedom.T
    rows, error = se2.xy_rows(held), (at[held] - position_m).ravel()
    drift_m, inverse = _drifted(spread[np.ix_(rows, rows)] + covariance_m2, error, config)
    pull, gain = inverse @ error, spread[:, rows]
    joint = spread - gain @ inverse @ gain.T
    position, covariance = at - (gain @ pull).reshape(-1, 2), blocks(joint).copy()
    own = np.linalg.inv(blocks(inverse))
    position[held] = position_m + (own @ pull.reshape(-1, 2, 1))[..., 0]
    covariance[held] = own - blocks(covariance_m2) - drift_m**2 * np.eye(2)
    return Where(position, covariance, drift_m, joint)


def _drifted(covariance: FloatArray, error: FloatArray, config: OverlayConfig) -> tuple[float, FloatArray]:
    """The drift that explains differences best, and the inverse of their covariance with it."""
    best, found = -math.inf, (0.0, covariance)
    for k, drift_m in enumerate(config.drifts_m):
        factor = cho_factor(drifted(covariance, drift_m), lower=True)
        told = -0.5 * float(error @ cho_solve(factor, error)) - float(np.log(np.diag(factor[0])).sum())
        told += k * math.log(config.p_coarser)
        if told > best:
            best, found = told, (drift_m, np.asarray(cho_solve(factor, np.eye(len(error)))))
    return found


class _Assigned:
    """Landmarks of a session (K,), to be assigned to those of a map."""

    def __init__(self, found: Associated, living: LivingMap, stood: _Stood, config: Config) -> None:
        self._found, self._living, self._stood, self._overlay = found, living, stood, config.living.overlay
        self._settings, self._slam = config.living.nameless, config.slam
        self._local, self._beside_m = found.in_metres, config.living.looks.beside_m
        name, known = found.assignment.name, living.members.landmark_id[stood.landmark]
        # what has a name is the landmark with that name, and nothing else is
        same = np.where((name == UNKNOWN)[:, None], ~np.isin(known, name), name[:, None] == known)
        self._alike = same & alike(found.assignment.of_kind[:, None, :1], stood.class_id[None, :, None])
        self._named = np.flatnonzero(np.isin(name, known))
        self._density = density_of_unmet(self._local.place, config.slam)

    def members(self) -> IntArray:
        """Return (K,) rows of the map's members, -1 for new ones."""
        place = self._placed()
        member = np.full(len(place), -1, dtype=np.int64)
        while np.any(place >= 0):
            place = self._grown(place)
            where = self._where(np.arange(len(place)), place)
            member = self._assigned(where, place)
            more = self._regained(where, member, place)
            if np.array_equal(more, place):
                break
            place = more
        return member

    def _where(self, some: IntArray, place: IntArray) -> Where:
        """Return some landmarks in the map, given those among them at places (K,) of the map."""
        held = np.flatnonzero(place[some] >= 0)
        at = self._stood.row[place[some[held]]]
        known = of_places(self._living.covariance_m2, at)
        return held_at(self._local.part(some), held, self._living.places.position_m[at], known, self._overlay)

    def _grown(self, place: IntArray) -> IntArray:
        """Return (K,) `place` with all certain matches: outwards from the given ones, in agreeing groups."""
        place, x = place.copy(), self._local.place
        tried = place >= 0
        while not tried.all():
            held, left = np.flatnonzero(place >= 0), np.flatnonzero(~tried)
            away = np.linalg.norm(x[left][:, None] - x[held], axis=2)
            group = left[np.argsort(away.min(axis=1), kind="stable")[:GROUP]]
            near = held[np.argsort(np.linalg.norm(x[group][:, None] - x[held], axis=2).min(axis=0))[:MOST_HELD]]
            where = self._where(np.append(group, near), place)
            mine, theirs = self._agreed(group, where, place)
            place[mine] = theirs
            tried[group] = True
            if len(mine):  # what was in doubt may be none beside these
                tried |= place >= 0
                tried[np.setdiff1d(np.flatnonzero(place < 0), group)] = False
        return place

    def _agreed(self, group: IntArray, where: Where, place: IntArray) -> tuple[IntArray, IntArray]:
        """Return landmarks of a group, the first of `where`, and the places that they certainly match."""
        stood = self._stood
        free = ~np.isin(stood.landmark, stood.landmark[place[place >= 0]])
        k, m, stands, _ = self._odds(group, where, free)
        some = np.flatnonzero(np.isfinite(stands))
        some = some[np.argsort(-stands[some], kind="stable")[:MOST_PAIRS]]
        k, m = k[some], m[some]
        off = where.position_m[k] - stood.position_m[m]
        rows = se2.xy_rows(k)
        covariance = where.joint_m2[np.ix_(rows, rows)] + of_places(self._living.covariance_m2, stood.row[m])
        at = se2.xy_rows(np.arange(len(m)))
        covariance[at, at] += where.drift_m**2
        own = _log_density(off, blocks(covariance)) if len(m) else np.zeros(0)
        against = own - stands[some]
        conflict = (k[:, None] == k) | (stood.landmark[m][:, None] == stood.landmark[m])
        found = consensus(Candidates(off, covariance, against, conflict), gate=GATE, loose=GATE)
        p_merge = self._slam.association.p_merge
        sure = found.pairs[found.margin >= math.log(p_merge / (1.0 - p_merge))]
        return group[k[sure]], m[sure]

    def _placed(self) -> IntArray:
        """Return (K,) rows of the places that landmarks of one stretch certainly match, -1 for the others."""
        stands, every = np.flatnonzero(self._stood.p >= EXISTS), np.arange(len(self._local.place))
        place, named = np.full(len(every), -1, dtype=np.int64), self._named[:MOST_HELD]
        best = self._overlaid(named, stands[self._alike[named][:, stands].any(axis=0)], None, self._alike, fewest=2)
        if not best and len(stands) >= self._settings.fewest:
            index = None
            if len(stands) > ALL_TRIED:
                index = PlaceIndex(*self._about(stands), settings=self._slam)
            for some in _windows(every):
                best = max(best, self._overlaid(some, stands, index, self._alike), key=len)
            best = best if len(best) >= self._settings.fewest else []
        if best:
            mine, theirs = np.array(best).T
            place[mine] = theirs
        return place

    def _regained(self, where: Where, member: IntArray, place: IntArray) -> IntArray:
        """Return `place` with landmarks beyond their gates after a distorted stretch, by their constellation."""
        stood, together, found = self._stood, self._found.assignment.together, place.copy()
        stands, left = np.flatnonzero(stood.p >= EXISTS), np.flatnonzero(member < 0)
        held = np.flatnonzero(member >= 0)
        of = member[held][:, None] == stood.landmark
        apart = (together[:, held] @ of.astype(np.float64)) > 0.0
        for some in _windows(left):
            off = np.linalg.norm(where.position_m[some][:, None] - stood.position_m[stands], axis=2)
            near = stands[off.min(axis=0, initial=np.inf) < self._settings.bent_m]
            pairs = self._overlaid(some, near, None, self._alike & ~apart)
            if len(pairs) < self._settings.fewest:
                continue
            mine, theirs = np.array(pairs).T
            if np.linalg.norm(where.position_m[mine] - stood.position_m[theirs], axis=1).max() < self._settings.bent_m:
                found[mine] = theirs
        return found

    def _about(self, stands: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return places with their covariances, including the deviation from session to session."""
        drift_m = max(self._overlay.drifts_m)
        return self._stood.position_m[stands], self._stood.covariance_m2[stands] + drift_m**2 * np.eye(2)

    def _overlaid(
        self, some: IntArray, stands: IntArray, index: PlaceIndex | None, allowed: BoolArray, *, fewest: int = 0
    ) -> list[tuple[int, int]]:
        """Return some landmarks of the session with places that they certainly match, among some (S,) of all."""
        fewest, rules = fewest or self._settings.fewest, self._slam.association.constellation
        if len(some) < fewest or len(stands) < fewest:
            return []
        (at, spread), local, motions = self._about(stands), self._local.part(some), None
        area_m2 = float(np.prod(np.ptp(at, axis=0) + 10.0))
        if index is not None:
            motions = list(index.motions(local.place, local.beside_m))
            if not motions:
                return []
            near = index.around(
                se2.transform(np.array(motions)[:, None], local.place).reshape(-1, 2), 2.0 * rules.near_m
            )
            at, spread, stands = at[near], spread[near], stands[near]
        pairs = agreed_pairs(
            local,
            LocalMap(at, block_diag(*spread)),
            allowed[np.ix_(some, stands)],
            density=self._density,
            probability=self._slam.association.p_merge,
            motions=motions,
            margins_nats=(rules.certain_nats + max(math.log(area_m2 / TESTED_M2), 0.0), rules.lead_nats),
            settings=self._slam,
        )
        return [(int(some[k]), int(stands[m])) for k, m in pairs]

    def _odds(self, some: IntArray, where: Where, free: BoolArray) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
        """Pairs (Q,) of landmarks, the first of `where`, and places that may be one: rows of both, and the log odds of
        standing there, and of having been moved from there a little, over being new.
        """
        stood, nudge_m2 = self._stood, self._overlay.nudge_m**2 * np.eye(2)
        off = where.position_m[: len(some), None] - stood.position_m[None]
        away = np.linalg.norm(off, axis=2)
        k, m = np.nonzero(self._alike[some] & free & (away < self._settings.farthest_m))
        step, spread = off[k, m], where.covariance_m2[k] + stood.covariance_m2[m] + where.drift_m**2 * np.eye(2)
        stands = np.log(stood.p[m]) + _log_density(step, spread)
        moved = np.log(stood.p_away[m] * self._overlay.share_nudged) + _log_density(step, spread + nudge_m2)
        # beside what was found it would have been found
        missed = np.log1p(-self._settings.p_found * (1.0 - stood.p_away)) * (
            away.min(axis=0, initial=np.inf) < self._beside_m
        )
        stands, moved = (odds - math.log(self._density) - missed[m] for odds in (stands, moved))
        stands[_squared(step, spread) > GATE] = -np.inf
        return k, m, stands, moved

    def _assigned(self, where: Where, place: IntArray) -> IntArray:
        """Return (K,) rows of the members that landmarks match, including uncertain ones; -1 for new ones."""
        stood, every = self._stood, np.arange(len(place))
        k, m, stands, moved = self._odds(every, where, np.ones(len(stood.p), dtype=np.bool_))
        table = np.full((len(place), len(self._living.members)), -np.inf)
        np.maximum.at(table, (k, stood.landmark[m]), stands)
        held = np.flatnonzero(place >= 0)
        table[held], table[held, stood.landmark[place[held]]] = -np.inf, HELD_NATS
        member = self._with_parts(one_to_one(table), table)
        # what is left may have been moved a little
        table = np.full(table.shape, -np.inf)
        np.maximum.at(table, (k, stood.landmark[m]), moved)
        table[member >= 0], table[:, member[member >= 0]] = -np.inf, -np.inf
        return np.where(member >= 0, member, one_to_one(table))

    def _with_parts(self, member: IntArray, table: FloatArray) -> IntArray:
        """Return the same with further copies of assigned landmarks: those never seen together with them."""
        together, found = self._found.assignment.together, member.copy()
        for k in np.flatnonzero((member < 0) & (table.max(axis=1, initial=-np.inf) > 0.0)).tolist():
            one = int(np.argmax(table[k]))
            if not together[[k]][:, np.flatnonzero(found == one)].sum():
                found[k] = one
        return found


def _windows(rows: IntArray) -> list[IntArray]:
    """Landmarks, some at a time, in the order in which they were met."""
    return [rows[k : k + WINDOW] for k in range(0, max(len(rows) - WINDOW // 2, 1), WINDOW // 2)]


def _squared(step: FloatArray, spread: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("ki,ki->k", step, np.linalg.solve(spread, step[..., None])[..., 0]))


def _log_density(step: FloatArray, spread: FloatArray) -> FloatArray:
    return np.asarray(-0.5 * _squared(step, spread) - 0.5 * np.linalg.slogdet(spread)[1] - math.log(2.0 * math.pi))
