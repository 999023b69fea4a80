"""What is odd about a recording, told before anything is estimated: units, signs, clocks, identities, limits.

**Units, signs and clocks** show in whether landmarks stand still. Two readings of one landmark, a few seconds apart,
and the odometry between them say the same thing twice: where the landmark is the second time. The difference is taken
in the logarithm of the range and in the bearing, which no unit of length can make small by itself. A mistake (ranges in
millimetres, bearings clockwise, a clock that is three seconds late) is undone on trial; it is told where almost all
pairs that can tell the two apart come nearer by it, and a second one is then looked for. Honest recordings err by
metres in a hundred and by tenths of a second: no mistake on the list is near enough to be mistaken for that.

**Identities, limits, gaps** are counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from math import inf, log, pi
from typing import Any

import numpy as np

from evermap.config import CheckConfig, Config, SensorConfig
from evermap.errors import DataError
from evermap.geometry import se2
from evermap.types import UNKNOWN, FloatArray, IntArray, Landmarks, Odometry, ParameterEstimate, Recording
from evermap.valid import check_landmarks, validate

USUAL = CheckConfig()


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is odd.

    Attributes:
        code: short and stable, for programs.
        message: what, how much, and the likely cause.
        usable: False where estimates would be nonsense.
    """

    code: str
    message: str
    usable: bool = True


@dataclass(frozen=True, slots=True)
class Check:
    """What a recording holds, and what is odd about it.

    Attributes:
        name, source: of the recording.
        contents: numbers by table: `odometry`, `frames`, `detections`, `landmarks`; plain values, None where unknown.
        findings: what is odd, the worst first.
        warnings: remarks of the reader.
    """

    name: str
    source: str
    contents: dict[str, dict[str, Any]]
    findings: tuple[Finding, ...]
    warnings: tuple[str, ...]

    @classmethod
    def of(cls, recording: Recording, *, identities: bool = True, settings: CheckConfig = USUAL) -> Check:
        """Count and compare; arguments as `findings`."""
        found = findings(recording, identities=identities, settings=settings)
        return cls(recording.name, recording.source, _contents(recording), found, recording.warnings)

    @property
    def usable(self) -> bool:
        """Whether estimates would mean anything."""
        return all(finding.usable for finding in self.findings)

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain values with stable keys, for JSON."""
        return {
            "usable": self.usable,
            "recording": {"name": self.name, "source": self.source},
            **self.contents,
            "findings": [asdict(finding) for finding in self.findings],
            "warnings": list(self.warnings),
        }


@dataclass(frozen=True, slots=True)
class Mistake:
    """How readings would have to be changed to undo a mistake, and its name.

    Attributes:
        code, message: as in `Finding`.
        lengths: factor on all ranges, or its inverse on all speeds, which is the same.
        bearing, offset_rad: a bearing becomes `bearing * b + offset_rad`.
        turn, forward: factors on the turn rate and the forward speed.
        delay_s: odometry stamps are so much later than the motion.
    """

    code: str
    message: str
    lengths: float = 1.0
    bearing: float = 1.0
    offset_rad: float = 0.0
    turn: float = 1.0
    forward: float = 1.0
    delay_s: float = 0.0

    def after(self, other: Mistake) -> Mistake:
        """Return both, the other one undone first."""
        return Mistake(
            self.code,
            self.message,
            self.lengths * other.lengths,
            self.bearing * other.bearing,
            self.bearing * other.offset_rad + self.offset_rad,
            self.turn * other.turn,
            self.forward * other.forward,
            self.delay_s + other.delay_s,
        )


_HONEST = Mistake("", "")
_LENGTHS = (
    ("range_m", "ranges", "millimetres", 1e-3), ("range_m", "ranges", "centimetres", 1e-2),
    ("range_m", "ranges", "feet", 0.3048), ("range_m", "ranges", "inches", 0.0254),
    ("forward_mps", "speeds", "km/h", 3.6), ("forward_mps", "speeds", "millimetres per second", 1e3),
    ("forward_mps", "speeds", "centimetres per second", 1e2), ("forward_mps", "speeds", "miles an hour", 1 / 0.44704),
    ("forward_mps", "speeds", "feet per second", 1 / 0.3048),
)  # fmt: skip
"""Commoner units first: odometers that are some per cent off cannot tell km/h from feet per second."""
_UNITS = tuple(
    Mistake("length-unit", f"{what} seem to be in {unit}, not in metres ({field})", lengths=factor)
    for field, what, unit, factor in _LENGTHS
)
_ANGLES = (
    Mistake("bearing-unit", "bearings seem to be in degrees, not in radians (bearing_rad)", bearing=pi / 180),
    Mistake("turn-unit", "turn rates seem to be in degrees, not in radians a second (angular_radps)", turn=pi / 180),
    Mistake(
        "bearing-sign",
        "bearings, or turn rates, seem to have the wrong sign: counter-clockwise is positive, from x ahead to y on the "
        "left (bearing_rad, angular_radps)",
        bearing=-1.0,
    ),
    Mistake(
        "turn-sign",
        "turn rates, or bearings, seem to have the wrong sign: counter-clockwise is positive (angular_radps, "
        "bearing_rad)",
        turn=-1.0,
    ),
    Mistake(
        "forward-sign",
        "the robot seems to drive the other way than it says: forward speeds have the wrong sign (forward_mps), or the "
        "sensor looks backwards ([mount] theta_rad)",
        forward=-1.0,
    ),
    *(
        Mistake(
            "bearing-axis",
            f"bearings seem to be {side} from another axis: they count from x ahead (bearing_rad, x_m and y_m, or "
            "[mount] theta_rad)",
            bearing=sign,
            offset_rad=offset,
        )
        for sign in (1.0, -1.0)
        for offset, side in ((pi / 2, "90 degrees off,"), (-pi / 2, "90 degrees off,"))
    ),
)
_DELAYS_S = (*np.arange(1.0, 10.0, 0.5).tolist(), *np.arange(10.0, 61.0, 1.0).tolist())
LEAST_STEP_S = 0.4
"""Smaller steps of one clock against the other are the calibration's, which has a delay."""
_FACTORS = tuple(10.0**power for power in np.arange(-4.0, 4.01, 0.1) if abs(power) > 0.25)


