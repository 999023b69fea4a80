"""Alignment of a session with the map, and its solution with the matched places as a prior."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from scipy import sparse
from scipy.special import logsumexp

from evermap.align.candidates import Matches, find_consensus
from evermap.config import FitConfig, LivingConfig, OverlayConfig
from evermap.estimate.sparse.system import exhaust
from evermap.geometry import se2, se3
from evermap.geometry.chunked import of_places
from evermap.geometry.rigid import rigid
from evermap.geometry.symmetry import Symmetries
from evermap.maps.bodies import log_density
from evermap.maps.living import LivingMap, Places, rows_among
from evermap.maps.sessions.overlay import ELSEWHERE, Known, Sighted, lay_over
from evermap.maps.vicinity import Vicinity, near
from evermap.slam.batch import ALIGNED_INFORMATION, FINAL_GAIN, FINAL_TOLERANCE, Outcome, divided, sight_at
from evermap.slam.calibration import FORWARD, SLOPE, CalibrationPrior
from evermap.slam.kernels import N_STATES
from evermap.slam.problem import Estimate, Marginals, Noise, Problem
from evermap.slam.smoother import Smoother
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray, Sensor

VisitT = TypeVar("VisitT")
USUAL = FitConfig()
NOT_FOUND = (
    "too few of the detected landmarks have the relative positions of the map",
    "begin another map with it, or first enter a session that overlaps both",
)
ANYWAY = (
    "`evermap check` names problems; `--set living.search=gate` enters it anyway, by the alignment with most agreement"
)
CONTRADICTED = (
    "most sightings contradict the map or each other; the session is distorted, or from another place",
    ANYWAY,
)
DISTORTED = "most sightings contradict each other; the session is distorted", ANYWAY
"""Why a session cannot be localised in a map, and what to try."""
SMALLEST_P = 1e-6
BENT_ROUNDS = 5
"""Refits of that motion to the bodies that agree with it."""


@dataclass(frozen=True, slots=True)
class Laid:
    """Matches of the landmarks of a session in the map.

    Attributes:
        landmark_id: (K,) landmarks of the session, sorted.
        pose_map_session: (3,) motion from the session's frame to the map's.
        place: (K,) row of the map's places, `ELSEWHERE` if a landmark is at none of its own, or is new.
        probability: (K,) of that.
        drift_m: standard deviation of unmoved landmarks between sessions.
        assumed: (K,) those that seem to have moved and are taken to stand, since the session seems bent; see `unbent`.
        reason: why the alignment isn't accepted, empty where it is.
    """

    landmark_id: IntArray
    pose_map_session: FloatArray
    place: IntArray
    probability: FloatArray
    drift_m: float
    assumed: BoolArray
    reason: str = ""


def places_in(where: Laid | None, landmark_id: IntArray) -> tuple[IntArray, FloatArray]:
    """Return (N,) places of landmarks of a session, and their probabilities; -1 and 1 for those that have none."""
    place, probability = np.full(len(landmark_id), -1, dtype=np.int64), np.ones(len(landmark_id))
    if where is not None:
        _, here, there = np.intersect1d(landmark_id, where.landmark_id, return_indices=True)
        place[here], probability[here] = where.place[there], where.probability[there]
    return place, probability


@dataclass(frozen=True, slots=True)
class Localised(Generic[VisitT]):
    """A session in a map.

    Attributes:
        visit: the session, solved with the map as its prior; by itself where it is lost, or begins a map.
        living: the map, or the part of it that the session can touch.
        where: the session lies in it; None where it is lost, or begins a map.
        vicinity: that part; None for the whole.
        reason: why it is lost, and what to try; empty where it is not.
    """

    visit: VisitT
    living: LivingMap
    where: Laid | None = None
    vicinity: Vicinity | None = None
    reason: tuple[str, ...] = ()

    @classmethod
    def lost(cls, visit: VisitT, living: LivingMap, reason: tuple[str, str]) -> Localised[VisitT]:
        """Return a session that cannot be localised."""
        return cls(visit, living, reason=reason)


class Turned(NamedTuple):
    """Orientations of the landmarks of a session in space with a known approximate alignment.

    Attributes:
        pose_map_session: (7,) where.
        rotation: (K, 4) quaternions in its frame, nan of points.
        covariance: (K, 3, 3) of them, in the landmarks' own axes [rad^2].
        symmetries: (K,) turns after which they look the same.
    """

    pose_map_session: FloatArray
    rotation: FloatArray
    covariance: FloatArray
    symmetries: Symmetries

    def log_odds(self, landmark: IntArray, places: Places, settings: OverlayConfig) -> FloatArray:
        """Return (P,) log likelihood ratio of orientations of landmarks (P,) at places, 'unmoved' over 'moved'.

        By how much unmoved ones seem turned is common to those of a session, and shows in all the others: where these
        are within a degree of the map, one that is off by twenty has been turned.
        """
        turn = se3.compose(self.pose_map_session, _turns(self.rotation[landmark]))
        known_turn = self.symmetries[landmark].nearest(_turns(places.rotation), turn)
        off = se3.local(known_turn, turn)[:, 3:]
        known = np.isfinite(places.rotation[:, 0]) & np.isfinite(self.rotation[landmark, 0])
        spread = np.where(known[:, None, None], self.covariance[landmark] + places.rotation_covariance, np.eye(3))

        stood, moved = (
            log_density(off, spread + np.square(sigmas_rad)[:, None, None, None] * np.eye(3))
            for sigmas_rad in (settings.stood_rad, settings.turned_rad)
        )
        log_moved = logsumexp(moved, axis=0) - np.log(len(moved))
        own = np.zeros((len(self.rotation), len(stood)))  # what each landmark says of the levels
        np.add.at(own, landmark, np.where(known, np.logaddexp(stood, log_moved), 0.0).T)
        by_others = (own.sum(axis=0) - own)[landmark].T
        log_stood = logsumexp(stood + by_others, axis=0) - logsumexp(by_others, axis=0)
        return np.where(known, log_stood - log_moved, 0.0)


def _turns(rotation: FloatArray) -> FloatArray:
    """Poses (K, 7) at the origin with orientations (K, 4); of nan with none."""
    return se3.turn(np.where(np.isfinite(rotation[:, :1]), rotation, se3.NO_TURN))


def lay_over_map(
    living: LivingMap,
    p_site: FloatArray,
    landmark_id: IntArray,
    position_m: FloatArray,
    covariance_m2: FloatArray,
    config: LivingConfig,
    turned: Turned | None = None,
) -> Laid | None:
    """Align landmarks (K,) of a session with the map; None if none match.

    By the probability (S,) of the map's sites at the beginning of the session, and positions (K, 2) in its own frame
    with covariance (2 K, 2 K), in space with 3 for 2, where it lies about as `turned` tells.
    """
    members, places, sites = living.members, living.places, living.sites
    at = rows_among(members.landmark_id, landmark_id)
    seen = np.flatnonzero(at >= 0)
    used = np.flatnonzero(np.isin(places.landmark_id, landmark_id[seen]))
    landmark = np.searchsorted(landmark_id[seen], places.landmark_id[used])
    if len(used) < 2:
        return None
    _, first, clique = np.unique(members.clique_id[at[seen]], return_index=True, return_inverse=True)
    used_sites, site = np.unique(places.site_id[used], return_inverse=True)
    site_rows = np.searchsorted(sites.site_id, used_sites)
    log_turned = np.zeros(len(used))
    if turned is not None:
        log_turned = turned.log_odds(seen[landmark], places[used], config.overlay)
    found = lay_over(
        Sighted(position_m[seen], of_places(covariance_m2, seen, living.dim), clique.ravel().astype(np.int64)),
        Known(
            position_m=places.position_m[used],
            covariance_m2=of_places(living.covariance_m2, used, living.dim),
            landmark=landmark,
            site=site.ravel().astype(np.int64),
            log_p_site=np.log(np.maximum(p_site[site_rows], SMALLEST_P)),
            log_p_elsewhere=np.log(np.maximum(1.0 - living.p_of_sites(p_site)[at[seen[first]]], SMALLEST_P)),
            log_turned=log_turned,
        ),
        config.search,
        config.overlay,
        None if turned is None else turned.pose_map_session,
        config.grouping.p_one_body,
    )
    if found is None:
        return None
    place = np.full(len(landmark_id), ELSEWHERE, dtype=np.int64)
    place[seen] = np.where(found.place >= 0, used[found.place], ELSEWHERE)
    probability = np.ones(len(landmark_id))
    probability[seen] = found.probability
    assumed = np.zeros(len(place), dtype=np.bool_)
    return Laid(landmark_id, found.pose_map_session, place, probability, found.drift_m, assumed, found.reason)


def unbent(
    living: LivingMap,
    p_site: FloatArray,
    where: Laid,
    position_m: FloatArray,
    together: sparse.csr_array,
    settings: FitConfig = USUAL,
) -> Laid:
    """Return the alignment of a distorted session: a part of it fits the map, too, but by another rigid motion.

    One wrong identity after a blind stretch may turn all that follows. Then everything seen there seems to have moved,
    by one and the same motion, which things that really move do not. Such landmarks are laid at their places again, and
    the session is straightened when it is solved with the map. What moved alike in the midst of things that stand has
    moved: a bend takes all that is in view along, as told by the frames in which two landmarks were seen `together` (K,
    K). Positions (K, 2) are in the session's frame, and beliefs (S,) those in the map's sites.
    """
    home = homes(living, p_site, where)
    moved, stands = np.flatnonzero((where.place < 0) & (home >= 0)), np.flatnonzero(where.place >= 0)
    places, body = living.places, living.members.clique_id[rows_among(living.members.landmark_id, where.landmark_id)]
    place, probability = where.place.copy(), where.probability.copy()
    while len(moved):
        motion, agree = find_consensus(Matches.of(position_m[moved], places.position_m[home[moved]]))
        gap = np.full(len(moved), np.inf)
        for _ in range(BENT_ROUNDS):
            if np.count_nonzero(agree) < 2:
                break
            motion = rigid(position_m[moved[agree]], places.position_m[home[moved[agree]]])
            rest = places.position_m[home[moved]] - se2.transform(motion, position_m[moved])
            gap = np.hypot(*rest.T)
            agree = gap < max(settings.bent_m, float(np.median(gap[agree])))
        agree &= gap < settings.bent_m
        fits = moved[agree]
        if len(np.unique(body[fits])) < settings.bent_cliques:
            break
        beside = together[fits]
        if beside[:, stands].sum() <= beside[:, fits].sum() - together.diagonal()[fits].sum():
            place[fits], probability[fits] = home[fits], 1.0
        moved = moved[~agree]
    return replace(where, place=place, probability=probability, assumed=(where.place < 0) & (place >= 0))


def homes(living: LivingMap, p_site: FloatArray, where: Laid) -> IntArray:
    """Return (K,) rows of the map's places at which landmarks are most probably expected; -1 for none."""
    site = living.site_of(p_site)
    at = rows_among(living.members.landmark_id, where.landmark_id)
    return np.where(at >= 0, living.place_row(where.landmark_id, site[at]), -1)


