"""Landmarks without identity in a map of the plane: which of its landmarks they are, and which are new.

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
from scipy.optimize import linear_sum_assignment

from evermap.config import LivingConfig, OverlayConfig
from evermap.geometry import se2
from evermap.geometry.chunked import blocks, of_places
from evermap.geometry.rigid import rigid
from evermap.maps.living import EXISTS, LivingMap
from evermap.maps.sessions.believe import aged
from evermap.maps.sessions.box_search import TESTED_M2
from evermap.maps.sessions.gaussian import drifted
from evermap.maps.sessions.overlay import FREE_M, FREE_RAD
from evermap.maps.sessions.placing import SMALLEST_P
from evermap.slam.association.assignment import alike
from evermap.slam.association.associator import P_MERGE, density_of_unmet
from evermap.slam.association.constellation import CERTAIN_NATS, NEAR_M, LocalMap, agreed_pairs
from evermap.slam.association.identify import ALL_TRIED, Associated, associated
from evermap.slam.association.jcbb import gates
from evermap.slam.association.place_index import LEAD_NATS, PlaceIndex
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.problem import Noise
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray, Recording, landmark_id_of

WINDOW, FEWEST = 12, 4
"""Landmarks, met one after the other, that are looked for in the map together, and how many of them must be found."""
ROUNDS = 20
"""Assignments, each with what the one before assigned held, at most."""
GATE = float(gates(1, 0.9999)[1])
"""Squared distance beyond which a landmark does not stand at a place."""
CERTAIN = math.log(P_MERGE / (1.0 - P_MERGE))
"""By how much a landmark must more probably be one of the map than anything else, to hold the session there [nats]."""
P_FOUND = 0.9
"""That a landmark which stands beside another one that was found is found, too."""


@dataclass(frozen=True, slots=True)
class _Stood:
    """Places of a map at which landmarks may stand: (P,) rows.

    Attributes:
        row: of the map's places; landmark: (P,) row of the map's members.
        position_m, covariance_m2: (P, 2), (P, 2, 2).
        class_id: of its landmark.
        p: probability that it stands there when the session begins; p_away: that it stands at no known place.
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


def named_in(
    recording: Recording, living: LivingMap, prior: CalibrationPrior, noise: Noise, config: LivingConfig
) -> Recording:
    """Return a recording with landmark ids by geometry: those of a map where its landmarks were met, new ones else.

    Args:
        recording: with the map's class numbers; its landmark ids are not looked at.
        living: the map.
        prior: of the calibration states.
        noise: where noise levels start.
        config: priors of what moved.

    Raises:
        DataError: too few frames with detections, or too many for the memory.
    """
    found = associated(recording, prior, noise)
    start_s = float(recording.frames.stamp_s[0])
    landmark_id = np.full(found.assignment.n_landmarks, UNKNOWN, dtype=np.int64)
    if len(living.places):
        p_site = aged(living, config, start_s).p_here
        member = _Session(found, living, _Stood.of(living, p_site), config).members()
        landmark_id[member >= 0] = living.members.landmark_id[member[member >= 0]]
    names = _new_names(found, recording, landmark_id, start_s)
    for row, text in names.items():
        landmark_id[row] = landmark_id_of(text)
    texts = {landmark_id_of(text): text for text in names.values()}
    return replace(found.named(recording, landmark_id), landmark_names=texts)


def _new_names(found: Associated, recording: Recording, landmark_id: IntArray, start_s: float) -> dict[int, str]:
    """What new landmarks are called: class, number in the session, and when that began."""
    start = f"{start_s:.3f}".rstrip("0").rstrip(".")
    kind, words = found.assignment.of_class, recording.class_names
    new = np.flatnonzero(landmark_id == UNKNOWN).tolist()
    return {row: f"{words[kind[row]] if kind[row] >= 0 else 'landmark'}-{row + 1}@{start}" for row in new}


