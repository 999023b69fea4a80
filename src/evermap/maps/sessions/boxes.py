"""Association of boxes without identity with the landmarks of a living map.

The tracker finds static objects (`slam.space.moving`). The pose of a session in the map follows from the frame of its
odometry, if static objects agree with it, else from identified landmarks, else from the constellation of static objects
(`slam.association.constellation`): one alignment with the map must be far better than all others, since a wrong place
is worse than none. What stands is then assigned to the boxes of the map, one to one, against 'new' and 'clutter': by
class, by a Gaussian in the position that the session has with all others held there, by size and heading, and by how
probably the map's box still stands. Held by these, the session is solved again, until they stay the same.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from evermap.align.acceptance import accept_alignment
from evermap.align.candidates import Matches
from evermap.config import BoxesConfig, Config
from evermap.errors import NumericalError
from evermap.geometry import se3
from evermap.geometry.chunked import blocks
from evermap.maps.bodies import square_lengths
from evermap.maps.living import LivingMap
from evermap.maps.names import anonymous_text, distinct_text
from evermap.maps.sessions.believe import Witnessed, aged
from evermap.maps.sessions.box_likeness import BoxLikeness, BoxPairs, learn_likeness
from evermap.maps.sessions.box_search import GATE, MapBoxes, in_space, placed, regain
from evermap.maps.sessions.box_visit import BoxVisit, SeenBoxes, list_boxes
from evermap.maps.sessions.placing import NOT_FOUND, Laid, Localised, one_to_one, widened
from evermap.maps.sessions.spatial import SpatialVisit, localise_in_space
from evermap.maps.vicinity import cliques_of
from evermap.slam.space.estimate import SpatialOptimum, converge_again
from evermap.slam.space.moving import TrafficIntake, has_traffic, rescale, solve_in_traffic, take_in_traffic
from evermap.slam.space.problem import PlacePrior
from evermap.slam.space.result import identities_of
from evermap.slam.space.solve import FREE, SpatialSolved
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray, Progress, SpatialRecording, landmark_id_of, rows_of

ROUNDS = 30
STRETCH = 8
"""Boxes, one after the other, whose deviations from the map are averaged."""
WANDERS = (0.003, 0.0003), (0.01, 0.001), (0.03, 0.003)
"""How much less, one after the other [m/sqrt(s), rad/sqrt(s)]."""
TILTED = 0.9
"""Cosine of the tilt up to which the frame of an odometry is upright."""


def localised(
    recording: SpatialRecording,
    living: LivingMap,
    config: Config,
    remarks: tuple[str, ...] = (),
    progress: Progress | None = None,
) -> Localised[SpatialVisit]:
    """Return a session in space where it lies in a map; boxes without identity get theirs from the map.

    Arguments are those of `spatial.localise_in_space`.
    """
    if not has_traffic(recording):
        return localise_in_space(recording, living, config, remarks, progress)
    settings, taken = config.living, take_in_traffic(recording, config.slam.space, config.track)
    p_site = aged(living, settings, float(taken.recording.frames.stamp_s[0])).p_here
    solved, known = _by_itself(taken, progress, settings.boxes), MapBoxes.of(living, p_site, config)
    found = _place_session(taken, solved, living, known) if len(living.places) else None
    if found is not None and found[1] != 1.0:
        taken = rescale(taken, found[1])
        solved = _by_itself(taken, None, settings.boxes)
        found = _place_session(taken, solved, living, known)
    held = None
    if found is not None:
        with suppress(NumericalError):  # what was held contradicts itself
            held = _settle(taken, replace(solved, optimum=_move_session(solved.optimum, found[0])), living, known)
    if held is None or not _agrees(taken, *held, living, known):
        alone: SpatialVisit = _visit(taken, solved, _Matched.nothing(solved), living, config)
        return Localised.lost(alone, living, NOT_FOUND) if len(living.places) else Localised(alone, alone.named(living))
    visit: SpatialVisit = _visit(taken, *held, living, config)
    order, matched = np.argsort(visit.landmark_id, kind="stable"), held[1]
    assumed = np.zeros(len(order), dtype=np.bool_)
    where = Laid(
        visit.landmark_id[order], se3.identity(), matched.place[order], matched.probability[order],
        settings.boxes.drift_m, assumed,
    )  # fmt: skip
    part, vicinity = visit.named(living), None
    if len(living.places) > settings.whole_places:
        named = cliques_of(part, where.landmark_id[where.place >= 0])
        vicinity, where = widened(part, part, named, where, visit.path_m, visit.floor_sensor, settings)
        part = vicinity.part
    return Localised(visit, part, where, vicinity)


@dataclass(frozen=True, slots=True)
class _Matched:
    """Matches of (P,) places of a session.

    Attributes:
        place, probability: rows of the map's places, -1 for none, and their probabilities.
        instead, p_other: rows of those whose room they take without being matched, -1 for none, and the probability
            that they are others.
    """

    place: IntArray
    probability: FloatArray
    instead: IntArray
    p_other: FloatArray

    @classmethod
    def nothing(cls, solved: SpatialSolved) -> _Matched:
        count = len(solved.identity)
        nowhere = np.full(count, -1, dtype=np.int64)
        return cls(nowhere, np.ones(count), nowhere.copy(), np.ones(count))


def _agrees(taken: TrafficIntake, held: SpatialSolved, matched: _Matched, living: LivingMap, known: MapBoxes) -> bool:
    """Return whether a sufficient share of the static boxes matches the map, among those near boxes of the map."""
    if len(_match_named(taken, held, living)[0]) > 1:
        return True
    settings = known.settings
    seen = list_boxes(taken, held, settings)
    there = matched.place[seen.place] >= 0
    off = seen.position_m[:, None, :2] - known.position_m[known.p >= settings.perhaps, :2]
    away = np.linalg.norm(off, axis=2).min(axis=1, initial=np.inf)
    among = np.count_nonzero(there | (away <= settings.among_m))
    return bool(np.count_nonzero(there) >= max(settings.shared_pairs, settings.least_share * among))


def _by_itself(taken: TrafficIntake, progress: Progress | None, settings: BoxesConfig) -> SpatialSolved:
    """The session alone, in the frame of its odometry, with boxes put together that are one."""
    solved = solve_in_traffic(taken, progress)
    solved = replace(solved, optimum=_move_session(solved.optimum, _frame_of(taken.recording)))
    return _together(taken, solved, np.arange(len(solved.identity)), settings)


def _frame_of(recording: SpatialRecording) -> FloatArray:
    """The first pose (7,) in the odometry's own frame, if that is upright."""
    assert recording.odometry is not None
    odometry = recording.odometry
    first = se3.interpolate(odometry.stamp_s, odometry.pose_world_robot, recording.frames.stamp_s[:1])[0]
    return np.asarray(first if se3.rotation_of(first)[2, 2] > TILTED else se3.identity())


