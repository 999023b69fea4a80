"""Changes, derived from episodes: by kind, their displacement, and how long they took to be stated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from evermap_score.episodes import BoolArray, Episodes, FloatArray, IntArray
from evermap_score.matching import World, agree_classes, assign, distances_m
from evermap_score.metric import Metric, f1_of, metric_of_rows, ratio, root_of_ratio

KINDS = ("moved", "vanished", "appeared", "returned", "exchanged")
SIGMAS = 3.0


@dataclass(frozen=True)
class Change:
    """One landmark that differs between two instants.

    Attributes:
        kind: one of `KINDS`.
        landmark_id: of the table it was derived from.
        session: index of the later instant.
        stamp_s: when: the end of the old episode if it vanished, else the beginning of the new one.
        before_m, after_m: places (3,); None where it was absent.
        before_covariance_m2, after_covariance_m2: (3, 3) of these; NaN if unknown.
        class_id: empty if unknown.
    """

    kind: str
    landmark_id: str
    session: int
    stamp_s: float
    before_m: FloatArray | None
    after_m: FloatArray | None
    before_covariance_m2: FloatArray | None
    after_covariance_m2: FloatArray | None
    class_id: str


def derive_changes(table: Episodes, world: World, until_s: float = np.inf) -> list[Change]:
    """Return what differs between successive instants of the world, landmark by landmark.

    A landmark that is there at both instants, farther than `same_place_m` from where it was, *moved*; one that is there
    at the first only *vanished*, at the second only *appeared*, or *returned* if it was there at an earlier instant,
    wherever it is now. Where one leaves a place and another arrives at it between the same instants, both are
    *exchanged*. What begins and ends between two sessions is no change; without sessions each row of the table counts.
    What was there at the first instant did not appear. Of several rows of a landmark at one instant the most probable
    counts.

    Args:
        table: episodes; those below `present_p` are left out.
        world: its instants and rules.
        until_s: later instants are left out.
    """
    stated = table[table.p >= world.rules.present_p]
    changes: list[Change] = []
    rows_of: dict[str, list[int]] = {}
    for row, name in enumerate(stated.landmark_id.tolist()):
        rows_of.setdefault(name, []).append(row)
    for name, rows in rows_of.items():
        rows.sort(key=lambda row: -float(stated.p[row]))
        instants_s = world.instants_s if world.are_sessions else _with_own_instants(stated, rows, world)
        was: int | None = None
        was_seen = False
        for k, stamp_s in enumerate(instants_s[instants_s <= until_s].tolist()):
            now = next((row for row in rows if stated.t_from_s[row] <= stamp_s < stated.t_to_s[row]), None)
            if k > 0 and (change := _compare(stated, name, world.session_of(stamp_s), (was, now), was_seen, world)):
                changes.append(change)
            was, was_seen = now, was_seen or now is not None
    return _mark_exchanges(changes, world)


def _with_own_instants(table: Episodes, rows: Sequence[int], world: World) -> FloatArray:
    """Return the instants of the world, with one within each row and one after the last, not before the world's first.

    So nothing that a table states falls between two instants, but for an absence: it counts if the world has an instant
    within it, and else is the time that a move took.
    """
    own = []
    for row in rows:
        start, end = float(table.t_from_s[row]), float(table.t_to_s[row])
        if np.isfinite(start):
            own.append(0.5 * (start + end) if np.isfinite(end) else start + 1.0)
    ends = table.t_to_s[list(rows)]
    if np.isfinite(ends.max()):
        own.append(float(ends.max()) + 1.0)
    later = [stamp_s for stamp_s in own if stamp_s > world.instants_s[0]]
    return np.unique(np.concatenate([world.instants_s, later]))


def _compare(
    table: Episodes, name: str, session: int, rows: tuple[int | None, int | None], was_seen: bool, world: World
) -> Change | None:
    was, now = rows
    if was is None and now is None:
        return None
    before, after = (None if row is None else table.position_m[row] for row in (was, now))
    if before is not None and after is not None:
        if np.linalg.norm((after - before)[: world.rules.dim]) <= world.rules.same_place_m:
            return None
        kind = "moved"
    else:
        kind = "vanished" if now is None else "returned" if was_seen else "appeared"
    row = was if now is None else now
    assert row is not None
    return Change(
        kind,
        name,
        session,
        float(table.t_to_s[row] if now is None else table.t_from_s[row]),
        before,
        after,
        None if was is None else table.covariance_m2[was],
        None if now is None else table.covariance_m2[now],
        str(table.class_id[row]),
    )


def _mark_exchanges(changes: Sequence[Change], world: World) -> list[Change]:
    """Return the changes, those of which one left a place at which the other arrived as exchanged."""
    marked = list(changes)
    of_session: dict[int, list[int]] = {}
    for i, change in enumerate(changes):
        of_session.setdefault(change.session, []).append(i)
    for members in of_session.values():
        left = [i for i in members if changes[i].before_m is not None]
        came = [i for i in members if changes[i].after_m is not None]
        away = distances_m(_places([changes[i].before_m for i in left], world),
                           _places([changes[i].after_m for i in came], world))  # fmt: skip
        for row, column in zip(*(side.tolist() for side in np.nonzero(away <= world.rules.same_place_m)), strict=True):
            i, j = left[row], came[column]
            if changes[i].landmark_id != changes[j].landmark_id:
                marked[i], marked[j] = replace(marked[i], kind="exchanged"), replace(marked[j], kind="exchanged")
    return marked


def _places(places: Sequence[FloatArray | None], world: World) -> FloatArray:
    """Return places (n, d); NaN where there is none."""
    dim = world.rules.dim
    listed = [np.full(dim, np.nan) if place is None else place[:dim] for place in places]
    return np.array(listed, dtype=np.float64).reshape(-1, dim)


def match_changes(truth: Sequence[Change], estimate: Sequence[Change], world: World) -> tuple[IntArray, IntArray]:
    """Pair changes one to one: of the same kind and, by the rules, the same landmark or the same places.

    By identity the places do not matter: their errors are scored by themselves. By place, the place before and the
    place after must both be within `match_m`, where there is one, and the classes equal where both are known. Of
    several pairings, one with most pairs and of these the least total difference of times.
    """
    rows, columns = [], []
    for kind in KINDS:
        ones = [i for i, change in enumerate(truth) if change.kind == kind]
        others = [j for j, claim in enumerate(estimate) if claim.kind == kind]
        if not ones or not others:
            continue
        of_kind, claims = [truth[i] for i in ones], [estimate[j] for j in others]
        times = [np.array([_time_of(change, world) for change in side]) for side in (of_kind, claims)]
        pairs = assign(np.abs(times[0][:, None] - times[1][None, :]), _may_be(of_kind, claims, world))
        rows += [ones[i] for i in pairs[0]]
        columns += [others[j] for j in pairs[1]]
    return np.array(rows, np.int64), np.array(columns, np.int64)


def _time_of(change: Change, world: World) -> float:
    """Return when a change was; where that is unknown, the instant at which it was there."""
    return change.stamp_s if np.isfinite(change.stamp_s) else float(world.instants_s[change.session])


def _may_be(truth: Sequence[Change], claims: Sequence[Change], world: World) -> BoolArray:
    """Say of all pairs (n, m) of changes of one kind whether they may be the same."""
    if world.rules.match == "identity":
        one, other = (np.array([change.landmark_id for change in side]) for side in (truth, claims))
        return np.asarray(one[:, None] == other[None, :])
    allowed = agree_classes(*(np.array([change.class_id for change in side], np.str_) for side in (truth, claims)))
    for field in ("before_m", "after_m"):
        one, other = (_places([getattr(change, field) for change in side], world) for side in (truth, claims))
        both_absent = np.isnan(one[:, :1]) & np.isnan(other[:, 0])
        allowed = allowed & (both_absent | (distances_m(one, other) <= world.rules.match_m))
    return np.asarray(allowed)


def _are_near(one: FloatArray | None, other: FloatArray | None, world: World) -> bool:
    if one is None or other is None:
        return one is other
    return bool(np.linalg.norm((one - other)[: world.rules.dim]) <= world.rules.match_m)


def _square_in_sigmas(error_m: FloatArray, covariance_m2: FloatArray) -> float:
    """Return the squared Mahalanobis distance (d,), (d, d); NaN if the covariance is unknown or singular."""
    if not np.isfinite(covariance_m2).all():
        return float("nan")
    try:
        return float(error_m @ np.linalg.solve(covariance_m2, error_m))
    except np.linalg.LinAlgError:
        return float("nan")


def _is_within_sigmas(true: Change, claim: Change, dim: int) -> bool:
    """Say whether each place of a claim is within 3 sigma of the true one; where sigma is unknown it is not."""
    for truth_m, place_m, covariance_m2 in (
        (true.before_m, claim.before_m, claim.before_covariance_m2),
        (true.after_m, claim.after_m, claim.after_covariance_m2),
    ):
        if truth_m is None:
            continue
        if place_m is None or covariance_m2 is None:
            return False
        if not _square_in_sigmas((place_m - truth_m)[:dim], covariance_m2[:dim, :dim]) <= SIGMAS**2:
            return False
    return True


def count_looks_since(changes: Sequence[Change], world: World) -> list[float]:
    """Return for each true change the looks at its landmark since then and before its next one; inf if unknown."""
    looks = []
    for change in changes:
        later = [c.stamp_s for c in changes if c.landmark_id == change.landmark_id and c.stamp_s > change.stamp_s]
        looks.append(world.count_looks(change.landmark_id, change.stamp_s, min(later, default=np.inf)))
    return looks


def change_metrics(world: World, estimate: Episodes) -> list[Metric]:
    """Return the metrics of changes of the estimate's last map.

    A claim of a change that was never looked at is false, whatever the truth; `changes/never_looked/...` says how many
    there are and how often one was claimed. Changes with fewer looks than a threshold, and what was claimed of them,
    are left out of the score of that threshold. Where looks are unknown there is one score, of all changes. A claim
    counts for `f1_within_3_sigma` only if each of its places is within `match_m` and three of its own standard
    deviations of the true one.

    Args:
        world: with the truth.
        estimate: aligned with it.
    """
    dim = world.rules.dim
    truth, claims = derive_changes(world.truth, world), derive_changes(estimate.latest(), world)
    looks = count_looks_since(truth, world)
    pairs = dict(zip(*(side.tolist() for side in match_changes(truth, claims, world)), strict=True))
    unpaired = [claim for j, claim in enumerate(claims) if j not in set(pairs.values())]
    metrics = []
    are_known = world.looks is not None or bool(np.isfinite(world.truth.n_looks).any())
    have_sigmas = bool(np.isfinite(estimate.covariance_m2[:, 0, 0]).any())
    for least in world.rules.min_looks if are_known else (0,):
        # kind, session, landmark, true, false, missed, true within sigmas
        rows: list[tuple[str, int, str, float, float, float, float]] = []
        for i, change in enumerate(truth):
            where = (change.kind, change.session, change.landmark_id)
            if looks[i] == 0:
                rows.append((*where, 0.0, float(i in pairs), 0.0, 0.0))
            elif looks[i] >= least:
                found = float(i in pairs)
                within = float(i in pairs and _is_good(change, claims[pairs[i]], world))
                rows.append((*where, found, 0.0, 1.0 - found, within))
        rows += [(claim.kind, claim.session, claim.landmark_id, 0.0, 1.0, 0.0, 0.0) for claim in unpaired]
        for kind in (*KINDS, "all"):
            items = [row[1:3] + (row[3:],) for row in rows if kind in (row[0], "all")]
            name = f"changes/{kind}/{least}_looks" if are_known else f"changes/{kind}/any_looks"
            for part, of_sums in (
                ("precision", ratio([0], [0, 1])), ("recall", ratio([0], [0, 2])), ("f1", f1_of(0, 1, 2)),
            ):  # fmt: skip
                metrics.append(metric_of_rows(f"{name}/{part}", "", items, 4, of_sums=of_sums))
            if kind == "all":  # without covariances there is nothing to say
                known = items if have_sigmas else []
                metrics.append(metric_of_rows(f"{name}/f1_within_3_sigma", "", known, 4, of_sums=_f1_within))
    never = [
        (change.session, change.landmark_id, (1.0, float(i in pairs)))
        for i, change in enumerate(truth)
        if looks[i] == 0
    ]
    metrics.append(metric_of_rows("changes/never_looked/count", "", never, 2, of_sums=lambda sums: float(sums[0])))
    metrics.append(metric_of_rows("changes/never_looked/claimed", "", never, 2, of_sums=ratio([1], [0])))
    seen = [(truth[i], claims[j]) for i, j in pairs.items() if looks[i] > 0]
    return [*metrics, *_displacement_metrics(seen, dim), _time_metric(seen), *_delay_metrics(world, estimate)]


def _is_good(true: Change, claim: Change, world: World) -> bool:
    near = _are_near(true.before_m, claim.before_m, world) and _are_near(true.after_m, claim.after_m, world)
    return near and _is_within_sigmas(true, claim, world.rules.dim)


def _f1_within(sums: FloatArray) -> float:
    """F1 where a true claim that is not within 3 sigma is false, and its change missed."""
    true, false, missed, within = sums
    below = 2.0 * true + false + missed
    return float(2.0 * within / below) if below > 0.0 else float("nan")


def _displacement_metrics(pairs: Sequence[tuple[Change, Change]], dim: int) -> list[Metric]:
    """Return the error of displacements of claims that are true, and its squared Mahalanobis distance by dimension.

    The covariance of a displacement is the sum of those of its places, as if these were independent.
    """
    errors, nees = [], []
    for true, claim in pairs:
        if true.before_m is None or true.after_m is None or claim.before_m is None or claim.after_m is None:
            continue
        error_m = ((claim.after_m - claim.before_m) - (true.after_m - true.before_m))[:dim]
        errors.append((true.session, true.landmark_id, (float(error_m @ error_m), 1.0)))
        assert claim.before_covariance_m2 is not None
        assert claim.after_covariance_m2 is not None
        covariance = (claim.before_covariance_m2 + claim.after_covariance_m2)[:dim, :dim]
        if np.isfinite(squared := _square_in_sigmas(error_m, covariance)):
            nees.append((true.session, true.landmark_id, (squared / dim, 1.0)))
    return [
        metric_of_rows("displacement/rmse", "m", errors, 2, of_sums=root_of_ratio(0, 1)),
        metric_of_rows("displacement/nees_by_dof", "", nees, 2, of_sums=ratio([0], [1])),
    ]


def _time_metric(pairs: Sequence[tuple[Change, Change]]) -> Metric:
    """Return the mean distance between the stated and the true instant of changes."""
    rows = [
        (true.session, true.landmark_id, (abs(claim.stamp_s - true.stamp_s), 1.0))
        for true, claim in pairs
        if np.isfinite(claim.stamp_s) and np.isfinite(true.stamp_s)
    ]
    return metric_of_rows("changes/time_error", "s", rows, 2, of_sums=ratio([0], [1]))


def _delay_metrics(world: World, estimate: Episodes) -> list[Metric]:
    """Return the mean time and looks from a change to the first robot time whose map states it.

    Of changes that are never stated nothing is known here: they lower the recall. Without robot times: NaN.
    """
    seconds, looks = [], []
    left = dict(enumerate(derive_changes(world.truth, world)))
    for robot_time_s in estimate.robot_times_s().tolist() if left else []:
        claims = derive_changes(estimate.select_map(robot_time_s), world, robot_time_s)
        known = [i for i, change in left.items() if change.stamp_s <= robot_time_s]
        for row in match_changes([left[i] for i in known], claims, world)[0].tolist():
            change = left.pop(known[row])
            where = (change.session, change.landmark_id)
            seconds.append((*where, (robot_time_s - change.stamp_s, 1.0)))
            count = world.count_looks(change.landmark_id, change.stamp_s, robot_time_s)
            if world.looks is not None:
                looks.append((*where, (count, 1.0)))
    return [
        metric_of_rows("changes/delay", "s", seconds, 2, of_sums=ratio([0], [1])),
        metric_of_rows("changes/delay_in_looks", "looks", looks, 2, of_sums=ratio([0], [1])),
    ]