def with_glimpsed(living: LivingMap, where: Laid, landmark_id: IntArray) -> Laid:
    """Return rarely seen landmarks (K,), assigned to the sites that others of their body occupy.

    Whether their sightings fit there is seen when the session is solved with the map.
    """
    members, places = living.members, living.places
    names = np.intersect1d(landmark_id, members.landmark_id)
    laid = where.place >= 0
    body = members.clique_id[np.searchsorted(members.landmark_id, where.landmark_id[laid])]
    stands = dict(zip(body.tolist(), places.site_id[where.place[laid]].tolist(), strict=True))
    clique = members.clique_id[np.searchsorted(members.landmark_id, names)]
    place = living.place_row(names, np.array([stands.get(c, UNKNOWN) for c in clique.tolist()], dtype=np.int64))
    names, place = names[place >= 0], place[place >= 0]
    order = np.argsort(np.concatenate([where.landmark_id, names]), kind="stable")
    return replace(
        where,
        landmark_id=np.concatenate([where.landmark_id, names])[order],
        place=np.concatenate([where.place, place])[order],
        probability=np.concatenate([where.probability, np.ones(len(names))])[order],
        assumed=np.concatenate([where.assumed, np.zeros(len(names), dtype=np.bool_)])[order],
    )


def widened(
    living: LivingMap,
    part: LivingMap,
    named: IntArray,
    where: Laid,
    path_m: FloatArray,
    sensor: Sensor,
    config: LivingConfig,
) -> tuple[Vicinity, Laid]:
    """Return the part of a large map that a session can touch, and where it lies there, if it lies in a `part` of the
    map.

    That are cliques that are named, and what the sensor may have seen on its path (N, 2 or 3).
    """
    reach_m = sensor.range_max_m + config.near_m
    cliques, box = living.sites.clique_id, np.array([-np.inf, -np.inf, np.inf, np.inf])
    if np.isfinite(reach_m):  # else all there is may be in view
        cliques, box = near(living, path_m, reach_m)
    vicinity = Vicinity.of(living, np.union1d(named, cliques), config, box)
    at, place = where.place >= 0, where.place.copy()
    places = part.places[place[at]]
    place[at] = vicinity.part.place_row(places.landmark_id, places.site_id)
    return vicinity, replace(where, place=place)


