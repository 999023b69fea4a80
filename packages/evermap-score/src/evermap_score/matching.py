"""What is compared with what: instants, places, one-to-one pairs, and the one alignment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from evermap_score.episodes import BoolArray, Episodes, FloatArray, IntArray, LookTable, TextArray

MATCHES = ("identity", "place")


SAME_INSTANT_S = 1e-6
"""Ends and beginnings that differ by less are the same: they were rounded."""


@dataclass(frozen=True)
class Rules:
    """The rules of a comparison.

    Attributes:
        match: 'identity' pairs landmarks of the same id, 'place' those within `match_m` of each other.
        match_m: the largest distance of a pair; .5 m is that of Khronos (Schmid et al., RSS 2024).
        same_place_m: a landmark that is farther than this from where it was has moved.
        present_p: an estimated row is a statement that the landmark is there if its probability is at least this.
        min_looks: changes are scored for landmarks with at least so many looks, one score for each number.
        gospa_c_m: the cut-off distance of GOSPA.
        in_space: whether heights are compared.
    """

    match: str = "identity"
    match_m: float = 0.5
    same_place_m: float = 0.1
    present_p: float = 0.5
    min_looks: tuple[int, ...] = (1, 3, 10)
    gospa_c_m: float = 1.0
    in_space: bool = False

    @property
    def dim(self) -> int:
        """Number of coordinates that are compared."""
        return 3 if self.in_space else 2


@dataclass(frozen=True)
class World:
    """The truth, and when it is compared.

    Attributes:
        truth: episodes.
        instants_s: sorted instants (k,) at which the world is compared.
        are_sessions: whether each instant is the end of a session, and not one between changes of the truth.
        looks: opportunities to see landmarks; None if unknown.
        rules: of the comparison.
    """

    truth: Episodes
    instants_s: FloatArray
    are_sessions: bool
    looks: LookTable | None = None
    rules: Rules = field(default_factory=Rules)

    def count_looks(self, landmark_id: str, from_s: float = -np.inf, to_s: float = np.inf) -> float:
        """Count looks at a landmark in an interval; inf if looks are unknown.

        With a column `n_looks` instead of a table, the largest number in the landmark's rows, whatever the interval.
        """
        if self.looks is not None:
            return float(self.looks.count(landmark_id, from_s, to_s))
        stated = self.truth.n_looks[self.truth.landmark_id == landmark_id]
        stated = stated[np.isfinite(stated)]
        return float(stated.max()) if len(stated) else np.inf

    def session_of(self, stamp_s: float) -> int:
        """Return the index of the session in which an instant is: the first one that ends at it or later."""
        return min(int(np.searchsorted(self.instants_s, stamp_s)), len(self.instants_s) - 1)


def choose_instants(truth: Episodes, estimates: Sequence[Episodes], looks: LookTable | None) -> tuple[FloatArray, bool]:
    """Return the instants at which the world is compared, and whether they are ends of sessions.

    They are, the first of these that there is: the ends of the sessions of the looks; the robot times of the estimates;
    the middle of every interval in which the truth is constant, with one second before the first and after the last
    bound of all tables, which are no sessions.
    """
    if looks is not None and len(ends := looks.session_ends_s()):
        return ends, True
    times = np.unique(np.concatenate([np.empty(0), *(estimate.robot_times_s() for estimate in estimates)]))
    if len(times) > 1:
        return times, True
    bounds = _finite_bounds_s([truth])
    of_all = _finite_bounds_s([truth, *estimates])
    if len(of_all) == 0:
        return np.zeros(1), False
    inner = 0.5 * (bounds[1:] + bounds[:-1])
    # what is stated late is asked for when it is stated, too
    instants = np.concatenate([[of_all[0] - 1.0], inner, [of_all[-1] + 1.0]])
    inhabited = [bool(truth.is_present(stamp_s).any()) for stamp_s in instants]
    first = int(np.argmax(inhabited))  # before the first landmark there is nothing to compare
    return instants[first:] if any(inhabited) else instants, False


def _finite_bounds_s(tables: Sequence[Episodes]) -> FloatArray:
    bounds = np.unique(np.concatenate([side for each in tables for side in (each.t_from_s, each.t_to_s)]))
    bounds = bounds[np.isfinite(bounds)]
    kept: FloatArray = bounds[np.diff(bounds, prepend=-np.inf) > SAME_INSTANT_S]
    return kept


def choose_match(truth: Episodes, estimates: Sequence[Episodes]) -> str:
    """Return 'identity' if an estimate shares an id with the truth, else 'place'."""
    known = set(truth.landmark_id.tolist())
    return "identity" if any(known & set(each.landmark_id.tolist()) for each in estimates) else "place"


def distances_m(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return all distances between points (n, d) and (m, d), as (n, m)."""
    return np.asarray(np.linalg.norm(first[:, None, :] - second[None, :, :], axis=2), dtype=np.float64)