def _late(delay_s: float) -> Mistake:
    side = "later" if delay_s > 0 else "earlier"
    message = (
        f"odometry stamps seem to be {abs(delay_s):.1f} s {side} than those of the detections: two clocks, or one of "
        "them stamped on arrival"
    )
    return Mistake("clock", message, delay_s=delay_s)


def _longer(factor: float) -> Mistake:
    told = 1.0 / factor
    how = f"{told:.3g} times too long" if told > 1 else f"{factor:.3g} times too short"
    message = f"ranges seem to be {how} for the way driven: another unit of ranges or speeds (range_m, forward_mps)"
    return Mistake("length-unit", message, lengths=factor)


def findings(recording: Recording, *, identities: bool = True, settings: CheckConfig = USUAL) -> tuple[Finding, ...]:
    """Return everything that is odd about a valid recording, the worst first.

    Args:
        recording: valid, with the sensor's limits in force. Its truth is not looked at.
        identities: False where the identities of its detections are not used.
        settings: what counts as odd.
    """
    found = [*_motion(recording, settings), *_limits(recording)]
    if identities:
        found += _identities(recording, settings)
    return tuple(sorted(found, key=lambda finding: finding.usable))


def odd(recording: Recording, *, identities: bool = True, settings: CheckConfig = USUAL) -> tuple[str, ...]:
    """Return what `findings` has, as warnings of a run.

    Raises:
        DataError: identities that would cost gigabytes and tell nothing.
    """
    found = findings(recording, identities=identities, settings=settings)
    for finding in found:
        if finding.code == "own-identities" and not finding.usable:
            raise DataError(f"{recording.name}: {finding.message}", hint="leave landmark_id empty, and `unknown_ids`")
    return tuple(finding.message for finding in found)