def _move_session(optimum: SpatialOptimum, motion: FloatArray) -> SpatialOptimum:
    """Transform the session by a rigid motion (7,)."""
    estimate, oriented = optimum.estimate, optimum.smoother.problem.oriented
    place = se3.compose(motion, estimate.place)
    place[~oriented, 3:] = se3.NO_TURN
    estimate = replace(estimate, pose=se3.compose(motion, estimate.pose), place=place)
    return converge_again(optimum, optimum.last[0].problem, estimate)


def _together(taken: TrafficIntake, solved: SpatialSolved, label: IntArray, settings: BoxesConfig) -> SpatialSolved:
    """Merge places of a session: those with one `label` (P,), and overlapping boxes."""
    seen, count = list_boxes(taken, solved, settings), len(label)
    first = np.unique(label, return_index=True)[1][np.unique(label, return_inverse=True)[1].ravel()]
    i, j = _same(seen, settings)
    one, other = np.concatenate([np.arange(count), seen.place[i]]), np.concatenate([first, seen.place[j]])
    part = connected_components(csr_array((np.ones(len(one)), (one, other)), shape=(count, count)))[1].astype(np.int64)
    if part.max(initial=-1) + 1 == count:
        return solved
    began = np.full(count, np.inf)
    began[seen.place] = seen.first_s
    order = np.lexsort((began, part))
    head = order[np.append(True, np.diff(part[order]) > 0)]  # the earliest of each part
    problem, estimate = solved.optimum.last[0].problem, solved.optimum.estimate
    weight = np.bincount(problem.place, minlength=count) + 1e-9
    place = estimate.place[head].copy()
    total = np.bincount(part, weight)
    place[:, :3] = np.column_stack([np.bincount(part, weight * axis) / total for axis in estimate.place[:, :3].T])
    prior = problem.prior
    kept = np.unique(part[prior.place], return_index=True)[1]
    prior = replace(rows_of(prior, kept), place=part[prior.place[kept]].astype(np.int64))
    problem = replace(
        problem,
        place=part[problem.place].astype(np.int64),
        oriented=problem.oriented[head],
        symmetries=problem.symmetries[head],
        prior=prior,
    )
    optimum = converge_again(solved.optimum, problem, replace(estimate, place=place))
    return replace(
        solved, optimum=optimum, identity=solved.identity[head], number=solved.number[head],
        moves=tuple(one._replace(before=int(part[one.before]), after=int(part[one.after])) for one in solved.moves),
        bodies=tuple(one._replace(before=part[one.before], after=part[one.after]) for one in solved.bodies),
    )  # fmt: skip