def assign(cost: FloatArray, allowed: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the pairs of the one-to-one assignment with most allowed pairs, and of these the least total cost.

    Args:
        cost: (n, m), at least 0.
        allowed: (n, m); a pair that is not allowed is never returned.
    """
    from scipy.optimize import linear_sum_assignment

    if cost.size == 0 or not allowed.any():
        return np.empty(0, np.int64), np.empty(0, np.int64)
    forbidden = (1.0 + cost[allowed].max()) * (1.0 + min(cost.shape))  # dearer than all allowed pairs together
    rows, columns = linear_sum_assignment(np.where(allowed, cost, forbidden))
    kept = allowed[rows, columns]
    return rows[kept].astype(np.int64), columns[kept].astype(np.int64)


def pair_rows(truth: Episodes, estimate: Episodes, rules: Rules) -> tuple[IntArray, IntArray]:
    """Pair rows that are there at one instant: of the same id (if identities are compared) and within `match_m`.

    Rows of different classes are no pair, if both are known (as in Khronos).
    """
    cost = distances_m(truth.position_m[:, : rules.dim], estimate.position_m[:, : rules.dim])
    allowed = (cost <= rules.match_m) & agree_classes(truth.class_id, estimate.class_id)
    if rules.match == "identity":
        allowed &= truth.landmark_id[:, None] == estimate.landmark_id[None, :]
    return assign(cost, allowed)


def agree_classes(first: TextArray, second: TextArray) -> BoolArray:
    """Say of all pairs of classes, of (n,) and (m,), whether they are equal, or one is unknown."""
    one, other = first[:, None], second[None, :]
    return np.asarray((one == other) | (one == "") | (other == ""))


@dataclass(frozen=True)
class Alignment:
    """The rigid motion that takes an estimate to the truth.

    Attributes:
        rotation: (3, 3).
        translation_m: (3,).
        n_static: landmarks that it was computed from; 0: the frames were taken to be the same.
        rms_m: of their distances afterwards; NaN without them.
    """

    rotation: FloatArray
    translation_m: FloatArray
    n_static: int
    rms_m: float


IDENTITY = Alignment(np.eye(3), np.zeros(3), 0, float("nan"))


ROUNDS = 30
"""Of the reweighting, each a closed form; the weights change by less than a thousandth well before."""


def align(world: World, estimate: Episodes) -> Alignment:
    """Return the motion that best takes what is static in both onto each other.

    Static is a landmark that is at one place, within `same_place_m`, at all instants, in the truth and in the estimate.
    The motion minimises Huber's loss of the distances, quadratic up to `same_place_m`, so that a static landmark at a
    wrong place does not bend it: least squares (Umeyama 1991), reweighted. Without identities, or with too few static
    landmarks (2, in space 3, not in one line), the frames are taken to be the same.
    """
    rules = world.rules
    if rules.match != "identity":
        return IDENTITY
    truth_at, estimate_at = (_static_places(each, world) for each in (world.truth, estimate.latest()))
    shared = sorted(truth_at.keys() & estimate_at.keys())
    if len(shared) < rules.dim:
        return IDENTITY
    to, of = (np.array([places[name] for name in shared]) for places in (truth_at, estimate_at))
    spread = np.linalg.svd(of - of.mean(axis=0), compute_uv=False)
    if spread[rules.dim - 2] <= 1e-6 * max(spread[0], 1e-12):
        return IDENTITY
    weights, away_m = np.ones(len(shared)), np.zeros(len(shared))
    rotation, translation_m = np.eye(rules.dim), np.zeros(rules.dim)
    for _ in range(ROUNDS):
        rotation, translation_m = _fit_motion(to, of, weights)
        away_m = np.linalg.norm(of @ rotation.T + translation_m - to, axis=1)
        weights = rules.same_place_m / np.maximum(away_m, rules.same_place_m)
    whole_rotation, whole_translation_m = np.eye(3), np.zeros(3)
    whole_rotation[: rules.dim, : rules.dim], whole_translation_m[: rules.dim] = rotation, translation_m
    return Alignment(whole_rotation, whole_translation_m, len(shared), float(np.sqrt((away_m**2).mean())))


def _fit_motion(to: FloatArray, of: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the rotation and translation from points to points (n, d) with the least weighted squared distances."""
    share = weights / weights.sum()
    centre_to, centre_of = share @ to, share @ of
    u, _, vt = np.linalg.svd((to - centre_to).T @ ((of - centre_of) * share[:, None]))
    flip = np.ones(to.shape[1])
    flip[-1] = np.sign(np.linalg.det(u @ vt))
    rotation = (u * flip) @ vt
    return rotation, centre_to - rotation @ centre_of


def _static_places(table: Episodes, world: World) -> dict[str, FloatArray]:
    """Return the places of landmarks that are at one place at all instants."""
    stated = table[table.p >= world.rules.present_p]
    found = {}
    for name in np.unique(stated.landmark_id).tolist():
        rows = stated[stated.landmark_id == name]
        places = rows.position_m[:, : world.rules.dim]
        near = np.linalg.norm(places - places[0], axis=1) <= world.rules.same_place_m
        if near.all() and all(rows.is_present(stamp_s).any() for stamp_s in world.instants_s):
            found[name] = places[0]
    return found


def apply_alignment(estimate: Episodes, alignment: Alignment) -> Episodes:
    """Return an estimate in the frame of the truth."""
    return replace(estimate) if alignment.n_static == 0 else estimate.move(alignment.rotation, alignment.translation_m)