def far_off(parameters: Sequence[ParameterEstimate], settings: CheckConfig = USUAL) -> tuple[str, ...]:
    """Return a warning for every calibration state that a run found far outside of what its prior expects."""
    told = []
    for state in parameters:
        if state.fixed or not state.prior_sigma > 0.0:
            continue
        away = abs(state.value - state.prior_mean) / state.prior_sigma
        if away > settings.far_off:
            told.append(
                f"{state.name} = {state.value:.3g} {state.unit}".removesuffix(" 1")
                + f" is {away:.0f} standard deviations from what sensors do: {_CAUSES[state.name]}"
            )
    return tuple(told)


_CAUSES = {
    "range_bias_m": "ranges in another unit, or counted from another place than the sensor's origin",
    "range_slope": "ranges or speeds in another unit",
    "range_skew_per_rad": "bearings from another axis, or with the wrong sign",
    "range_curvature_per_rad2": "bearings in another unit",
    "bearing_bias_rad": "the sensor is turned otherwise than [mount] theta_rad says",
    "odometry_delay_s": "two clocks: odometry and detections are stamped differently",
    "odometry_forward_scale": "speeds or ranges in another unit, or a wrong wheel radius",
    "odometry_turn_scale": "turn rates in another unit or with the wrong sign, or a wrong wheel base",
    "odometry_askew_rad": "the sensor is turned otherwise than [mount] theta_rad says, or the robot drives askew",
    "odometry_turn_slip_m": "the sensor sits elsewhere than [mount] x_m, y_m say, or bearings have the wrong sign",
}


def _contents(recording: Recording) -> dict[str, dict[str, Any]]:
    """Rates, gaps, ways and coverage, in numbers."""
    odometry, frames, detections = recording.odometry, recording.frames, recording.detections
    step_s = np.diff(odometry.stamp_s)
    way_m = float(np.sum(np.hypot(odometry.forward_mps, odometry.lateral_mps)[:-1] * step_s))
    known = detections.landmark_id != UNKNOWN
    of_landmark = np.unique(detections.landmark_id[known], return_counts=True)[1]
    filled = np.unique(detections.frame)
    seen_s = np.concatenate([odometry.stamp_s[:1], frames.stamp_s[filled], odometry.stamp_s[-1:]])
    inside = (frames.stamp_s >= odometry.stamp_s[0]) & (frames.stamp_s <= odometry.stamp_s[-1])
    sensor = recording.sensor
    return {
        "odometry": {
            "rows": len(odometry),
            "duration_s": float(odometry.stamp_s[-1] - odometry.stamp_s[0]),
            "rate_hz": 1.0 / float(np.median(step_s)),
            "longest_gap_s": float(step_s.max()),
            "way_m": way_m,
            "turned_rad": float(np.sum(np.abs(odometry.angular_radps[:-1]) * step_s)),
            "fastest_mps": float(np.hypot(odometry.forward_mps, odometry.lateral_mps).max()),
        },
        "frames": {
            "count": len(frames),
            "complete": frames.complete,
            "rate_hz": 1.0 / float(np.median(np.diff(frames.stamp_s))) if len(frames) > 1 else None,
            "with_detections": len(filled),
            "during_odometry": int(inside.sum()),
            "longest_blind_s": float(np.diff(np.sort(seen_s)).max()),
        },
        "detections": {
            "count": len(detections),
            "without_identity": int(np.sum(~known)),
            "range_m": [float(edge) for edge in np.quantile(detections.range_m, [0.0, 0.5, 1.0])],
            "bearing_rad": [float(edge) for edge in np.quantile(detections.bearing_rad, [0.0, 0.5, 1.0])],
            "beyond_range_max": int(np.sum(detections.range_m > sensor.range_max_m)),
            "outside_view": int(
                np.sum(
                    (detections.bearing_rad > sensor.bearing_max_rad)
                    | (detections.bearing_rad < sensor.bearing_min_rad)
                )
            ),
        },
        "landmarks": {
            "count": len(of_landmark),
            "seen_once": int(np.sum(of_landmark == 1)),
            "median_detections": float(np.median(of_landmark)) if len(of_landmark) else None,
        },
    }


