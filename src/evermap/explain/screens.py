"""Screens of the competition: which causes are worth a solution, by what shows without one or at the one there is."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import partial

import numpy as np

from evermap.config import ExplainConfig, SlamConfig
from evermap.errors import EvermapError
from evermap.explain.answer import CLOCK
from evermap.explain.causes.mounts import MOUNT_M
from evermap.explain.causes.sizes import shorten_ranges
from evermap.explain.causes.suspect import LITTLE, RARE_P, Inputs, Suspect, rows_of_kind
from evermap.explain.evidence import (
    AnySession,
    Screen,
    SpatialSession,
    evidence_at,
    list_used_rows,
    optimum_of,
    price_changes,
)
from evermap.explain.linearise import change_by, cost_nearby, gain_by, solve_nearby
from evermap.explain.scores import ScreenedSession
from evermap.explain.seeds import find_mount, find_scales, find_shape, find_single_biases, find_single_scales
from evermap.explain.shape import FEWEST, compare_shapes, find_mirrored_part
from evermap.explain.trial import FEWER, INLIER, NEAR, Asked, Trial, VisitT, count_changed
from evermap.explain.triggers import (
    INNOVATIONS,
    LEAST_SCALE,
    LEAST_SINGLE,
    OF_LANDMARKS,
    compare_sensors,
    find_mean_square,
    find_symptoms,
    is_off_mount,
)
from evermap.slam.clocks import FALLS, find_delay, find_pair_loss, late_by
from evermap.slam.estimate import Solved, solve
from evermap.slam.orientations import MIRRORED
from evermap.slam.pairs import pairs_of
from evermap.types import BoolArray, FloatArray, IntArray, SlamResult, is_in_space

FAR = 2.5
"""Standard deviations beforehand beyond which no state is tried at once."""
LINEAR = 4.0
"""Times that a cause may gain what the linear test says."""
STRETCHES = frozenset({"tag-size", "range-scale", "sensor-scale"})
"""Causes that stretch detections: of some landmarks, or by some sensors, as of all."""
BIAS_OF_ONE = "range-bias"
"""Cause of ranges of one landmark that are all too long by as much."""
AGREE = 0.25
"""Share of what one of ranges, odometry and map is off by, up to which the other two agree with each other."""
PLACED, BETTER, ELSEWHERE = 0.6, 0.2, 0.3
"""Share of a map in its place from which it is of what was seen; by how much more that must be without a fault of it;
and share below which it is of another site."""
AXES_OF_TAGS = frozenset({"map-axes", "corner-order"})
"""Causes of a map by which only the orientations of its tags are others: its shape says which may be."""
PLANAR_MOUNT = "sensor x_m", "sensor y_m"
"""Subjects of causes of where a sensor sits in the plane."""


def is_near(suspect: Suspect, state: float) -> bool:
    """Return whether a state is within what is tried of a cause at once; False of discrete ones, which have none."""
    return abs(state) < FAR * suspect.sigma


def screen_plain(
    best: Trial[VisitT] | None,
    inputs: Inputs,
    suspects: list[Suspect],
    config: SlamConfig,
    alone: SlamResult | None = None,
    *,
    of_some: bool = False,
) -> list[tuple[float, Suspect, float]]:
    """Return causes that show without a solution, in one that fails, or in one without the map, `alone`; `of_some`: of
    these those of some detections, by what was seen or by the sensor.
    """
    suspects = [one for one in suspects if one.rows is not None] if of_some else suspects
    seeds = _by_seeds(best, inputs, suspects, config)
    of_map = _by_shape(alone, inputs, suspects, seeds)
    if of_map is None:
        of_map = [(0.0, one, 0.0) for one in suspects if _is_of_map(one, best, config)]
    shown = [(math.inf, one, 0.0) for one in suspects if one.shows]
    return [*shown, *screen_pairs(inputs, suspects, config), *seeds, *of_map]


def _by_shape(alone: SlamResult | None, inputs: Inputs, suspects: Iterable[Suspect], seeds: Asked) -> Asked | None:
    """Return discrete causes of the map after which more of it is in its place; None where its shape says nothing.

    Where none of it is, in no scale of the `seeds` either, that it is of another site is for certain worth a solution.
    """
    if alone is None or inputs.prior_map is None:
        return None
    as_given = compare_shapes(alone.landmarks, inputs.prior_map)
    if as_given.n_common < FEWEST:
        return None
    found, elsewhere, placed = Asked(), Asked(), as_given.placed
    for suspect in suspects:
        if not suspect.of_map or suspect.is_continuous:
            continue
        undone = suspect.undo(inputs, 0.0).prior_map
        if undone is None:
            elsewhere.append((math.inf, suspect, 0.0))
            continue
        now = compare_shapes(alone.landmarks, undone)
        placed = max(placed, now.placed)
        if now.placed >= PLACED and now.share > as_given.share + BETTER:
            found.append((now.share + suspect.p, suspect, 0.0))
    mirrored = [gain for gain, one, _ in found if one.code == "map-mirrored"]
    found += [(mirrored[0], one, 0.0) for one in suspects if mirrored and one.code == MIRRORED.code and not one.pairs]
    part = None if found else find_mirrored_part(alone.landmarks, inputs.prior_map)
    if part is not None:
        found.append((as_given.share, _suspect_part(*part), 0.0))
    found.sort(key=lambda each: -each[0])
    for _, suspect, state in seeds:
        if suspect.of_map and (undone := suspect.undo(inputs, state).prior_map) is not None:
            placed = max(placed, compare_shapes(alone.landmarks, undone).placed)
    return found if placed > ELSEWHERE else elsewhere


def _suspect_part(landmark_id: IntArray, position_m: FloatArray) -> Suspect:
    """Return that a map has some landmarks as in a mirror, which the shape of a solution without it shows.

    Args:
        landmark_id: (K,) which.
        position_m: (K, D) where they are in the frame of the map.
    """
    listed = ", ".join(map(str, landmark_id.tolist()))
    return Suspect(
        "map-mirrored", "map: a part", RARE_P, partial(_replace_in_map, landmark_id=landmark_id, position_m=position_m),
        lambda _: f"a part of the given map is mirrored: landmarks {listed}",
        lambda _: f"--prior-map: the signs of the coordinates of {listed}", of_map=True, pairs=False,
    )  # fmt: skip


def _replace_in_map(inputs: Inputs, _: float, landmark_id: IntArray, position_m: FloatArray) -> Inputs:
    """Return the same with other places of some landmarks of the map, which knows no orientations of these then."""
    given = inputs.prior_map
    assert given is not None
    at, rotation = given.position_m.copy(), given.rotation
    row, of = np.intersect1d(given.landmark_id, landmark_id, return_indices=True)[1:]
    at[row, : position_m.shape[1]] = position_m[of]
    if rotation is not None:
        rotation = rotation.copy()
        rotation[row] = np.nan
    return replace(inputs, prior_map=replace(given, position_m=at, rotation=rotation))


def _is_of_map(suspect: Suspect, best: Trial[VisitT] | None, config: SlamConfig) -> bool:
    """Return whether a discrete cause of the map is asked: where most of the map does not hold, or it was not found."""
    if not suspect.of_map or suspect.is_continuous or suspect.code in AXES_OF_TAGS:
        return False
    if best is None:
        return True
    result, given = best.solution.result, best.inputs.prior_map
    common = best.inputs.n_common
    if given is None or not common:  # nothing says where it is
        return False
    if result.trajectory.frame != "prior_map":
        return True
    changed = sum(len(change.landmark_ids) for change in result.changes if change.kind in OF_LANDMARKS)
    return bool(changed > config.explain.map_changed * common)


def _by_seeds(
    best: Trial[VisitT] | None, inputs: Inputs, suspects: Iterable[Suspect], config: SlamConfig
) -> list[tuple[float, Suspect, float]]:
    """Return scales with first values that need no solution (`seeds`), where these are another than stated."""
    scales = find_scales(inputs.recording, inputs.prior_map, config.check)
    ranges, driven, of_map = scales.ranges, scales.odometry, scales.map
    apart = {  # of ranges, odometry and map, how far the other two are apart
        "ranges": abs(scales.by_map - scales.by_odometry),
        "odometry": abs(scales.by_map),
        "map": abs(scales.by_odometry),
    }
    odd = min(apart, key=lambda one: apart[one])
    if apart[odd] < AGREE * max(apart.values()):  # two against one
        ranges, driven, of_map = (
            state if odd == one else math.nan
            for one, state in (("ranges", ranges), ("odometry", driven), ("map", of_map))
        )
    single, too_long_m = dict[int, float](), dict[int, float]()
    if best is not None:
        result = best.solution.result
        if inputs.prior_map is not None and result.trajectory.frame != "prior_map" and not math.isfinite(scales.by_map):
            ratio = find_shape(result, inputs.prior_map)
            states = {state.name: state.value for state in result.parameters}
            ranges = ratio - math.log(states.get("range_scale", 1.0 + states.get("range_slope", 0.0)))
            driven = ratio + math.log(states.get("odometry_forward_scale", states.get("odometry_scale", 1.0)))
            of_map = -ratio
        single = find_single_scales(inputs.recording, result)
        too_long_m = find_single_biases(inputs.recording, result, inputs.prior_map)
    slips = best is not None and is_off_mount(best.solution.result, inputs, config)
    mount = find_mount(inputs.recording, config.check) if slips else np.zeros(3)  # type: ignore[arg-type]
    by_sensor = compare_sensors(inputs)
    found = list[tuple[float, Suspect, float]]()
    for suspect in suspects:
        if suspect.code == "mount" and suspect.subject in PLANAR_MOUNT and slips:
            moved = float(mount[PLANAR_MOUNT.index(suspect.subject)])
            found += [(math.inf, suspect, moved)] if abs(moved) > MOUNT_M else []
            continue
        if suspect.code == BIAS_OF_ONE and suspect.rows is not None:
            bias_m = too_long_m.get(int(suspect.rows[1]), math.nan)
            found += [(math.inf, suspect, bias_m)] if abs(bias_m) > LITTLE * suspect.sigma else []
            continue
        if suspect.rows is not None and suspect.rows[0] == "sensor":
            state = float(by_sensor[int(suspect.rows[1])])
        elif suspect.rows is not None and suspect.rows[0] == "id":
            state = single.get(int(suspect.rows[1]), math.nan)
        elif suspect.rows is not None:
            of_kind = np.unique(inputs.recording.detections.landmark_id[rows_of_kind(inputs.recording, suspect.rows)])
            own = [single[one] for one in of_kind.tolist() if one in single]
            state = float(np.median(own)) if len(own) > 1 and 2 * len(own) > len(of_kind) else math.nan
        else:
            seeds = {"range-scale": ranges, "tag-size": ranges, "odometry-scale": driven, "map-scale": of_map}
            state = seeds.get(suspect.code, math.nan)
        of_all = suspect.rows is None or suspect.rows[0] == "sensor"
        if abs(state) > (LEAST_SCALE if of_all else LEAST_SINGLE):
            found.append((math.inf, suspect, state))
    # what was rejected stands out; of all lengths that which is off least is likelier
    return sorted(found, key=lambda each: (each[1].rows is not None and each[1].rows[0] != "sensor", abs(each[2])))


def screen_pairs(inputs: Inputs, suspects: Iterable[Suspect], config: SlamConfig) -> list[tuple[float, Suspect, float]]:
    """Return discrete causes, and long delays, that bring pairs of sightings nearer, with what they gain [nats]."""
    rules = config.check
    before = pairs_of(inputs.recording, rules)
    if before is None or before.still:
        return []
    loss, found = find_pair_loss(before, rules), list[tuple[float, Suspect, float]]()
    least = max(rules.gain, FALLS * loss)
    for suspect in suspects:
        if suspect.code == CLOCK:
            state = find_delay(before, rules)
            gain = loss - find_pair_loss(before, rules, late_by(state))
            found += [(gain, suspect, state)] if gain > least and abs(state) > FAR * suspect.sigma else []
            continue
        if suspect.is_continuous or suspect.of_map or not suspect.pairs:
            continue
        try:
            pairs = pairs_of(suspect.undo(inputs, 0.0).recording, rules)
        except (EvermapError, ValueError):
            continue
        if pairs is None:
            continue
        gain = loss - find_pair_loss(pairs, rules)
        if gain > least:
            found.append((gain, suspect, 0.0))
    return sorted(found, key=lambda each: -each[0])


def screen_continuous(
    best: Trial[VisitT] | None,
    inputs: Inputs,
    suspects: list[Suspect],
    config: SlamConfig,
) -> list[tuple[float, Suspect, float]]:
    """Return continuous causes with what they gain by the score test [nats], price paid, and their states.

    And discrete ones of a lens, which do not show in pairs, by a few steps.
    """
    if best is None:
        return []
    asked = _without_changes(best)
    session, screen = asked.session, asked.screen
    found, of_all, of_biases = list[tuple[float, Suspect, float]](), None, None
    # what changes explain, a cause must explain, too
    own, changes = best.solution.asked, best.solution.result.changes
    deficit = evidence_at(own.screen.optimum, price_changes(own.session, changes)) - evidence_at(screen.optimum)
    cost = cost_nearby(session)
    symptoms = find_symptoms(best.solution.result, inputs, config)
    of_noise = symptoms == (INNOVATIONS,) and not count_changed(best.solution.result)
    for suspect in suspects:
        if not suspect.is_continuous:
            if not (suspect.pairs or suspect.of_map):
                gain = gain_by(session, cost, inputs, suspect) * screen.optimum.worth + suspect.log_p
                found += [(gain, suspect, 0.0)] if gain > 0.0 else []
            continue
        if suspect.code == BIAS_OF_ONE:
            if of_biases is None:
                together = replace(suspect, undo=partial(shorten_ranges, of=None))
                of_biases = change_by(session, screen, inputs, together)
            direction = None if of_biases is None else of_biases * _of_one(screen, session, inputs, suspect)
        elif suspect.rows is None or of_all is None:
            direction = change_by(session, screen, inputs, suspect)
            of_all = direction if suspect.code in STRETCHES and suspect.rows is None else of_all
        else:  # each detection stretches by itself
            direction = of_all * _of_one(screen, session, inputs, suspect)
        if direction is None:
            continue
        score = screen.score(direction, suspect.sigma**-2)
        state = float(np.clip(score.value, -FAR * suspect.sigma, FAR * suspect.sigma))
        if abs(state) < LITTLE * suspect.sigma:  # as sensors are; a fit improves with any further number
            continue
        gain = score.gain * screen.optimum.worth - 0.5 * math.log(max(score.information, 1e-12) * suspect.sigma**2)
        earns = gain + suspect.log_p > config.explain.lead_nats and LINEAR * score.gain > deficit
        if earns and (not of_noise or _may_relieve(session, inputs, suspect, state, config.explain)):
            found.append((gain + suspect.log_p, suspect, state))
    return sorted(found, key=lambda each: -each[0])


def _of_one(screen: Screen, session: AnySession, inputs: Inputs, suspect: Suspect) -> BoolArray:
    """Return (R,) which residuals are of the detections that a cause is of."""
    return screen.of_detections(rows_of_kind(inputs.recording, suspect.rows)[list_used_rows(session)])


def _may_relieve(session: AnySession, inputs: Inputs, suspect: Suspect, state: float, rules: ExplainConfig) -> bool:
    """Return whether a continuous cause may mend innovations that are wider than they should be.

    It won't where they are as wide at the optimum nearby, at the same noise, of which the cause's state is the best
    (else another state is tried by whole solutions): what noise would be learned under it only widens them.
    """
    undone = suspect.undo(inputs, state)
    near = solve_nearby(session, inputs, undone)
    if near is None or isinstance(session, Solved):
        return True
    usual, rejected = _find_fit(near)
    if usual <= rules.innovations or rejected < FEWER * _find_fit(session)[1]:
        return True
    screen = Screen.of(optimum_of(near))
    direction = change_by(near, screen, undone, suspect, given=inputs, state=state)
    if direction is None:
        return True
    score, known = screen.score(direction, suspect.sigma**-2, state), suspect.sigma**-2
    information = known + (score.information - known) * screen.optimum.worth
    return abs(score.value) * math.sqrt(information) >= NEAR * 0.5


def _find_fit(session: SpatialSession) -> tuple[float, float]:
    """Return the mean squared innovation of a session in space, a number, and the share of detections rejected."""
    optimum = session.solved.optimum
    smoother, now = optimum.last
    inlier = now.weight >= INLIER
    nis = smoother.find_nis(now, smoother.spread(now))
    return find_mean_square(nis, smoother.problem.dof, inlier), float(np.mean(~inlier))


def _without_changes(best: Trial[VisitT]) -> ScreenedSession:
    """Return the session with all landmarks of the map where it has them, which is what causes are asked of."""
    asked, session, inputs = best.solution.asked, best.solution.session, best.inputs
    if not isinstance(session, Solved):
        return asked.held
    assert not is_in_space(inputs.recording)
    if not best.solution.result.changes:
        return asked
    static = session.settings.model_copy(update={"method": "nohyp"})
    try:
        return ScreenedSession(solve(inputs.recording, static, prior_map=inputs.prior_map), inputs)
    except EvermapError:
        return asked