HEAVY_STEPS = 6
PLACING_ROUNDS = 10
"""Reweighted rigid fits by which a pose is placed in the map."""


class Held(NamedTuple):
    """Landmarks constrained by a map.

    Attributes:
        row: (K,) landmarks of the problem that are at places of the map.
        mean_m: (K, 2) positions of these places.
        covariance_m2: (2 K, 2 K) joint covariance of them.
    """

    row: IntArray
    mean_m: FloatArray
    covariance_m2: FloatArray


def refitted(
    outcome: Outcome,
    prior: CalibrationPrior,
    pose_map_session: FloatArray,
    size: float,
    held: Held,
    *,
    settings: FitConfig = USUAL,
    robust: bool,
) -> tuple[Outcome, bool]:
    """Return the session solved in the frame of the map, and whether it had to be corrected for a distortion.

    Its own frame is in the map at (3,), and `size` metres of the map are one of its graph. A robust solution explains
    outliers.

    Raises:
        NumericalError: no finite optimum.
    """
    problem, start = _in_map(outcome, prior, pose_map_session, size, held)
    noise = outcome.noise.noise
    solved = smoother, estimate, _ = _solve_near(problem, noise, start, robust=robust)
    straightened = False
    if smoother.inlier_probability(estimate).mean() < (1.0 - settings.most_lost) * outcome.inlier.mean():
        # a blind stretch bent the session by more than a descent can take back: every stretch placed by itself
        other = _solve_near(problem, noise, _place_poses(problem, start, held.row, settings), robust=robust)
        if other[0].cost(other[1]) < smoother.cost(estimate):
            solved, straightened = other, True
    in_map = divided(solved, prior, outcome.p_needed, outcome.noise, outcome.revision, aligned=True, averaged=False)
    return in_map, straightened


