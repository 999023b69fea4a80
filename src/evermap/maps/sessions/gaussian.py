"""Joint Gaussians of a session and of a map: the session's landmarks, the scale, and the updated places.

The poses of a session are marginalised, so nothing of it remains but the places: the cost of a map is that of its size.

Every session knows the length of a metre a little, by the priors of its range slope and wheel size. A graph whose scale
is free shrinks: smaller worlds have smaller residuals. So the scale is held inside every graph and settled outside,
where it is a one-dimensional Gaussian: with `e` the log of the map's metre over the true one and `g` that of the true
metre over the session's, how much longer the map is than the session shows `g + e`.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import softmax

from evermap.config import FitConfig, MetreConfig
from evermap.geometry import se2
from evermap.geometry.chunked import ChunkedCovariance, JointCovariance, of_places
from evermap.geometry.group import PLANE, SPACE
from evermap.geometry.rigid import rigid
from evermap.maps.living import LivingMap, Metres
from evermap.slam.batch import Outcome
from evermap.slam.problem import Marginals
from evermap.types import BoolArray, FloatArray, IntArray, landmark_id_of


def with_session(
    position_m: FloatArray,
    covariance_m2: FloatArray,
    seen: IntArray,
    session_m: FloatArray,
    session_covariance_m2: FloatArray,
    drift_m: float,
) -> tuple[FloatArray, FloatArray]:
    """Return positions and joint covariance of the old places, then of the new ones.

    What the session says of the places it saw moves those that it did not see, by their correlation.

    Args:
        position_m: (P, 2) as the map had them; with 3 for 2 in space, here and below.
        covariance_m2: (2 P, 2 P).
        seen: (K,) rows of those that the session saw.
        session_m: (K + N, 2) posterior of these, then of N new ones.
        session_covariance_m2: (2 (K + N), 2 (K + N)) joint posterior.
        drift_m: as in `drifted`, when the session was solved.

    Returns:
        (P + N, 2) and (2 (P + N), 2 (P + N)).
    """
    count, new = len(position_m), len(session_m) - len(seen)
    dim = position_m.shape[1]
    s = se2.xy_rows(seen, dim)
    k = len(s)
    u = np.setdiff1d(np.arange(dim * count), s)
    before = drifted(covariance_m2[np.ix_(s, s)], drift_m)
    gain = np.linalg.solve(before, covariance_m2[np.ix_(s, u)]).T if k else np.zeros((len(u), 0))
    mean = np.zeros(dim * (count + new))
    mean[s] = session_m[: len(seen)].ravel()
    mean[u] = position_m.ravel()[u] + gain @ (session_m[: len(seen)] - position_m[seen]).ravel()
    mean[dim * count :] = session_m[len(seen) :].ravel()
    joint = np.zeros((len(mean), len(mean)))
    place = np.concatenate([s, np.arange(dim * count, dim * (count + new))])
    joint[np.ix_(place, place)] = session_covariance_m2
    joint[np.ix_(u, u)] = covariance_m2[np.ix_(u, u)] + gain @ (session_covariance_m2[:k, :k] - before) @ gain.T
    across = gain @ session_covariance_m2[:k]
    joint[np.ix_(u, place)] = across
    joint[np.ix_(place, u)] = across.T
    return mean.reshape(-1, dim), 0.5 * (joint + joint.T)


def anchored(position_m: FloatArray, covariance_m2: FloatArray) -> FloatArray:
    """Return the joint covariance of a new map in the frame defined by its places (S-transformation).

    A session knows its landmarks in the frame of its first pose, whose heading is no better known than the robot saw.
    Later sessions would turn the whole map as they learn how the robot stood when all began, which is of no interest.
    This is the S-transformation of geodesy (Baarda 1973) to inner constraints.
    """
    if len(position_m) == 0:  # all that was seen was taken for mistakes
        return covariance_m2
    motion = _motions(position_m)
    onto = covariance_m2
    for _ in range(2):  # the second time takes what rounding has left
        onto = onto - motion @ (motion.T @ onto)
        onto = onto - (onto @ motion) @ motion.T
    return np.asarray(0.5 * (onto + onto.T))


def _motions(position_m: FloatArray) -> FloatArray:
    """(2 K, 3) orthonormal directions in which places move when all of them shift and turn; in space (3 K, 6)."""
    group = PLANE if position_m.shape[1] == PLANE.point_dim else SPACE
    middle = position_m.mean(axis=0)
    direction, size, _ = np.linalg.svd(group.rigid_directions(position_m - middle), full_matrices=False)
    return np.asarray(direction[:, size > 1e-12 * size[0]])  # places that are one have no heading


def drifted(covariance_m2: FloatArray, drift_m: float) -> FloatArray:
    """Return the joint covariance (2 K, 2 K) of places of which each may be off by `drift_m` since the map was made."""
    return np.asarray(covariance_m2 + drift_m**2 * np.eye(len(covariance_m2)))


def resize(living: LivingMap, size: Size, metres: Metres) -> LivingMap:
    """Return the map scaled by a factor about its middle, with the updated uncertainty of its scale."""
    position = living.places.position_m
    middle = position.mean(axis=0)
    return replace(
        living,
        places=replace(living.places, position_m=middle + size.map_factor * (position - middle)),
        covariance_m2=size.map_factor**2 * of_places(living.covariance_m2, np.arange(len(position))),
        log_size_variance=size.variance,
        log_size_information=size.information,
        metres=metres,
    )


USUAL = FitConfig()


@dataclass(frozen=True)
class OwnLandmarks:
    """Landmarks of a session.

    Attributes:
        row: (K,) rows of the problem's landmarks: those that were seen often enough to be believed.
        position_m: (K, 2) in the frame of the first pose.
        marginals: of the graph; `scale` of its metre.
    """

    row: IntArray
    position_m: FloatArray
    marginals: Marginals
    scale: float

    @functools.cached_property
    def covariance_m2(self) -> FloatArray:
        """(2 K, 2 K), as if its size were known."""
        return np.asarray(self.marginals.joint(self.row) * self.scale**2)

    def begun(self, rows: IntArray, most_dense: int) -> JointCovariance:
        """Return the covariance of some of them (N,) as the places of a new map, see `anchored`; more than `most_dense`
        in chunks, without the joint covariance of all.
        """
        position = self.position_m[rows]
        if len(rows) <= most_dense:
            return anchored(position, of_places(self.covariance_m2, rows))
        motion, row = _motions(position), self.row[rows]
        told = self.marginals.product(row, motion)
        both = motion.T @ told

        def joint(a: IntArray, b: IntArray) -> FloatArray:
            every, at = np.unique(np.append(a, b), return_inverse=True)
            found = self.marginals.joint(row[every])[np.ix_(se2.xy_rows(at[: len(a)]), se2.xy_rows(at[len(a) :]))]
            i, j = se2.xy_rows(a), se2.xy_rows(b)
            onto = found - motion[i] @ told[j].T - told[i] @ motion[j].T + motion[i] @ both @ motion[j].T
            return np.asarray(onto * self.scale**2)

        return ChunkedCovariance.of_points(position, joint)


def own_landmarks(outcome: Outcome, settings: FitConfig = USUAL, in_place: IntArray | None = None) -> OwnLandmarks:
    """Return the Gaussian of a session's landmarks, in its own scale: that of the map if it was solved with one.

    How many sightings make a landmark is a matter of settings: one may carry a wrong identity, which is hardly ever the
    right one of a landmark that stands where the map has it. Rows of those that do are `in_place`.
    """
    estimate = outcome.graph_estimate
    landmark = outcome.problem.landmark_row[: len(outcome.inlier)]
    n_fit = np.bincount(landmark, outcome.inlier, minlength=len(estimate.known))
    at_home = np.zeros(len(n_fit), dtype=np.bool_)
    at_home[[] if in_place is None else in_place] = True
    least = np.where(at_home, settings.sightings_in_place, settings.sightings)
    believed = estimate.known & (n_fit >= least)
    believed &= at_home | ~_misread(outcome, np.where(believed, n_fit, 0.0), settings)
    row = np.flatnonzero(believed)
    position = estimate.landmark[row] * outcome.scale
    return OwnLandmarks(row, position, outcome.graph_marginals, outcome.scale)


def _misread(outcome: Outcome, n_fit: FloatArray, settings: FitConfig) -> BoolArray:
    """(L,) landmarks that are misread detections of another one at the same place, by the inliers (L,) of each; 0 for
    those that are not believed anyway.
    """
    from scipy.spatial import cKDTree

    seen = np.flatnonzero(n_fit > 0.0)
    near = cKDTree(outcome.graph_estimate.landmark[seen] * outcome.scale).query_pairs(settings.misread_m)
    a, b = seen[np.array(sorted(near), dtype=np.int64).reshape(-1, 2)].T
    seldom, often = np.where(n_fit[a] < n_fit[b], (a, b), (b, a))
    suspected = n_fit[seldom] <= settings.misread_share * n_fit[often]
    misread = np.zeros(len(n_fit), dtype=np.bool_)
    fits = outcome.inlier >= settings.inlier
    landmark, frame = (rows[: len(fits)][fits] for rows in (outcome.problem.landmark_row, outcome.problem.pose_row))
    for one, other in zip(seldom[suspected].tolist(), often[suspected].tolist(), strict=True):
        misread[one] |= not np.isin(frame[landmark == one], frame[landmark == other]).any()
    return misread


def of_unknown_size(own: OwnLandmarks, log_sigma: float) -> FloatArray:
    """Return (2 K, 2 K) covariance with a size that is known to `log_sigma`: a longer world moves all away from the
    origin.
    """
    longer = own.position_m.ravel() * log_sigma
    return np.asarray(own.covariance_m2 + np.outer(longer, longer))


ITERATIONS = 5
USUAL_METRE = MetreConfig()
AS_GOOD = np.geomspace(0.05, 1.0, 9)
"""Candidate factors on the stated scale uncertainty, common to all robots of a map, a priori equally likely."""
UNHEARD = 1e-9
"""Information on the scale of a robot without sessions in the map."""


@dataclass(frozen=True, slots=True)
class Size:
    """Scales of a session and of a map after their comparison.

    Attributes:
        map_factor: by which the map should be longer.
        session_factor: metres of that map for one of the session's own.
        variance: of the log of the map's metre, after the session.
        information: sum of the inverse variances of all sessions that the map's metre is the mean of.
        off: standard deviations by which they differ; beyond `contradicts`, the session has the map's size.
        apart: log of the robot's metre over that of the robots together, where it has probably drifted; else 0.
    """

    map_factor: float
    session_factor: float
    variance: float
    information: float
    off: float
    apart: float = 0.0


def settled(
    log_ratio: float, ratio_variance: float, session: tuple[float, float], map_variance: float, information: float,
    settings: MetreConfig = USUAL_METRE,
) -> Size:  # fmt: skip
    """Return both scales after their comparison.

    The map's metre is the mean of those of all sessions. What one robot gets wrong about the metre it gets wrong in
    every session, so errors are taken as fully correlated: more sessions do not reduce the uncertainty. A scale that
    contradicts the map's does not change it, but halves its weight, so that a wrong first scale is corrected.

    Args:
        log_ratio: of the map's size over that of the session, as its landmarks show it.
        ratio_variance: of it.
        session: log of the true metre over the session's, by its own priors, and the standard deviation of that.
        map_variance: of the log of the map's metre over the true one.
        information: of the map so far, see `Size`.
        settings: of metres.
    """
    own, sigma = session
    before = 1.0 / (1.0 / information + settings.walk**2)
    after = 1.0 / (sigma**2 + ratio_variance)
    gain = after / (before + after)
    innovation = log_ratio - own
    off = abs(innovation) / float(np.sqrt(1.0 / before + sigma**2 + ratio_variance))
    if off > settings.contradicts:
        return Size(1.0, float(np.exp(log_ratio)), map_variance, before / 2.0, off)
    return Size(
        map_factor=float(np.exp(-gain * innovation)),
        session_factor=float(np.exp(own + innovation * sigma**2 / (1.0 / before + sigma**2 + ratio_variance))),
        variance=((1.0 - gain) * np.sqrt(map_variance) + gain * sigma) ** 2 + gain**2 * min(ratio_variance, 1.0),
        information=before + after,
        off=off,
    )


def settle_scales(
    shown: tuple[float, float], session: tuple[float, float], living: LivingMap, robot: str,
    settings: MetreConfig = USUAL_METRE,
) -> tuple[Size, Metres]:  # fmt: skip
    """Return both scales after comparing a session of a robot with the map, and the updated scale of each robot.

    Errors of the metre are a robot's, alike in all its sessions. So each robot has the mean of its sessions, as
    `settled` has it, and the map what its robots have together (`agreed`), however long each of them drives.

    Shown is the log of the map's size over that of the session, and its variance (`log_ratio`); the session's own metre
    is as of `settled`. The robot is '' where nobody said whose session it is.
    """
    metres, name = living.metres, landmark_id_of(robot) if robot else 0
    if not robot and not len(metres):
        return settled(*shown, session, living.log_size_variance, living.log_size_information, settings), metres
    if not len(metres):  # sessions without a name, or a survey
        metres = Metres.of("", living.log_size_variance, living.log_size_information)
    if name not in metres.robot_id:
        metres = metres.joined(Metres.of(robot, session[1] ** 2, UNHEARD))
    row = int(np.flatnonzero(metres.robot_id == name)[0])
    log_metre, variance, information = (
        column.copy() for column in (metres.log_metre, metres.log_variance, metres.information)
    )
    own = settled(shown[0] + log_metre[row], shown[1], session, variance[row], information[row], settings)
    log_metre[row] += np.log(own.map_factor)
    variance[row], information[row] = own.variance, own.information
    middle, p_drifted = agreed(log_metre, np.sqrt(variance), settings)
    size = Size(
        map_factor=float(np.exp(middle)),
        session_factor=float(own.session_factor * np.exp(middle - log_metre[row])),
        variance=float(np.average(np.sqrt(variance), weights=1.0 / np.maximum(variance, settings.walk**2))) ** 2,
        information=own.information,
        off=own.off,
        apart=float(log_metre[row] - middle) if p_drifted[row] > settings.p_told else 0.0,
    )
    return size, Metres(metres.robot_id, log_metre - middle, variance, information)


def agreed(log_metre: FloatArray, sigma: FloatArray, settings: MetreConfig = USUAL_METRE) -> tuple[float, FloatArray]:
    """Return the scale on which robots agree, and for each of them the probability that its own has drifted, by the log
    metre of each (R,), and its standard deviation by its priors.

    The metre of a robot is off by what its priors say, or, as robots of one make may agree better than that, by a share
    of it that is one for all; that of a robot that has drifted, by some times more, whatever the share. Metre (with a
    flat prior) and share are integrated over. So one robot in five that is off by no more than its priors allow is told
    by the agreement of the others, and where robots scatter as they are said to, their mean counts.
    """
    if len(log_metre) == 1:
        return float(log_metre[0]), np.zeros(1)
    sigma = np.maximum(sigma, settings.walk)
    beyond = 2.0 * sigma.max()
    metre = np.linspace(log_metre.min() - beyond, log_metre.max() + beyond, 1201)
    squared = (log_metre - metre[:, None]) ** 2
    variance = (AS_GOOD[:, None, None] * sigma) ** 2 + settings.walk**2
    sound = np.log(1.0 - settings.p_drifted) - 0.5 * (np.log(variance) + squared / variance)
    variance = (settings.drifted * sigma) ** 2
    drifted = np.log(settings.p_drifted) - 0.5 * (np.log(variance) + squared / variance)
    either = np.logaddexp(sound, drifted)
    weight = softmax(either.sum(axis=2))
    return float(weight.sum(axis=0) @ metre), np.einsum("sm,smr->r", weight, np.exp(drifted - either))


def log_ratio(
    session_m: FloatArray, session_m2: FloatArray, map_m: FloatArray, map_m2: FloatArray
) -> tuple[float, float]:
    """Return the log of the map's scale over the session's, and its variance: a similarity by generalised least
    squares.

    Of landmarks (K, 2) with covariance (2 K, 2 K), in the session's frame and metres, the scale held, and in the map.
    Where residuals are larger than the covariances allow, as in a session that is bent, the variance grows with them.
    """
    middle = session_m.mean(axis=0)
    if not (session_m != middle).any():  # a point has no size
        return 0.0, np.inf
    near_m, map_m = session_m - middle, map_m - map_m.mean(axis=0)
    # linear in (x, y, b, a): a similarity scales by hypot(a, b), and turns by atan2(b, a)
    columns = np.column_stack([se2.rigid_directions(near_m), near_m.ravel()])
    angle = rigid(near_m, map_m)[2]
    a, b = np.sqrt((map_m**2).sum() / (near_m**2).sum()) * np.array([np.cos(angle), np.sin(angle)])
    log_size, variance = 0.0, np.inf
    for _ in range(ITERATIONS):
        turn = np.kron(np.eye(len(near_m)), np.array([[a, -b], [b, a]]))
        weighed = np.linalg.solve(turn @ session_m2 @ turn.T + map_m2, np.column_stack([columns, map_m.ravel()]))
        information = columns.T @ weighed[:, :4]
        found = np.linalg.solve(information, columns.T @ weighed[:, 4])
        squared = float((map_m.ravel() - columns @ found) @ (weighed[:, 4] - weighed[:, :4] @ found))
        change, (b, a) = np.abs(found[2:] - (b, a)).max(), found[2:]
        log_size, by = float(np.log(np.hypot(a, b))), np.array([0.0, 0.0, b, a]) / (a**2 + b**2)
        variance = float(by @ np.linalg.solve(information, by)) * max(1.0, squared / max(len(columns) - 4, 1))
        if change < 1e-9:
            break
    return log_size, variance