def _same(seen: SeenBoxes, settings: BoxesConfig) -> tuple[IntArray, IntArray]:
    """Return pairs of boxes that are one: of one class, overlapping, and neither arrived after the other had left."""
    away = np.linalg.norm(seen.position_m[:, None, :2] - seen.position_m[None, :, :2], axis=2)
    width = np.nan_to_num(seen.size_m[:, 1], nan=0.5)
    near = (away < settings.same_share * 0.5 * (width[:, None] + width)) & (seen.class_id[:, None] == seen.class_id)
    earlier = (seen.first_s[:, None] < seen.first_s) | np.triu(seen.first_s[:, None] == seen.first_s, 1)
    left = seen.first_s - seen.until_s[:, None] > settings.at_once_s  # never where it was not seen to leave
    came = seen.since_s > seen.last_s[:, None]
    one, other = np.nonzero(near & earlier & ~left & ~came)
    return one, other


def _match_named(taken: TrafficIntake, solved: SpatialSolved, living: LivingMap) -> tuple[IntArray, IntArray]:
    """Return rows of the problem's places with an identity, and of the matching places of the map."""
    identity = identities_of(taken.intake, solved)[0]
    members = living.members
    _, member, row = np.intersect1d(members.landmark_id, identity, return_indices=True)
    own = taken.intake.landmark_id[solved.identity[row]] < taken.known
    member, row = member[own], row[own]
    place = living.place_row(members.landmark_id[member], living.site_of()[member])
    return row[place >= 0], place[place >= 0]


def _place_session(
    taken: TrafficIntake, solved: SpatialSolved, living: LivingMap, known: MapBoxes
) -> tuple[FloatArray, float] | None:
    """Return the motion (7,) from the session to the map, and the factor on its lengths; None if ambiguous."""
    row, place = _match_named(taken, solved, living)
    own, there = solved.optimum.estimate.place[row, :3], living.places.position_m[place]
    if len(row) > 1:
        named = accept_alignment(Matches.of(own[:, :2], there[:, :2]), known.slam.localize, fewest=2)
        if named:
            return in_space(named.motion, own[named.agree], there[named.agree]), 1.0
    metre = taken.known > 0 or taken.gauge.stated is not None
    return placed(list_boxes(taken, solved, known.settings), known, metre=metre)


def _settle(
    taken: TrafficIntake, solved: SpatialSolved, living: LivingMap, known: MapBoxes
) -> tuple[SpatialSolved, _Matched]:
    """Solve the session constrained by matching boxes of the map, until the matches no longer change.

    Behind a stretch in which nothing was seen it may be off by more than any gate: there the constellation is asked.
    """
    matched, most = _matched(taken, solved, living, known, np.zeros(0)), -1
    for _ in range(ROUNDS):
        held_m = solved.optimum.estimate.place[matched.place >= 0, :2]
        held = _together(taken, _hold_places(solved, living, matched, known.settings), _labels(matched), known.settings)
        following = _matched(taken, held, living, known, held_m)
        settled = np.array_equal(following.place, matched.place)
        solved, matched = held, following
        if settled:
            seen = list_boxes(taken, solved, known.settings)
            mine, theirs = regain(seen, known, matched.place[seen.place])
            count = int(np.count_nonzero(matched.place >= 0))
            if not len(mine) or count <= most:  # what was regained last did not hold
                break
            matched.place[seen.place[mine]] = known.place[theirs]
            most = count
    return solved, matched


def _labels(matched: _Matched) -> IntArray:
    """Return (P,) labels, equal for places of a session that match one place of the map."""
    count = len(matched.place)
    return np.where(matched.place >= 0, count + matched.place, np.arange(count))