def _limits(recording: Recording) -> list[Finding]:
    """Readings beyond what the sensor is said to reach, by more than its noise."""
    sensor, detections = recording.sensor, recording.detections
    slack_m = 4.0 * (sensor.sigma_range_m or 0.025 * min(sensor.range_max_m, 1e3))
    slack_rad = 4.0 * (sensor.sigma_bearing_rad or 0.0125)
    far, bearing = detections.range_m > sensor.range_max_m + slack_m, detections.bearing_rad
    aside = (bearing > sensor.bearing_max_rad + slack_rad) | (bearing < sensor.bearing_min_rad - slack_rad)
    found = []
    if far.any():
        most = f"up to {detections.range_m.max():.4g} m"
        found.append(
            Finding(
                "beyond-range",
                f"{int(far.sum())} of {len(far)} ranges lie beyond range_max_m = {sensor.range_max_m:g}, {most}: "
                + ("another unit than metres, or a wrong limit" if np.mean(far) > 0.05 else "outliers"),
            )
        )
    if aside.any():
        view = f"{sensor.bearing_min_rad:.4g} to {sensor.bearing_max_rad:.4g} rad"
        found.append(
            Finding(
                "beyond-view",
                f"{int(aside.sum())} of {len(aside)} bearings lie outside of the field of view, {view}: "
                + ("another unit or sign, or wrong limits" if np.mean(aside) > 0.05 else "outliers"),
            )
        )
    return found


def _identities(recording: Recording, settings: CheckConfig) -> list[Finding]:
    """Identities that never come back."""
    detections = recording.detections
    known = detections.landmark_id != UNKNOWN
    pairs = np.unique(np.column_stack([detections.landmark_id, detections.frame])[known], axis=0)
    frames_of_landmark = np.unique(pairs[:, 0], return_counts=True)[1]
    count, again = len(frames_of_landmark), int(np.sum(frames_of_landmark > 1))
    if count < settings.fewest or again > 0.1 * count:
        return []
    message = (
        f"{count} landmarks in {int(known.sum())} detections, {again} of them seen more than once: landmark_id has to "
        "name the thing that was seen, the same each time, not the detection"
    )
    return [Finding("own-identities", message, usable=count < settings.own_ids)]


def _motion(recording: Recording, settings: CheckConfig) -> list[Finding]:
    """Mistakes that make landmarks move that stand still."""
    first, second = _pairs(recording, settings)
    if len(first) < settings.fewest:
        return []
    pairs = _Pairs(recording, first, second)
    odometry = recording.odometry
    speed = np.abs(np.concatenate([odometry.forward_mps, odometry.lateral_mps, odometry.angular_radps]))
    if speed.max() < 1e-9:
        moved = np.hypot(*pairs.residual(_HONEST)) > 0.1
        if np.sum(moved) < settings.fewest or np.mean(moved) < 0.1:
            return []
        message = (
            f"the odometry is zero throughout, but {np.mean(moved):.0%} of the landmarks seen again within seconds "
            "have moved in the sensor's view: the robot drove (forward_mps, angular_radps)"
        )
        return [Finding("no-odometry", message, usable=False)]
    undone = _HONEST
    found: list[Finding] = []
    for _ in range(3):
        mistake = _likeliest(pairs, undone, {finding.code for finding in found}, settings)
        if mistake is None:
            break
        found.append(Finding(mistake.code, mistake.message, usable=False))
        undone = mistake.after(undone)
    off = float(np.median(np.hypot(*pairs.residual(undone))))
    if off > settings.off:
        message = (
            "landmarks do not stand still: seen again within seconds, half of them are over "
            f"{off:.2g} rad or {off:.0%} of their range from where odometry says; mixed identities, or a mistake in "
            "several units, signs or frames at once"
        )
        return [Finding("landmarks-move", message)]
    return found