class Where(NamedTuple):
    """Landmarks of a session in a map, each by all that are held there but itself.

    Attributes:
        position_m, covariance_m2: (K, 2), (K, 2, 2).
        drift_m: standard deviation, each axis, by which what stands is not quite where it was.
    """

    position_m: FloatArray
    covariance_m2: FloatArray
    drift_m: float


def held_at(
    local: LocalMap, held: IntArray, position_m: FloatArray, covariance_m2: FloatArray, config: OverlayConfig
) -> Where:
    """Return where landmarks of a session are if some of them stand at places of a map.

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
    freedom = se2.rigid_directions(at - at[held].mean(axis=0)) * np.array([FREE_M, FREE_M, FREE_RAD])
    spread = turn @ local.covariance @ turn.T + freedom @ freedom.T
    rows, error = se2.xy_rows(held), (at[held] - position_m).ravel()
    drift_m, inverse = _drifted(spread[np.ix_(rows, rows)] + covariance_m2, error, config)
    pull, gain = inverse @ error, spread[:, rows]
    explained = (gain @ inverse).reshape(count, 2, -1) @ gain.reshape(count, 2, -1).transpose(0, 2, 1)
    position, covariance = at - (gain @ pull).reshape(-1, 2), blocks(spread) - explained
    own = np.linalg.inv(blocks(inverse))
    position[held] = position_m + (own @ pull.reshape(-1, 2, 1))[..., 0]
    covariance[held] = own - blocks(covariance_m2) - drift_m**2 * np.eye(2)
    return Where(position, covariance, drift_m)


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


class _Session:
    """Landmarks of a session (K,), to be assigned to those of a map."""

    def __init__(self, found: Associated, living: LivingMap, stood: _Stood, config: LivingConfig) -> None:
        self._found, self._living, self._stood, self._overlay = found, living, stood, config.overlay
        self._local, self._beside_m = found.in_metres, config.looks.beside_m
        self._alike = alike(found.assignment.of_class[:, None], stood.class_id[None])
        self._density = density_of_unmet(self._local.place)

    def members(self) -> IntArray:
        """Return (K,) rows of the map's members, -1 for new ones."""
        place = self._placed()
        member = np.full(len(place), -1, dtype=np.int64)
        for _ in range(ROUNDS if np.any(place >= 0) else 0):
            held = np.flatnonzero(place >= 0)
            at = self._stood.row[place[held]]
            known = of_places(self._living.covariance_m2, at)
            where = held_at(self._local, held, self._living.places.position_m[at], known, self._overlay)
            following, member = self._assigned(where)
            if np.array_equal(following, place) or np.count_nonzero(following >= 0) < FEWEST:
                break
            place = following
        return member

    def _placed(self) -> IntArray:
        """(K,) rows of the places at which some landmarks surely stand, -1 for the others: those of one stretch of the
        way, which an error of the odometry bends less than all.
        """
        stood, count = self._stood, len(self._local.place)
        place, best = np.full(count, -1, dtype=np.int64), list[tuple[int, int]]()
        stands = np.flatnonzero(stood.p >= EXISTS)
        if len(stands) < FEWEST or count < FEWEST:
            return place
        at, spread = (
            stood.position_m[stands],
            stood.covariance_m2[stands] + max(self._overlay.drifts_m) ** 2 * np.eye(2),
        )
        index = PlaceIndex(at, spread) if len(stands) > ALL_TRIED else None
        area_m2 = float(np.prod(np.ptp(at, axis=0) + 10.0))
        for begin in range(0, max(count - WINDOW // 2, 1), WINDOW // 2):
            some = np.arange(begin, min(begin + WINDOW, count))
            local, motions, near = self._local.part(some), None, np.arange(len(stands))
            if index is not None:
                motions = list(index.motions(local.place, local.beside_m))
                near = index.around(se2.transform(np.array(motions)[:, None], local.place).reshape(-1, 2), 2.0 * NEAR_M)
            pairs = agreed_pairs(
                local,
                LocalMap(at[near], block_diag(*spread[near])),
                self._alike[np.ix_(some, stands[near])],
                density=self._density,
                probability=P_MERGE,
                motions=motions,
                least_nats=CERTAIN_NATS + max(math.log(area_m2 / TESTED_M2), 0.0),
                lead_nats=LEAD_NATS,
            )
            best = max(best, [(int(some[k]), int(stands[near[m]])) for k, m in pairs], key=len)
        if len(best) >= FEWEST:
            mine, theirs = np.array(best).T
            place[mine] = theirs
        return place

    def _assigned(self, where: Where) -> tuple[IntArray, IntArray]:
        """(K,) rows of the places at which landmarks surely stand, -1 for none; and of the members that they are."""
        stood, config = self._stood, self._overlay
        x, spread, drift_m = where
        off = x[:, None] - stood.position_m[None]
        k, m = np.nonzero(self._alike & (np.linalg.norm(off, axis=2) < 3.0 * config.nudge_m))
        step, wide = off[k, m], spread[k] + stood.covariance_m2[m] + drift_m**2 * np.eye(2)
        stands, moved = (
            _log_density(step, wide),
            _log_density(step, wide + config.nudge_m**2 * np.eye(2)) + math.log(config.share_nudged),
        )
        stands[_squared(step, wide) > GATE] = -np.inf
        away = np.linalg.norm(off, axis=2).min(axis=0)  # beside what was found it would have been found
        missed = np.log1p(-P_FOUND * np.clip(1.0 - stood.p_away, 0.0, 1.0)) * (away < self._beside_m)
        odds = np.logaddexp(np.log(stood.p[m]) + stands, np.log(stood.p_away[m]) + moved)
        odds -= math.log(self._density) + missed[m]
        names, column = np.unique(stood.landmark[m], return_inverse=True)
        table = np.full((len(x), len(names)), -np.inf)
        np.maximum.at(table, (k, column), odds)
        mine, theirs = linear_sum_assignment(-np.maximum(table, 0.0))
        good = table[mine, theirs] > 0.0
        member = np.full(len(x), -1, dtype=np.int64)
        member[mine[good]] = names[theirs[good]]
        place = np.full(len(x), -1, dtype=np.int64)
        best = np.full(len(x), -np.inf)
        sure = self._sure(table)
        for row in np.flatnonzero(sure[k, column]).tolist():
            score = math.log(stood.p[m[row]]) + stands[row]
            if score > math.log(stood.p_away[m[row]]) + moved[row] and score > best[k[row]]:
                best[k[row]], place[k[row]] = score, m[row]
        return place, self._with_parts(member, table, names)

    def _sure(self, table: FloatArray) -> BoolArray:
        """(K, M) which landmarks are which of the map beyond doubt: whatever else they may be is far less probable."""
        floor = np.maximum(table, 0.0)
        padded = np.pad(floor, ((0, 1), (0, 1)))
        row, column = np.sort(padded[:-1], axis=1)[:, -2:], np.sort(padded[:, :-1], axis=0)[-2:]
        rival = np.maximum(
            np.where(floor == row[:, 1:], row[:, :1], row[:, 1:]), np.where(floor == column[1], column[0], column[1])
        )
        return np.asarray(table - rival > CERTAIN)

    def _with_parts(self, member: IntArray, table: FloatArray, names: IntArray) -> IntArray:
        """The same with landmarks of the session that are another part of one that is assigned: never seen with it."""
        if not len(names):
            return member
        together, found = self._found.assignment.together, member.copy()
        for k in np.flatnonzero((member < 0) & (table.max(axis=1) > 0.0)).tolist():
            one = names[np.argmax(table[k])]
            same = np.flatnonzero(found == one)
            if not together[[k]][:, same].sum():
                found[k] = one
        return found


def _squared(step: FloatArray, spread: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("ki,ki->k", step, np.linalg.solve(spread, step[..., None])[..., 0]))


def _log_density(step: FloatArray, spread: FloatArray) -> FloatArray:
    return np.asarray(-0.5 * _squared(step, spread) - 0.5 * np.linalg.slogdet(spread)[1] - math.log(2.0 * math.pi))