def _in_map(
    outcome: Outcome, prior: CalibrationPrior, pose_map_session: FloatArray, size: float, held: Held
) -> tuple[Problem, Estimate]:
    """The problem of a session with the map as its prior, and where to start; arguments as of `refitted`."""
    row, mean_m, covariance_m2 = held
    count = len(outcome.problem.landmark_mean)
    mean, information = np.zeros((count, 2)), np.zeros((2 * count, 2 * count))
    at = se2.xy_rows(row)
    mean[row] = mean_m
    information[np.ix_(at, at)] = np.linalg.inv(covariance_m2)
    own = outcome.graph_estimate
    stretch = np.array([size, size, 1.0])
    landmark = se2.transform(pose_map_session, own.landmark * size)
    landmark[row] = mean_m
    states, prior = own.states.copy(), prior.without_scale()
    if not prior.free[SLOPE]:  # held, in the map's metres
        states[SLOPE] = (1.0 + prior.mean[SLOPE]) / size - 1.0
        states[FORWARD] *= size
        prior = replace(prior, mean=np.where(np.arange(N_STATES) == SLOPE, states[SLOPE], prior.mean))
    start = Estimate(se2.compose(pose_map_session, own.pose * stretch), landmark, states)
    problem = replace(
        outcome.problem,
        prior=prior,
        start_pose=start.pose[0],
        start_information=ALIGNED_INFORMATION,
        landmark_mean=mean,
        landmark_information=sparse.csr_array(information),
    )
    return problem, start