def _likeliest(pairs: _Pairs, undone: Mistake, told: set[str], settings: CheckConfig) -> Mistake | None:
    """The mistake that explains most of what is left, if it surely explains anything."""
    before = pairs.residual(undone)
    candidates = [*_UNITS, *_ANGLES, *(_longer(factor) for factor in _FACTORS)]
    candidates += [_late(side * delay_s) for delay_s in _DELAYS_S for side in (1.0, -1.0)]
    scored = [
        (loss, mistake)
        for mistake in candidates
        if mistake.code not in told
        for loss in [_nearer(before, pairs.residual(mistake.after(undone)), settings)]
        if loss is not None
    ]
    if not scored:
        return None
    least, best = min(scored, key=lambda pair: pair[0])

    def left(mistake: Mistake) -> float:
        return _loss(pairs.residual(mistake.after(undone)), settings)

    if best.code == "clock":
        near_s = [best.delay_s + 0.1 * step for step in range(-5, 6)]
        return min(map(_late, near_s), key=left)
    if best.code == "length-unit":  # a unit that has a name is likelier than a factor that has none
        gain = _loss(before, settings) - least
        named = [
            mistake
            for loss, mistake in scored
            if mistake in _UNITS and abs(log(mistake.lengths / best.lengths)) < 0.3 and loss < least + 0.1 * gain
        ]
        if named:
            return named[0]
        near = [_longer(best.lengths * 10.0 ** (0.01 * step)) for step in range(-10, 11)]
        return min(near, key=left)
    return best


def _nearer(before: FloatArray, after: FloatArray, settings: CheckConfig) -> float | None:
    """Loss of the residuals (2, P) after undoing a mistake, if almost all pairs that tell come nearer by it."""
    was, now = np.hypot(*before), np.hypot(*after)
    apart = np.hypot(after[0] - before[0], se2.wrap(after[1] - before[1]))
    telling = apart > max(settings.fits, settings.apart * min(float(np.median(was)), float(np.median(now))))
    if np.sum(telling) < settings.fewest or np.mean(now[telling] < was[telling]) < settings.agreed:
        return None
    loss = _loss(after, settings)
    return loss if len(was) * (_loss(before, settings) - loss) > settings.gain else None


def _loss(residual: FloatArray, settings: CheckConfig) -> float:
    """Mean Cauchy loss of residuals (2, P): one wrong identity costs little."""
    return float(np.mean(np.log1p((np.minimum(np.hypot(*residual), 10.0) / settings.fits) ** 2)))


def _pairs(recording: Recording, settings: CheckConfig) -> tuple[IntArray, IntArray]:
    """Rows of detections: two of the same landmark each, within a few seconds and within the odometry's time."""
    detections = recording.detections
    stamp_s = recording.frames.stamp_s[detections.frame]
    odometry_s = recording.odometry.stamp_s
    known = detections.landmark_id != UNKNOWN
    if not known.any() or len(odometry_s) < 2:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    known &= (stamp_s >= odometry_s[0]) & (stamp_s <= odometry_s[-1])
    rows = np.flatnonzero(known)
    rows = rows[np.lexsort((stamp_s[rows], detections.landmark_id[rows]))]
    landmark = np.unique(detections.landmark_id[rows], return_inverse=True)[1]
    time_s = stamp_s[rows]
    spread_s = (np.ptp(time_s) if len(rows) else 0.0) + 4.0 * settings.lags_s[-1]
    place = landmark * spread_s + time_s - (time_s.min() if len(rows) else 0.0)
    chosen = []
    for lag_s in settings.lags_s:
        later = np.searchsorted(place, place + lag_s)
        found = np.flatnonzero(later < len(rows))
        found = found[place[later[found]] - place[found] <= 2.0 * lag_s]
        found = found[np.linspace(0, len(found) - 1, min(len(found), settings.most_pairs)).astype(np.int64)]
        chosen.append(np.stack([rows[found], rows[later[found]]]))
    first, second = np.concatenate(chosen, axis=1)
    return first, second