def _hold_places(solved: SpatialSolved, living: LivingMap, matched: _Matched, settings: BoxesConfig) -> SpatialSolved:
    """Solve the session with its places constrained to their matches in the map."""
    optimum, row = solved.optimum, np.flatnonzero(matched.place >= 0)
    place = matched.place[row]
    pose = se3.identity(len(row))
    pose[:, :3] = living.places.position_m[place]
    own = np.trace(blocks(living.covariance_m2, 3)[place].reshape(-1, 3, 3)[:, :2, :2], axis1=1, axis2=2) / 2.0
    sigma = np.full((len(row), 6), np.pi)
    sigma[:, :3] = np.sqrt(own + settings.drift_m**2)[:, None]
    sigma[:, 2] = np.hypot(sigma[:, 2], settings.height_m)
    prior = PlacePrior(row, pose, sigma, matched.probability[row])
    problem = replace(optimum.last[0].problem, prior=prior, start_sigma=FREE, steady=True)
    noise, found = optimum.noise, optimum
    for translation, rotation in ((0.0, 0.0), *WANDERS):
        if translation <= noise.translation and translation > 0.0:
            continue
        noise = replace(noise, translation=max(translation, noise.translation), rotation=max(rotation, noise.rotation))
        found = converge_again(replace(optimum, noise=noise), problem, optimum.estimate)
        off = ((found.estimate.place[row, :2] - pose[:, :2]) / sigma[:, :2]) ** 2
        if (
            max((float(off[k : k + STRETCH].mean()) for k in range(0, len(off), STRETCH)), default=0.0)
            < settings.misfit
        ):
            break
    return replace(solved, optimum=found)


def _matched(
    taken: TrafficIntake, solved: SpatialSolved, living: LivingMap, known: MapBoxes, held_m: FloatArray
) -> _Matched:
    """Match boxes to the map, one to one but for parts of a track; gates grow with the distance to (H, 2)."""
    settings = known.settings
    seen, count = list_boxes(taken, solved, settings), len(solved.identity)
    found = _Matched.nothing(solved)
    row, place = _match_named(taken, solved, living)
    near = np.linalg.norm(solved.optimum.estimate.place[row, :3] - living.places.position_m[place], axis=1)
    found.place[row[near < settings.named_m]] = place[near < settings.named_m]
    loose_m = np.zeros(len(seen.place))
    if len(held_m):
        away = np.linalg.norm(seen.position_m[:, None, :2] - held_m, axis=2).min(axis=1)
        loose_m = np.minimum(settings.drift_share * away, settings.most_drift_m)
    like, pairs = learn_likeness(seen, known, loose_m), BoxPairs.of(seen, known, loose_m)
    odds = _log_odds(like, pairs)
    chosen = one_to_one(odds)
    for k in np.flatnonzero(chosen < 0).tolist():
        other = int(np.argmax(odds[k])) if odds.shape[1] else 0
        if not odds.shape[1] or odds[k, other] <= 0.0:
            continue
        same = np.flatnonzero(chosen == other)
        apart = (seen.last_s[same] < seen.first_s[k]) | (seen.first_s[same] > seen.last_s[k])
        seen_to_move = np.isfinite(seen.since_s[k]) | np.isfinite(seen.until_s[same]).any()
        if apart.all() and not seen_to_move:
            chosen[k] = other
    some = np.flatnonzero(chosen >= 0)
    clutter = np.log((1.0 - seen.p_stay + 1e-6) / (seen.p_stay + 1e-6))
    total = np.logaddexp(np.logaddexp.reduce(odds[some], axis=1), np.logaddexp(0.0, clutter[some]))
    found.place[seen.place[some]] = known.place[chosen[some]]
    found.probability[seen.place[some]] = np.exp(odds[some, chosen[some]] - total)
    members, places = living.members, living.places
    told = living.find_current_site()[np.searchsorted(members.landmark_id, known.landmark_id)]
    free = (told == places.site_id[known.place]) & ~np.isin(np.arange(len(known.place)), chosen)
    _find_replaced(found, seen, known, like.log_odds(pairs), pairs, chosen, free)
    assert len(found.place) == count
    return found


def _find_replaced(
    found: _Matched,
    seen: SeenBoxes,
    known: MapBoxes,
    log_odds: FloatArray,
    pairs: BoxPairs,
    chosen: IntArray,
    free: BoolArray,
) -> None:
    """Find boxes of the map, of those (M,) that are `free`, whose room is taken by one that is not matched, and was not
    seen to come.
    """
    may_be = pairs.over & free & (chosen < 0)[:, None] & np.isnan(seen.since_s)[:, None]
    away_m = np.where(may_be, pairs.away_m, np.inf)
    odds = log_odds + np.where(pairs.alike, 0.0, known.settings.other_class_nats)
    for k, m in enumerate(one_to_one(np.where(may_be, 100.0 - away_m, -np.inf)).tolist()):
        if m >= 0:
            found.instead[seen.place[k]] = known.place[m]
            found.p_other[seen.place[k]] = 1.0 / (1.0 + np.exp(odds[k, m]))


