"""Mistakes that make static landmarks appear to move: which of them a recording's pairs of sightings show.

A mistake (ranges in millimetres, bearings clockwise, a clock that is three seconds late) is undone on trial; it is
likely where almost all pairs that can tell the two apart come nearer by it, and nearer than if the robot stood: where
it does, any change that shrinks readings shrinks their noise, which tells nothing.
"""

from __future__ import annotations

from collections.abc import Container
from math import inf, log

import numpy as np

from evermap.config import CheckConfig
from evermap.slam.kernels import reckon_motions
from evermap.slam.mistakes import DELAYS_S, HONEST, NO_ODOMETRY, UNITS, Finding, Mistake, make_late, make_longer
from evermap.slam.pairs import Pairs, measure_loss, off, pairs_of, reckon_drive, sighting_pairs
from evermap.types import AnyRecording, FloatArray, Recording, is_in_space

AT_ONCE = 32
"""Number of corrections that are tried together: arrays of a megabyte."""
SHARES = (slice(0, None, 64), *(slice(step // 2, None, step) for step in (64, 32, 16, 8, 4)))
"""Parts of the pairs, half of which may rule out candidates one after the other: few show most of them to be wrong."""
_FACTORS = tuple(10.0**power for power in np.arange(-4.0, 4.01, 0.1) if abs(power) > 0.25)
LEAST_WAY_M, HEAD_ON, FASTER = 0.5, 0.9, 2.0
"""Of ranges alone: the way between two from which their difference is compared with it, the quantile of the ratio at
which the robot drives straight to a landmark or away from it, and what that is at least in another unit."""


def unusable(recording: AnyRecording, settings: CheckConfig) -> Finding | None:
    """Return why static landmarks seem to move by the odometry of a recording; None if they do not."""
    return next(iter(find_motion(recording, settings)), None)


def find_motion(recording: AnyRecording, settings: CheckConfig) -> list[Finding]:
    """Return mistakes that make static landmarks appear to move."""
    pairs = pairs_of(recording, settings)
    if pairs is None:
        return [] if is_in_space(recording) else _find_unit_of_ranges(recording, settings)
    if pairs.still:
        moved = off(pairs.residual(HONEST)) > 0.1
        if np.sum(moved) < settings.fewest or np.mean(moved) < 0.1:
            return []
        message = (
            f"the odometry is zero throughout, but {np.mean(moved):.0%} of the landmarks seen again within seconds "
            f"have moved in the sensor's view: the robot drove ({pairs.speeds})"
        )
        return [Finding(NO_ODOMETRY, message, usable=False)]
    undone = HONEST
    found: list[Finding] = []
    for _ in range(3):
        mistake = find_likeliest(pairs, undone, {finding.code for finding in found}, settings)
        if mistake is None:
            break
        found.append(Finding(mistake.code, mistake.message, usable=False))
        undone = mistake.after(undone)
    usual = float(np.median(off(pairs.residual(undone))))
    if usual > settings.off and not pairs.turns:
        message = (
            "turn rates are zero throughout, but the landmarks turn in the sensor's view: the odometry's turning seems "
            "to be missing (angular_radps)"
        )
        return [Finding("no-turning", message, usable=False)]
    if usual > settings.off:
        message = (
            f"landmarks are not static: seen again within seconds, half of them are over {usual:.2g} rad or "
            f"{usual:.0%} of their range from the prediction by odometry; mixed identities, or "
            "mistakes in several units, signs or frames at once"
        )
        return [Finding("landmarks-move", message)]
    return found


def find_likeliest(pairs: Pairs, undone: Mistake, told: Container[str], settings: CheckConfig) -> Mistake | None:
    """Return the mistake that explains most of the rest, if it certainly explains anything.

    Those found so far are `undone`; codes in `told` are not looked for.
    """
    before = pairs.residual(undone)[0]
    candidates = [*pairs.units, *pairs.angles, *(make_longer(factor, pairs.why_longer) for factor in _FACTORS)]
    candidates += [make_late(side * delay_s) for delay_s in DELAYS_S for side in (1.0, -1.0)]
    candidates = [mistake for mistake in candidates if mistake.code not in told]

    def after(mistakes: list[Mistake]) -> FloatArray:
        return pairs.residual(*(mistake.after(undone) for mistake in mistakes))

    def standing(mistakes: list[Mistake]) -> FloatArray:
        return pairs.residual(*(mistake.after(undone) for mistake in mistakes), stands=True)

    candidates = _possible(pairs, candidates, undone, before, settings)
    if not candidates:
        return None
    parts = [candidates[row : row + AT_ONCE] for row in range(0, len(candidates), AT_ONCE)]
    losses = np.concatenate([_nearer(pairs, before, after(part), standing(part), settings) for part in parts])
    best, least = candidates[int(np.argmin(losses))], losses.min()
    if least == inf:
        return None
    if best.code == "clock":
        near = [make_late(best.delay_s + 0.1 * step) for step in range(-5, 6)]
    elif best.code == "length-unit":  # a unit that has a name is likelier than a factor that has none
        gain = measure_loss(before, settings) - least
        for mistake, loss in zip(candidates, losses.tolist(), strict=True):
            alike = mistake in pairs.units and abs(log(mistake.lengths / best.lengths)) < 0.3
            if alike and loss < least + 0.1 * gain:
                return mistake
        near = [make_longer(best.lengths * 10.0 ** (0.01 * step), pairs.why_longer) for step in range(-10, 11)]
    else:
        return best
    return near[int(np.argmin(measure_loss(after(near), settings)))]


def _possible(
    pairs: Pairs, candidates: list[Mistake], undone: Mistake, before: FloatArray, settings: CheckConfig
) -> list[Mistake]:
    """Return the candidates but for those that a share of the pairs shows to gain too little: `_nearer` gives them inf.

    Losses are no less than 0, so that of some pairs bounds the gain over all.
    """
    most = len(before[0]) * float(measure_loss(before, settings)) - settings.gain
    spent = np.zeros(len(candidates))
    for share in SHARES:
        if share.start >= len(before[0]):
            continue
        part, at_once = pairs.among(share), share.step * AT_ONCE
        for row in range(0, len(candidates), at_once):
            tried = slice(row, row + at_once)
            after = part.residual(*(mistake.after(undone) for mistake in candidates[tried]))
            spent[tried] += after.shape[-1] * measure_loss(after, settings)
        possible = np.flatnonzero(spent < most).tolist()
        candidates, spent = [candidates[row] for row in possible], spent[possible]
        if not candidates:
            break
    return candidates


def _nearer(
    pairs: Pairs, before: FloatArray, after: FloatArray, standing: FloatArray, settings: CheckConfig
) -> FloatArray:
    """(M,) loss of the residuals (M, K, P) after undoing a mistake each; inf unless almost all pairs that tell come
    nearer by it, and nearer than if the robot were `standing`.
    """
    was, now = off(before), off(after)
    apart = off(pairs.difference(after, before))
    usual = np.fmin(np.median(was), np.median(now, axis=1))
    telling = apart > np.fmax(settings.fits, settings.apart * usual)[:, None]
    n_telling = telling.sum(axis=1)
    agreed = (telling & (now < was)).sum(axis=1) >= settings.agreed * n_telling
    loss = measure_loss(after, settings)
    rivals = np.minimum(measure_loss(before, settings), measure_loss(standing, settings))
    gain = len(was) * (rivals - loss)
    return np.where((n_telling >= settings.fewest) & agreed & (gain > settings.gain), loss, inf)


def _find_unit_of_ranges(recording: Recording, settings: CheckConfig) -> list[Finding]:
    """Return the unit of ranges without bearings, which change faster than the sensor moves in any direction."""
    first, second = sighting_pairs(recording, settings, with_bearing=False)
    seen = recording.detections
    if len(first) < settings.fewest:
        return []
    stamp_s, motion = recording.frames.stamp_s[seen.frame], np.empty((len(first), 3))
    driven, mount = recording.odometry, np.array(recording.sensor.mount_robot_sensor, dtype=np.float64)
    track = reckon_drive(driven, *HONEST.drive)
    reckon_motions(stamp_s[first], stamp_s[second], 0.0, driven.stamp_s, track, mount, motion)
    way_m = np.hypot(motion[:, 0], motion[:, 1])
    moved = way_m > LEAST_WAY_M
    faster = np.abs(seen.range_m[second] - seen.range_m[first])[moved] / way_m[moved]
    landmark = seen.landmark_id[first][moved]
    fastest = [
        float(np.quantile(faster[landmark == one], HEAD_ON))
        for one in np.unique(landmark).tolist()
        if np.count_nonzero(landmark == one) >= settings.fewest
    ]
    usual = float(np.median(fastest)) if fastest else 1.0
    if usual < FASTER:  # no triangle inequality is broken, but for noise and slip
        return []
    for mistake in UNITS:
        if mistake.field == "range_m" and abs(log(mistake.lengths * usual)) < log(FASTER) / 2.0:
            return [Finding(mistake.code, mistake.message, usable=False)]
    return []