class _Pairs:
    """Pairs of sightings of a landmark each, and what odometry says of them."""

    def __init__(self, recording: Recording, first: IntArray, second: IntArray) -> None:
        detections = recording.detections
        self._odometry = recording.odometry
        self._mount = np.array(recording.sensor.mount_robot_sensor, dtype=np.float64)
        stamp_s = recording.frames.stamp_s[detections.frame]
        self._stamp_s = stamp_s[first], stamp_s[second]
        self._range_m = detections.range_m[first], detections.range_m[second]
        self._bearing_rad = detections.bearing_rad[first], detections.bearing_rad[second]
        self._tracks: dict[tuple[float, float], FloatArray] = {}
        self._motions: dict[tuple[float, float, float], tuple[FloatArray, FloatArray]] = {}

    def residual(self, mistake: Mistake) -> FloatArray:
        """Return (2, P) second reading minus what the first one and the odometry predict: log range, and bearing."""
        start, stop = self._poses(mistake.forward, mistake.turn, mistake.delay_s)
        metres = np.array([1.0 / mistake.lengths, 1.0 / mistake.lengths, 1.0])
        mount = self._mount * metres
        motion = se2.between(se2.compose(start * metres, mount), se2.compose(stop * metres, mount))
        bearing = [mistake.bearing * each + mistake.offset_rad for each in self._bearing_rad]
        range_m = self._range_m
        seen = np.stack([range_m[0] * np.cos(bearing[0]), range_m[0] * np.sin(bearing[0])], axis=1)
        x, y = se2.transform(se2.inverse(motion), seen).T
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            far = np.log(range_m[1]) - np.log(np.maximum(np.hypot(x, y), 1e-12))
        return np.stack([np.nan_to_num(far, posinf=inf), se2.wrap(bearing[1] - np.arctan2(y, x))])

    def _poses(self, forward: float, turn: float, delay_s: float) -> tuple[FloatArray, FloatArray]:
        """(P, 3) poses of the robot at the first and at the second sighting, by odometry."""
        if (forward, turn) not in self._tracks:
            self._tracks[forward, turn] = _dead_reckoned(self._odometry, forward, turn)
        if (forward, turn, delay_s) not in self._motions:
            track, stamps = self._tracks[forward, turn], self._odometry.stamp_s
            first, second = (
                np.stack([np.interp(stamp_s + delay_s, stamps, column) for column in track], axis=1)
                for stamp_s in self._stamp_s
            )
            self._motions[forward, turn, delay_s] = first, second
        return self._motions[forward, turn, delay_s]


