"""Association of landmarks without identity with a map, in the plane and in space.

A session is associated by itself (`slam.association`). Where it lies in the map follows from the constellation of what
stands: one way to lay it over the map must be far better than all others, and than being elsewhere. From there its
landmarks are assigned to those of the map, one to one, in the joint Gaussian of both, with all that is assigned held,
against 'new': by class, by how probably each still stands at a place, and by how little a landmark that was moved may
be off. What returns to its place is taken for what stood there, and two of a class that were exchanged for not moved:
nothing can tell. With these names the session goes into the map as any other. In space, landmarks that have an
orientation are the same only if that agrees, too, but one may have been turned in its place.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.spatial import KDTree

from evermap.config import Config, OverlayConfig, SlamConfig
from evermap.geometry import se2, se3
from evermap.geometry.chunked import blocks, of_places
from evermap.geometry.group import SPACE, group_of
from evermap.geometry.rigid import rigid
from evermap.maps.bodies import log_density, square_lengths
from evermap.maps.living import EXISTS, LivingMap
from evermap.maps.names import anonymous_text, distinct_text
from evermap.maps.sessions.admission import admit
from evermap.maps.sessions.believe import aged
from evermap.maps.sessions.box_search import TESTED_M2, windows
from evermap.maps.sessions.gaussian import drifted
from evermap.maps.sessions.placing import SMALLEST_P, one_to_one
from evermap.slam.association import Identified, associate
from evermap.slam.association.assignment import alike, visits_of, with_ids
from evermap.slam.association.consensus import Candidates, consensus
from evermap.slam.association.constellation import LocalMap, list_agreed_pairs
from evermap.slam.association.features import Likeness, Traits, column_medians, learned
from evermap.slam.association.identify import ALL_TRIED, Associated, numbered
from evermap.slam.association.jcbb import gates
from evermap.slam.association.merging import in_reach
from evermap.slam.association.place_index import PlaceIndex
from evermap.slam.association.revise import most_probable
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    AnyRecordingT,
    BoolArray,
    FloatArray,
    IntArray,
    Landmarks,
    landmark_id_of,
    traits_of,
)

WINDOW = 12
"""Landmarks, met one after the other, that are looked for in the map together."""
GROUP, MOST_HELD, MOST_PAIRS = 24, 100, 400
"""Landmarks that are assigned together, those near them that hold them, and pairs that are weighed, at most."""
HELD_NATS = 100.0
"""Log odds of a certain match."""
BESIDE = 3
"""Landmarks next to a detection that tell how far the session is bent there."""
CHI2_MEDIAN = 0.45493642311957283
"""Median of a squared standard normal number."""
GATE = {dim: float(gates(1, 0.9999, dim)[1]) for dim in (2, 3)}
"""Squared distance beyond which a landmark is not at a place, by the coordinates of one."""


@dataclass(frozen=True, slots=True)
class _Stood:
    """Candidate places of a map: (P,) rows.

    Attributes:
        row: of the map's places; landmark: (P,) row of the map's members.
        position_m, covariance_m2: (P, D), (P, D, D).
        rotation: (P, 4) in space, nan for none; (P, 0) in the plane.
        class_id: of its landmark.
        p: probability that it is there when the session begins; p_away: that it is at no known place.
    """

    row: IntArray
    landmark: IntArray
    position_m: FloatArray
    covariance_m2: FloatArray
    rotation: FloatArray
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
        covariance = living.place_covariance_m2(row)
        return cls(row, member, places.position_m, covariance, places.rotation, members.class_id[member], p, p_away)


def without_ids(recording: AnyRecordingT, config: Config) -> AnyRecordingT:
    """Return a recording without the ids of its detections, where `slam.unknown_ids` says that they do not count."""
    if config.slam.unknown_ids is not True:
        return recording
    nobody = np.full(len(recording.detections), UNKNOWN)
    return replace(with_ids(recording, nobody, nobody, nobody[:0]), landmark_names={})


def name_in(recording: AnyRecordingT, living: LivingMap, config: Config) -> AnyRecordingT:
    """Return a recording with landmark ids by geometry: those of a map where its landmarks were met, new ones else.

    Args:
        recording: with the map's class numbers; detections with a landmark id keep it (see `without_ids`).
        living: the map.
        config: settings.

    Raises:
        DataError: too few frames with detections, or too many for the memory; in space, no odometry.
    """
    found, name, landmark_id = _met(recording, living, config)
    start_s, texts = float(recording.frames.stamp_s[0]), dict[int, str]()
    for row in np.flatnonzero(landmark_id == UNKNOWN).tolist():
        kind = int(found.of_kind[row, 0])
        text = anonymous_text(recording.class_names[kind] if kind >= 0 else "", row + 1, start_s)
        text = distinct_text(text, living.landmark_texts)
        landmark_id[row] = landmark_id_of(text)
        texts[landmark_id_of(text)] = text
    named = with_ids(recording, found.landmark_row, name, landmark_id)
    return replace(named, landmark_names={**recording.landmark_names, **texts})


def number_in(recording: AnyRecordingT, prior_map: Landmarks, config: Config) -> AnyRecordingT:
    """Return the recording of `identify_in`."""
    return identify_in(recording, prior_map, config).recording  # type: ignore[return-value]


def identify_in(recording: AnyRecording, prior_map: Landmarks, config: Config) -> Identified:
    """Return a recording with landmark ids by geometry: those of a fixed map, and numbers for new landmarks.

    Args:
        recording: as read; ids of its detections count with `slam.unknown_ids = "empty"`.
        prior_map: landmarks that keep their ids when they are found again, wherever the robot starts.
        config: settings.

    Raises:
        DataError: as of `name_in`.
    """
    living = replace(LivingMap.begun(prior_map, config.living.whole_places), clock=recording.clock)
    given = without_ids(recording, config)  # type: ignore[type-var]
    now = living.from_now_on(float(recording.frames.stamp_s[0]))
    of_map, living = admit(given, now)  # type: ignore[type-var]
    found, name, landmark_id = _met(of_map, living, config)
    ids = numbered(landmark_id, np.concatenate([prior_map.landmark_id, given.detections.landmark_id]))
    return Identified(with_ids(given, found.landmark_row, name, ids), found.evidence)  # type: ignore[type-var]


def _met(recording: AnyRecording, living: LivingMap, config: Config) -> tuple[Associated, IntArray, IntArray]:
    """The association of a recording, (M,) ids of its detections, given or of glimpsed landmarks of a map, and (L,) ids
    of its landmarks, `UNKNOWN` for new ones.
    """
    found = associate(recording, config.slam, keep_ids=True)
    landmark_id, name = found.names, found.name.copy()
    if len(living.places):
        p_site = aged(living, config.living, float(recording.frames.stamp_s[0])).p_here
        traits = _Traits.of(found, recording, living, config.slam)
        assigned = _Assigned(found, living, _Stood.of(living, p_site), traits, config)
        member, where = assigned.members()
        known = (member >= 0) & (landmark_id == UNKNOWN)
        landmark_id[known] = living.members.landmark_id[member[known]]
        rows, glimpsed = assigned.glimpsed(member, where, recording.detections.frame)
        name[rows] = living.members.landmark_id[glimpsed]
    return found, name, landmark_id


class Where(NamedTuple):
    """Landmarks of a session in a map, each predicted by all matched ones except itself.

    Attributes:
        position_m, covariance_m2: (K, D), (K, D, D).
        drift_m: standard deviation of unmoved landmarks between sessions, each axis.
        joint_m2: (D K, D K) covariance of all, given all matched ones.
        rotation: (K, 4) in space, nan for none; (K, 0) in the plane.
    """

    position_m: FloatArray
    covariance_m2: FloatArray
    drift_m: float
    joint_m2: FloatArray
    rotation: FloatArray


def hold_at(
    local: LocalMap, held: IntArray, position_m: FloatArray, covariance_m2: FloatArray, config: OverlayConfig
) -> Where:
    """Return the landmarks of a session in the map, given that some of them (H,) are at places (H, D), of covariance (D
    H, D H), of the map.

    Gaussian conditioning of the session, with a motion that is free, on the differences of those that are held. Of each
    of these the difference is predicted by the others alone, from the inverse of the covariance of all. What stands may
    be off by the most probable one of some drifts.
    """
    motion, dim = rigid(local.place[held], position_m), local.dim
    group = group_of(motion)
    at, count = group.transform(motion, local.place), len(local.place)
    turn = np.kron(np.eye(count), group.rotation_of(motion))
    free = np.repeat([config.free_m, config.free_rad], [dim, group.dim - dim])
    freedom = group.rigid_directions(at - at[held].mean(axis=0)) * free
    spread = turn @ local.covariance @ turn.T + freedom @ freedom.T
    rows, error = se2.xy_rows(held, dim), (at[held] - position_m).ravel()
    drift_m, inverse = _drifted(spread[np.ix_(rows, rows)] + covariance_m2, error, dim, config)
    pull, gain = inverse @ error, spread[:, rows]
    joint = spread - gain @ inverse @ gain.T
    position, covariance = at - (gain @ pull).reshape(-1, dim), blocks(joint, dim).copy()
    own = np.linalg.inv(blocks(inverse, dim))
    position[held] = position_m + (own @ pull.reshape(-1, dim, 1))[..., 0]
    covariance[held] = own - blocks(covariance_m2, dim) - drift_m**2 * np.eye(dim)
    rotation = np.zeros((count, 0))
    if local.rotation is not None:
        rotation = se3.compose(motion, se3.turn(local.rotation))[:, 3:]
    return Where(position, covariance, drift_m, joint, rotation)


def _drifted(covariance: FloatArray, error: FloatArray, dim: int, config: OverlayConfig) -> tuple[float, FloatArray]:
    """The drift that explains differences best, and the inverse of their covariance with it."""
    best, found = -math.inf, (0.0, covariance)
    drifts_m = config.drifts_m if dim < SPACE.point_dim else (*config.drifts_m, *config.drifts_in_space_m)
    for k, drift_m in enumerate(drifts_m):
        factor = cho_factor(drifted(covariance, drift_m), lower=True)
        told = -0.5 * float(error @ cho_solve(factor, error)) - float(np.log(np.diag(factor[0])).sum())
        told += k * math.log(config.p_coarser)
        if told > best:
            best, found = told, (drift_m, np.asarray(cho_solve(factor, np.eye(len(error)))))
    return found


class _Traits(NamedTuple):
    """What the landmarks of a session (K,) and of a map (L,) are like.

    Attributes:
        traits: of the session's detections.
        mine, theirs: of its landmarks, and of the map's members.
    """

    traits: Traits
    mine: Likeness
    theirs: Likeness

    @classmethod
    def of(cls, found: Associated, recording: AnyRecording, living: LivingMap, settings: SlamConfig) -> Self | None:
        """Return what the columns of a recording say; None if that is nothing, or the map does not know them."""
        seen, row = recording.detections, found.landmark_row
        features, names = traits_of(seen)
        if features is None or not len(living.traits):
            return None
        visit, landmark = visits_of(recording.frames.stamp_s[seen.frame], row, settings.association.forget_s)
        traits = learned(features, visit, landmark, settings=settings)
        if traits is None:
            return None
        mine = traits.of_landmarks(traits.of_visits(visit, len(landmark)), landmark, len(found.sightings))
        columns = [names[c] for c in traits.column]
        value, sessions = living.traits.of(living.members.landmark_id, columns)
        error = traits.errors[traits.most_readings] / np.maximum(sessions, 1)
        readings = (traits.most_readings * sessions.max(axis=1, initial=0)).astype(np.float64)
        return cls(traits, mine, Likeness(value - traits.mean, error, readings))

    def nats(self, k: IntArray, member: IntArray) -> FloatArray:
        """Return (Q,) the evidence that landmarks (Q,) of the session are members (Q,) of the map [nats]."""
        return self.traits.same(self.mine.part(k), self.theirs.part(member))

    def compared(self, k: IntArray, member: IntArray, fewest: int) -> Self:
        """Return the same for columns that may be off by a common offset, and err by more than within the session, by
        pairs (Q,) that are certain, if there are enough: the light may be another one.
        """
        if len(k) < fewest:
            return self
        off = self.mine.value[k] - self.theirs.value[member]
        known = np.isfinite(off)
        stated = self.mine.variance[k] + self.theirs.variance[member]
        shift = np.where(known.sum(axis=0) >= fewest, column_medians(off), 0.0)
        squared = np.where(known, (off - shift) ** 2 / stated, np.nan)
        wider = np.maximum(column_medians(squared) / CHI2_MEDIAN, 1.0)
        wider = np.where(np.isfinite(wider), wider, 1.0)
        mine, theirs = (each._replace(variance=wider * each.variance) for each in (self.mine, self.theirs))
        return self._replace(mine=mine._replace(value=mine.value - shift), theirs=theirs)


class _Assigned:
    """Landmarks of a session (K,), to be assigned to those of a map."""

    def __init__(
        self,
        found: Associated,
        living: LivingMap,
        stood: _Stood,
        traits: _Traits | None,
        config: Config,
    ) -> None:
        self._found, self._living, self._stood, self._overlay = found, living, stood, config.living.overlay
        self._traits = traits
        self._settings, self._slam = config.living.nameless, config.slam
        self._local, self._beside_m = found.in_metres, config.living.looks.beside_m
        name, known = found.names, living.members.landmark_id[stood.landmark]
        # what has a name is the landmark with that name, and nothing else is
        same = np.where((name == UNKNOWN)[:, None], ~np.isin(known, name), name[:, None] == known)
        self._alike = same & alike(found.of_kind[:, None, :1], stood.class_id[None, :, None])
        self._named = np.flatnonzero(np.isin(name, known))
        self._density, self._dim, self._glimpse_m = found.density_of_unmet, living.dim, config.living.fit.glimpse_m

    def members(self) -> tuple[IntArray, Where | None]:
        """Return (K,) rows of the map's members, -1 for new ones; and where all lie, None if nothing matches."""
        place, where = self._place_certain(self._alike & self._not_unlike()), None
        if self._traits is not None and not np.any(place >= 0):  # all may be unlike, in another light
            compared = self._learn_columns(self._place_certain(self._alike))
            place = self._place_certain(self._alike & compared._not_unlike())
        member = np.full(len(place), -1, dtype=np.int64)
        while np.any(place >= 0):
            place = self._learn_columns(place)._grown(place)
            where = self._where(np.arange(len(place)), place)
            member = self._learn_columns(place)._assign_members(where, place)
            more = self._regain_places(where, member, place)
            if np.array_equal(more, place):
                break
            place = more
        return member, where

    def glimpsed(self, member: IntArray, where: Where | None, frame: IntArray) -> tuple[IntArray, IntArray]:
        """Return rows of detections too few for a landmark, at places where one stands, and of the members seen there;
        `member` and `where` as of `members`, and the frames (M,) of all detections of the recording.
        """
        stood, loose, local = self._stood, self._found.loose, self._local.place
        there = np.flatnonzero((stood.p >= EXISTS) & ~np.isin(stood.landmark, member))
        held = np.flatnonzero(member >= 0)
        if where is None or len(held) < BESIDE or not (len(loose.row) and len(there)):
            return loose.row[:0], there[:0]
        motion = rigid(local[held], where.position_m[held])
        bent = where.position_m - group_of(motion).transform(motion, local)
        _, near = KDTree(local[held]).query(loose.position_m, k=BESIDE)
        at = group_of(motion).transform(motion, loose.position_m) + bent[held[near]].mean(axis=1)
        # of a landmark of the session, or of one of the map
        place_m = np.vstack([where.position_m, stood.position_m[there]])
        covariance_m2 = np.concatenate([where.covariance_m2, stood.covariance_m2[there]])
        kind = np.append(self._found.of_kind[:, 0], stood.class_id[there])
        p = np.append(np.ones(len(local)), stood.p[there])
        some, k = in_reach(place_m, at, self._glimpse_m)
        kept = alike(loose.class_id[some, None], kind[k, None])
        some, k = some[kept], k[kept]
        off, variance = at[some] - place_m[k], loose.wide_m[some] ** 2 + where.drift_m**2
        spread = covariance_m2[k] + variance[:, None, None] * np.eye(self._dim)
        score = np.log(p[k]) + log_density(off, spread) - math.log(self._density)
        score[square_lengths(off, spread) > GATE[self._dim]] = -np.inf
        p_own = self._slam.association.p_own
        found = most_probable(loose.row[some], k, score, frame, len(place_m), p_own)
        rows = np.flatnonzero(found >= len(local))
        place = found[rows] - len(local)
        # had it stood there it would have been seen about as often as what stands beside it, or be a landmark
        count, at = np.bincount(place, minlength=len(there)), stood.position_m[there]
        _, beside = KDTree(where.position_m[held]).query(at, distance_upper_bound=self._beside_m)
        usual = self._slam.association.least_seen * np.append(self._found.sightings[held], 0)[beside]
        few = ((count < self._slam.fewest_sightings) & (count >= usual))[place]
        return rows[few], stood.landmark[there[place[few]]]

    def _where(self, some: IntArray, place: IntArray) -> Where:
        """Return some landmarks in the map, given those among them at places (K,) of the map."""
        held = np.flatnonzero(place[some] >= 0)
        at = self._stood.row[place[some[held]]]
        known = of_places(self._living.covariance_m2, at, self._dim)
        return hold_at(self._local.part(some), held, self._living.places.position_m[at], known, self._overlay)

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
            mine, theirs = self._match_group(group, where, place)
            place[mine] = theirs
            tried[group] = True
            if len(mine):  # what was in doubt may be none beside these
                tried |= place >= 0
                tried[np.setdiff1d(np.flatnonzero(place < 0), group)] = False
        return place

    def _match_group(self, group: IntArray, where: Where, place: IntArray) -> tuple[IntArray, IntArray]:
        """Return landmarks of a group, the first of `where`, and the places that they certainly match."""
        stood = self._stood
        free = ~np.isin(stood.landmark, stood.landmark[place[place >= 0]])
        k, m, stands, _, like = self._odds(group, where, free)
        stands = np.where(like >= -self._slam.association.readings.misread_nats, stands + like, -np.inf)
        some = np.flatnonzero(np.isfinite(stands))
        some = some[np.argsort(-stands[some], kind="stable")[:MOST_PAIRS]]
        k, m = k[some], m[some]
        off = where.position_m[k] - stood.position_m[m]
        rows = se2.xy_rows(k, self._dim)
        known = of_places(self._living.covariance_m2, stood.row[m], self._dim)
        covariance = drifted(where.joint_m2[np.ix_(rows, rows)] + known, where.drift_m)
        own = log_density(off, blocks(covariance, self._dim)) if len(m) else np.zeros(0)
        against = own - stands[some]
        conflict = (k[:, None] == k) | (stood.landmark[m][:, None] == stood.landmark[m])
        gate = GATE[self._dim]
        found = consensus(Candidates(off, covariance, against, conflict), gate=gate, loose=gate)
        p_merge = self._slam.association.p_merge
        sure = found.pairs[found.margin >= math.log(p_merge / (1.0 - p_merge))]
        return group[k[sure]], m[sure]

    def _learn_columns(self, place: IntArray) -> Self:
        """Return the same with how columns differ between the session and the map, learned from certain matches."""
        if self._traits is None:
            return self
        held, other = np.flatnonzero(place >= 0), copy.copy(self)
        member = self._stood.landmark[place[held]]
        other._traits = self._traits.compared(held, member, self._settings.fewest_compared)
        return other

    def _place_certain(self, allowed: BoolArray) -> IntArray:
        """Return (K,) rows of the places that landmarks of one stretch certainly match, -1 for the others; of the
        `allowed` (K, P) pairs.
        """
        stands, every = np.flatnonzero(self._stood.p >= EXISTS), np.arange(len(self._local.place))
        place, named = np.full(len(every), -1, dtype=np.int64), self._named[:MOST_HELD]
        of_named = stands[self._alike[named][:, stands].any(axis=0)]
        best = self._overlaid(named, of_named, self._index(of_named), self._alike, fewest=self._dim)
        if not best and len(stands) >= self._settings.fewest:
            index = self._index(stands)
            for some in windows(every, WINDOW):
                best = max(best, self._overlaid(some, stands, index, allowed), key=len)
                if len(best) >= WINDOW:  # all of one
                    break
            best = best if len(best) >= self._settings.fewest else []
        if best:
            mine, theirs = np.array(best).T
            place[mine] = theirs
        return place

    def _not_unlike(self) -> BoolArray:
        """(K, P) landmarks and places of which what these are like does not say that they are two."""
        if self._traits is None:
            return np.ones_like(self._alike)
        nats = self._every_like(np.arange(len(self._local.place)))[:, self._stood.landmark]
        return np.asarray(nats >= -self._slam.association.readings.misread_nats)

    def _regain_places(self, where: Where, member: IntArray, place: IntArray) -> IntArray:
        """Return `place` with landmarks beyond their gates after a distorted stretch, by their constellation."""
        stood, together, found = self._stood, self._found.together, place.copy()
        stands, left = np.flatnonzero(stood.p >= EXISTS), np.flatnonzero(member < 0)
        held = np.flatnonzero(member >= 0)
        of = member[held][:, None] == stood.landmark
        apart = (together[:, held] @ of.astype(np.float64)) > 0.0
        for some in windows(left, WINDOW):
            off = np.linalg.norm(where.position_m[some][:, None] - stood.position_m[stands], axis=2)
            near = stands[off.min(axis=0, initial=np.inf) < self._settings.bent_m]
            pairs = self._overlaid(some, near, self._index(near), self._alike & ~apart)
            if len(pairs) < self._settings.fewest:
                continue
            mine, theirs = np.array(pairs).T
            if np.linalg.norm(where.position_m[mine] - stood.position_m[theirs], axis=1).max() < self._settings.bent_m:
                found[mine] = theirs
        return found

    def _about(self, stands: IntArray, drift_m: float) -> tuple[FloatArray, FloatArray]:
        """Return places with their covariances, including the deviation from session to session."""
        return self._stood.position_m[stands], self._stood.covariance_m2[stands] + drift_m**2 * np.eye(self._dim)

    def _index(self, stands: IntArray) -> PlaceIndex | None:
        """Return an index of some places where not every pair is tried: of many, and in space."""
        if len(stands) <= ALL_TRIED and self._dim < SPACE.point_dim:
            return None
        return PlaceIndex(*self._about(stands, max(self._overlay.drifts_m)), settings=self._slam)

    def _overlaid(
        self, some: IntArray, stands: IntArray, index: PlaceIndex | None, allowed: BoolArray, *, fewest: int = 0
    ) -> list[tuple[int, int]]:
        """Return some landmarks of the session with places that they certainly match, among some (S,) of all.

        What is ambiguous if places may deviate much between sessions may not be if they deviate little.
        """
        fewest, rules = fewest or self._settings.fewest, self._slam.association.constellation
        if len(some) < fewest or len(stands) < fewest:
            return []
        local, motions = self._local.part(some), None
        area_m2 = float(np.prod(np.sort(np.ptp(self._stood.position_m[stands], axis=0))[-2:] + 10.0))
        by_chance = math.log(max(len(some), 2) ** 2 * max(len(stands), 2) ** 2)  # pairs of both, each a motion
        if index is not None:
            motions = list(index.motions(local.place, local.beside_m))
            if not motions:
                return []
            laid = group_of(motions[0]).transform(np.array(motions)[:, None], local.place)
            stands = stands[index.around(laid.reshape(-1, self._dim), 2.0 * rules.near_m)]
        for drift_m in sorted({max(self._overlay.drifts_m), min(self._overlay.drifts_m)}, reverse=True):
            at, spread = self._about(stands, drift_m)
            pairs = list_agreed_pairs(
                local,
                LocalMap(at, block_diag(*spread), None if local.rotation is None else self._stood.rotation[stands]),
                allowed[np.ix_(some, stands)],
                density=self._density,
                probability=self._slam.association.p_merge,
                motions=motions,
                margins_nats=(
                    rules.certain_nats + max(math.log(area_m2 / TESTED_M2), 0.0),
                    min(rules.certain_nats + by_chance, rules.lead_nats),
                ),
                settings=self._slam,
            )
            if pairs:
                return [(int(some[k]), int(stands[m])) for k, m in pairs]
        return []

    def _odds(
        self, some: IntArray, where: Where, free: BoolArray
    ) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray]:
        """Pairs (Q,) of landmarks, the first of `where`, and places that may be one: rows of both; the log odds of
        standing there, and of having been moved from there a little, over being new; and the evidence of columns.
        """
        stood, nudge_m2 = self._stood, self._overlay.nudge_m**2 * np.eye(self._dim)
        off = where.position_m[: len(some), None] - stood.position_m[None]
        away = np.linalg.norm(off, axis=2)
        k, m = np.nonzero(self._alike[some] & free & (away < self._settings.farthest_m))
        step, drift_m2 = off[k, m], where.drift_m**2 * np.eye(self._dim)
        spread = where.covariance_m2[k] + stood.covariance_m2[m] + drift_m2
        stands = np.log(stood.p[m]) + log_density(step, spread)
        moved = np.log(stood.p_away[m] * self._overlay.share_nudged) + log_density(step, spread + nudge_m2)
        # beside what was found it would have been found
        missed = np.log1p(-self._settings.p_found * (1.0 - stood.p_away)) * (
            away.min(axis=0, initial=np.inf) < self._beside_m
        )
        stands, moved = (odds - math.log(self._density) - missed[m] for odds in (stands, moved))
        stands[square_lengths(step, spread) > GATE[self._dim]] = -np.inf
        if self._local.rotation is not None:
            rules = self._slam.association.space
            angle = se3.angle_between(se3.turn(where.rotation[k]), se3.turn(stood.rotation[m]))
            turned = angle > rules.turn_sigmas * rules.turn_floor_rad
            stands, moved = (odds + np.log(self._overlay.share_turned) * turned for odds in (stands, moved))
        like = np.zeros(len(k)) if self._traits is None else self._traits.nats(some[k], stood.landmark[m])
        return k, m, stands, moved, like

    def _assign_members(self, where: Where, place: IntArray) -> IntArray:
        """Return (K,) rows of the members that landmarks match, including uncertain ones; -1 for new ones."""
        stood, every = self._stood, np.arange(len(place))
        k, m, stands, moved, like = self._odds(every, where, np.ones(len(stood.p), dtype=np.bool_))
        table, held = np.full((len(place), len(self._living.members)), -np.inf), np.flatnonzero(place >= 0)
        np.maximum.at(table, (k, stood.landmark[m]), stands + like)
        table[held], table[held, stood.landmark[place[held]]] = -np.inf, HELD_NATS
        if self._traits is not None:
            table = self._with_exchanged(table, held, (k, stood.landmark[m], stands))
        member = self._with_parts(one_to_one(table), table)
        # what is left may have been moved a little
        table = np.full(table.shape, -np.inf)
        np.maximum.at(table, (k, stood.landmark[m]), moved + like)
        table[member >= 0], table[:, member[member >= 0]] = -np.inf, -np.inf
        member = np.where(member >= 0, member, one_to_one(table))
        return member if self._traits is None else self._recognise(member)

    def _with_exchanged(
        self, table: FloatArray, held: IntArray, at_place: tuple[IntArray, IntArray, FloatArray]
    ) -> FloatArray:
        """Return log odds (K, L) of being members, also where another one of their class was.

        Two that were exchanged share the choice of the other one. A landmark that is where another one was, while none
        is where it was, has that choice for itself. Rows that are held are certain; `at_place` has (Q,) rows, members
        and log odds of being at a place of these, whatever they are like.
        """
        k, member, stands = at_place
        odds, home = np.full(len(table), -np.inf), np.full(len(table), -1, dtype=np.int64)
        order = np.argsort(stands, kind="stable")  # the last one counts
        odds[k[order]], home[k[order]] = stands[order], member[order]
        left = np.setdiff1d(np.flatnonzero(np.isfinite(odds)), held)
        another = np.full(table.shape, -np.inf)
        another[left] = odds[left, None] + np.log(self._settings.share_exchanged) + self._every_like(left)
        found = one_to_one(np.maximum(table, another))
        other = left[(found[left] >= 0) & (another[left, found[left]] > table[left, found[left]])]
        alone = other[~np.isin(found[other], home[other])]
        another[alone] -= math.log(table.shape[1])
        return np.asarray(np.maximum(table, another))

    def _recognise(self, member: IntArray) -> IntArray:
        """Return (K,) `member` with landmarks that were moved far recognised by what they are like."""
        left, count = np.flatnonzero(member < 0), len(self._living.members)
        p_away, table = np.zeros(count), np.full((len(member), count), -np.inf)
        p_away[self._stood.landmark] = self._stood.p_away
        table[left] = self._every_like(left) + np.log(np.maximum(p_away, SMALLEST_P)) - math.log(count)
        table[:, member[member >= 0]] = -np.inf
        return np.where(member >= 0, member, one_to_one(table))

    def _every_like(self, some: IntArray) -> FloatArray:
        """(S, L) evidence that landmarks are members by what they are like; minus infinity if labels differ."""
        assert self._traits is not None
        every = np.arange(len(self._living.members))
        found = np.full((len(some), len(every)), -np.inf)
        for row, k in enumerate(some.tolist()):
            may_be = np.unique(self._stood.landmark[self._alike[k]])
            found[row, may_be] = self._traits.nats(np.full_like(may_be, k), may_be)
        return found

    def _with_parts(self, member: IntArray, table: FloatArray) -> IntArray:
        """Return the same with further copies of assigned landmarks: those never seen together with them."""
        together, found = self._found.together, member.copy()
        for k in np.flatnonzero((member < 0) & (table.max(axis=1, initial=-np.inf) > 0.0)).tolist():
            one = int(np.argmax(table[k]))
            if not together[[k]][:, np.flatnonzero(found == one)].sum():
                found[k] = one
        return found