def _log_odds(like: BoxLikeness, pairs: BoxPairs) -> FloatArray:
    """Return (K, M) log odds that a box of the session is one of the map, against being new; -inf beyond gates."""
    near = square_lengths(pairs.off_m, pairs.spread_m2) < GATE * like.settings.far_factor**2
    return np.where(near & pairs.alike, like.log_odds(pairs), -np.inf)


def _visit(
    taken: TrafficIntake, solved: SpatialSolved, matched: _Matched, living: LivingMap, config: Config
) -> BoxVisit:
    """Return the session with ids of the map for matched boxes, and new ones for the others."""
    settings = config.living.boxes
    seen = list_boxes(taken, solved, settings)
    identity, names = identities_of(taken.intake, solved)
    kept = np.ones(len(identity), dtype=np.bool_)
    start_s = float(taken.recording.frames.stamp_s[0])
    given = set(living.landmark_texts)
    for k, place in enumerate(seen.place.tolist()):
        if matched.place[place] >= 0:
            continue
        kind = taken.recording.class_names[seen.class_id[k]] if seen.class_id[k] >= 0 else "box"
        text = distinct_text(anonymous_text(kind, int(seen.track[k]), start_s), given)
        given.add(text)
        identity[place] = landmark_id_of(text)
        names[int(identity[place])] = text
    at = np.flatnonzero(matched.place >= 0)
    identity[at] = living.places.landmark_id[matched.place[at]]
    members = living.members
    kept &= ~np.isin(identity, members.landmark_id[members.deleted])
    brief = seen.until_s - np.where(np.isfinite(seen.since_s), seen.since_s, seen.first_s) < config.track.rest_for_s
    kept[seen.place[brief & (matched.place[seen.place] < 0)]] = False
    kept[seen.place[_doubtful(seen, matched, living, settings)]] = False
    of_places = taken.intake.landmark_id[solved.identity] >= taken.known
    kept &= ~of_places | np.isin(np.arange(len(kept)), seen.place)
    intake = replace(taken.intake, landmark_id=identity, problem=solved.optimum.smoother.problem, names=names)
    count = len(identity)
    solved = replace(solved, identity=np.arange(count), number=np.ones(count, dtype=np.int64))
    moving = np.flatnonzero((np.isfinite(seen.since_s) | np.isfinite(seen.until_s)) & kept[seen.place])
    other = np.flatnonzero((matched.instead[seen.place] >= 0) & kept[seen.place])
    row = seen.place[other]
    witnessed = Witnessed(
        np.append(identity[seen.place[moving]], living.places.landmark_id[matched.instead[row]]),
        np.append(seen.since_s[moving], np.full(len(other), np.nan)),
        np.append(seen.until_s[moving], seen.first_s[other]),
        np.append(seen.p_stay[moving], matched.p_other[row]),
        config.track.still.when_s,
        np.append(np.full(len(moving), UNKNOWN), identity[row]),
    )
    return BoxVisit(
        recording=taken.standing, intake=intake, solved=solved, witnessed=witnessed, taken=taken,
        track=config.track, boxes=seen, kept=kept, tied_m=solved.optimum.estimate.place[at, :2],
    )  # fmt: skip


def _doubtful(seen: SeenBoxes, matched: _Matched, living: LivingMap, settings: BoxesConfig) -> BoolArray:
    """(K,) boxes far from all that ties the session to the map, among boxes that the map has there: one of the two is
    elsewhere.
    """
    held = matched.place[seen.place] >= 0
    if not held.any():
        return held
    box = np.isin(living.places.landmark_id, living.boxes.landmark_id)
    box &= ~np.isin(np.arange(len(box)), matched.place)
    at, known = seen.position_m[:, :2], living.places.position_m[box, :2]
    tied = np.linalg.norm(at[:, None] - at[held], axis=2).min(axis=1) <= settings.tied_m
    among = np.linalg.norm(at[:, None] - known, axis=2).min(axis=1, initial=np.inf) <= settings.among_m
    return np.asarray(~held & ~tied & among)