def clock_steps(recording: Recording, settings: CheckConfig = USUAL) -> tuple[FloatArray, FloatArray]:
    """Return from when on the odometry's clock is ahead of the detections', and by how much.

    Piecewise constant, by dynamic programming (Viterbi 1967): in every second a pair of sightings has a Cauchy loss, on
    the scale of the usual residual, at each delay, and a step costs `settings.gain`.

    Args:
        recording: valid; its truth is not looked at.
        settings: how much readings must gain by a step.

    Returns:
        (K,) stamps of frames, the first -inf, and (K,) delays that hold from then on [s].
    """
    first, second = _pairs(recording, settings)
    none = np.array([-inf]), np.zeros(1)
    if len(first) < settings.fewest:
        return none
    pairs = _Pairs(recording, first, second)
    delays_s = np.concatenate([[0.0, 0.5, -0.5], _DELAYS_S, np.negative(_DELAYS_S)])
    off = np.stack([np.minimum(np.hypot(*pairs.residual(_late(delay_s))), 10.0) for delay_s in delays_s])
    until_s = recording.frames.stamp_s[recording.detections.frame[second]]
    begin_s, second_of = np.unique(np.floor(until_s), return_inverse=True)
    usual, path = settings.fits, np.zeros(len(begin_s), dtype=np.int64)
    for _ in range(2):  # what is usual shows at the right delays only
        usual = max(settings.fits, float(np.median(off[path[second_of], np.arange(len(first))])))
        # a sighting is in two pairs
        loss = 0.5 * np.log1p((off / usual) ** 2)
        path = _cheapest(np.stack([np.bincount(second_of, row, len(path)) for row in loss], axis=1), settings.gain)
    begin = np.flatnonzero(np.diff(path, prepend=-1))
    since_s, delay_s = [-inf], [0.0]
    for row, (start, stop) in enumerate(pairwise([*begin.tolist(), len(path)])):
        mine = (second_of >= start) & (second_of < stop)
        near_s = delays_s[path[start]] + 0.1 * np.arange(-5, 6)
        left = [_loss(pairs.residual(_late(delay))[:, mine], settings) for delay in near_s]
        found = float(near_s[int(np.argmin(left))])
        if row == 0:
            delay_s[0] = found
        elif abs(found - delay_s[-1]) > LEAST_STEP_S:
            since_s.append(float(begin_s[start]))
            delay_s.append(found)
    return np.array(since_s), np.array(delay_s)


def _cheapest(loss: FloatArray, step: float) -> IntArray:
    """(T,) options, one for each row of a table of losses (T, D), of which each change costs `step`."""
    total, came = loss[0].copy(), np.zeros(loss.shape, dtype=np.int64)
    every = np.arange(loss.shape[1])
    for row in range(1, len(loss)):
        best = int(np.argmin(total))
        changed = total > total[best] + step
        came[row] = np.where(changed, best, every)
        total = np.where(changed, total[best] + step, total) + loss[row]
    path = np.full(len(loss), np.argmin(total), dtype=np.int64)
    for row in range(len(loss) - 1, 0, -1):
        path[row - 1] = came[row, path[row]]
    return path


def _dead_reckoned(odometry: Odometry, forward: float, turn: float) -> FloatArray:
    """(3, N) x, y and unwrapped heading at the odometry's stamps, with factors on speed and turn rate."""
    step_s = np.diff(odometry.stamp_s)
    turned = np.append(0.0, np.cumsum(turn * odometry.angular_radps[:-1] * step_s))
    heading = turned[:-1] + 0.5 * np.diff(turned)
    ahead = forward * odometry.forward_mps[:-1] * step_s
    aside = odometry.lateral_mps[:-1] * step_s
    x = np.append(0.0, np.cumsum(ahead * np.cos(heading) - aside * np.sin(heading)))
    y = np.append(0.0, np.cumsum(ahead * np.sin(heading) + aside * np.cos(heading)))
    return np.stack([x, y, turned])


def valid(recording: Recording, sensor: SensorConfig, prior_map: Landmarks | None = None) -> Recording:
    """Return the recording with the sensor that the configuration states.

    Raises:
        InputError: no `Recording`, or values that cannot be, in it or in the prior map.
        DataError: nothing can be estimated from it.
    """
    validate(recording)
    if prior_map is not None:
        check_landmarks(prior_map, "prior_map")
    return replace(recording, sensor=sensor.applied_to(recording.sensor))


def check_recording(recording: Recording, config: Config | None = None) -> Check:
    """Tell what a recording holds, and what is odd about it: units, signs, clocks, identities, limits, gaps.

    `run_slam`, `run_session` and `run_localization` tell the same in the warnings of their results.

    Args:
        recording: what a reader returned; its truth is not looked at.
        config: settings; None for the defaults. Its section `sensor` may correct the sensor's limits.

    Raises:
        InputError: no `Recording`, or one with values that cannot be.
        DataError: nothing can be estimated from it.
    """
    config = config or Config()
    return Check.of(valid(recording, config.sensor), identities=not config.slam.unknown_ids, settings=config.slam.check)