def _solve_near(
    problem: Problem, noise: Noise, start: Estimate, *, robust: bool
) -> tuple[Smoother, Estimate, Marginals]:
    """The optimum near `start`, and its covariances."""
    # first with the kernel that never lets go: what was near the session's own map need not be near this one
    near = Smoother(problem, noise, heavy=True, robust=robust)
    start, _ = exhaust(near.solve_in_slices(start, iterations=HEAVY_STEPS, tolerance=1e-3))
    smoother = near.under(noise, heavy=False)
    return smoother, *exhaust(smoother.solve_in_slices(start, tolerance=FINAL_TOLERANCE, settled=FINAL_GAIN))


def _place_poses(problem: Problem, start: Estimate, row: IntArray, settings: FitConfig) -> Estimate:
    """`start` with every pose where the sightings around it show the landmarks `row` (K,) of the map.

    Each pose is moved by the rigid motion that brings these sightings, as the poses nearby have them, onto the
    landmarks; reweighted, since some carry wrong identities and some belong to the other side of a bend.
    """
    held = np.zeros(len(start.landmark), dtype=np.bool_)
    held[row] = True
    used = np.flatnonzero(held[problem.landmark_row])
    if len(used) < 2:
        return start
    seen_m = sight_at(start.pose[problem.pose_row], problem.reading, start.states, problem.mount)
    middle = np.searchsorted(problem.pose_row[used], np.arange(len(start.pose)))
    count = settings.window
    first = np.clip(middle - count // 2, 0, max(len(used) - count, 0))
    window = used[np.minimum(first[:, None] + np.arange(count), len(used) - 1)]
    a, b = seen_m[window], start.landmark[problem.landmark_row[window]]
    weight = np.ones(window.shape)
    for _ in range(PLACING_ROUNDS):
        motion = rigid(a, b, weight)
        gap = np.hypot(*np.moveaxis(se2.transform(motion[:, None, :], a) - b, -1, 0))
        weight = 1.0 / (1.0 + (gap / settings.placing_m) ** 2)
    pose = se2.compose(motion, start.pose)
    landmark = start.landmark.copy()
    anew = sight_at(pose[problem.pose_row], problem.reading, start.states, problem.mount)
    for j in np.setdiff1d(problem.landmark_row, row):
        landmark[j] = np.median(anew[problem.landmark_row == j], axis=0)
    return Estimate(pose, landmark, start.states)


def one_to_one(odds: FloatArray) -> IntArray:
    """Return (K,) columns of odds (K, N) that rows are assigned to, with most positive odds in sum; -1 for none."""
    from scipy.optimize import linear_sum_assignment

    row, column = linear_sum_assignment(-np.maximum(odds, 0.0))
    assigned = np.full(len(odds), -1, dtype=np.int64)
    good = odds[row, column] > 0.0
    assigned[row[good]] = column[good]
    return assigned
