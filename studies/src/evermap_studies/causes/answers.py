"""Which answers are right: the one table of the codes that name a cause, and how they are looked for in a run.

Codes are those of `Cause.code` and of the findings of `evermap check`; states are calibration states that a run
estimated near their true value and more than three standard deviations from what was stated, which names the cause as
well. A run that is refused names a cause by a word in its one line.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from evermap.types import VerdictKind

SOUND = frozenset({VerdictKind.SOUND, VerdictKind.WEAK})
SUSPECT = frozenset({VerdictKind.SENSOR_SUSPECT})
OUTDATED = frozenset({VerdictKind.MAP_OUTDATED})
LOST = frozenset({VerdictKind.LOST})
REFUSED = SUSPECT | LOST
MENDED = SOUND | SUSPECT


@dataclass(frozen=True, slots=True)
class Answer:
    """What is right of a cause.

    Attributes:
        verdicts: kinds with which such a run may end.
        codes: any of these names it.
        words: any of these names it in the line of a refusal, in lower case.
        states: ends of names of calibration states that name it, estimated near the truth.
        is_change: the changes that are told name it, and nothing else has to.
        is_optional: robust estimation may do, without a word.
    """

    verdicts: frozenset[VerdictKind]
    codes: frozenset[str] = frozenset()
    words: tuple[str, ...] = ()
    states: tuple[str, ...] = ()
    is_change: bool = False
    is_optional: bool = False


def _answer(verdicts: frozenset[VerdictKind], codes: str, words: str, states: str = "") -> Answer:
    return Answer(verdicts, frozenset(codes.split()), tuple(words.split()), tuple(states.split()))


_SCALES = "length-unit odometer-scale odometry-scale range-scale scale forward-scale "
_CLOCKS = "clock delay sensor-delay clock-drift clock-step clock-jitter "
_MOUNTS = "mount mount-axes mount-flip mount-angle mount-position sensor-mount "
_LENSES = "lens focal focal-axes focal-length intrinsics distortion camera-lens calibration "
_SITES = "map-site another-site other-site map-frame map "
_ODOMETRY = "odometry-axes odometry-frame axes forward-sign turn-sign "
_SIZES = "tag-size tag-sizes tag-size-all "
_UNITS = "unit millimet centimet feet inch metres km/h miles"

ANSWERS = {
    "": Answer(SOUND, is_optional=True),
    "noise": Answer(SOUND, is_optional=True),
    "anything": Answer(REFUSED | OUTDATED, is_optional=True),
    "change": Answer(SOUND | OUTDATED, is_change=True),
    "carried": _answer(MENDED, "carried-about", "carried"),
    "wrong identity": _answer(
        MENDED, "identity wrong-identity duplicate-identity duplicate double-identity rides-along", "identit"
    ),
    "misread": replace(
        _answer(MENDED | LOST, "misread misread-identities identity wrong-identity outliers", "identit"),
        is_optional=True,
    ),
    "other numbers": _answer(
        OUTDATED | LOST, _SITES + "map-identities other-identities identity-offset no-common-identity", "identit common"
    ),
    "odometer scale": _answer(MENDED, _SCALES, "odometer", "odometry_forward_scale odometry_scale"),
    "turn scale": _answer(MENDED, "turn-scale odometry-turn-scale turn-unit", "turn", "odometry_turn_scale"),
    "odometry bias": _answer(MENDED, "odometry-bias turn-bias gyro-bias bias", "bias", "turn_bias odometry_bias"),
    "wheel": _answer(
        MENDED | LOST,
        "wheel-slip odometry-bias turn-bias turn-scale turn-slip odometry-turn-scale odometer-scale slip",
        "turn wheel",
        "odometry_turn_slip_m turn_bias",
    ),
    "range scale": _answer(
        MENDED, _SCALES + "baseline", "range", "range_slope range_scale odometry_forward_scale odometry_scale"
    ),
    "range bias": _answer(MENDED, "range-bias range-offset", "range", "range_bias_m"),
    "range bias of one": _answer(MENDED, "range-bias", "range"),
    "tag size": _answer(MENDED, _SIZES + "range-scale length-unit", "size", "range_scale odometry_scale"),
    "size of one": _answer(MENDED, _SIZES + "tag-size-one", "size"),
    "size of a kind": _answer(MENDED, _SIZES + "tag-size-kind tag-size-class", "size"),
    "delay": _answer(MENDED, _CLOCKS, "clock late", "_delay_s"),
    "clock": _answer(REFUSED, _CLOCKS, "clock stamps late", "_delay_s"),
    "mount": _answer(
        MENDED,
        _MOUNTS + "bearing-axis forward-sign",
        "mount",
        "bearing_bias_rad mount_forward_m mount_left_m odometry_askew_rad",
    ),
    "axes": _answer(REFUSED, _MOUNTS + "axes bearing-axis", "axes axis mount frame"),
    "turn sign": _answer(REFUSED, "turn-sign bearing-sign mirrored odometry-axes", "sign mirror"),
    "bearing sign": _answer(REFUSED, "bearing-sign turn-sign mirrored", "sign mirror"),
    "forward sign": _answer(REFUSED, _MOUNTS + "forward-sign bearing-axis odometry-axes", "sign opposite mount"),
    "bearing axis": _answer(REFUSED, _MOUNTS + "bearing-axis forward-sign", "axis mount"),
    "length unit": _answer(REFUSED, _SCALES + _SIZES + "odometry-unit", _UNITS),
    "angle unit": _answer(REFUSED, "bearing-unit turn-unit", "degrees"),
    "lens": _answer(REFUSED, _LENSES, "lens focal distort intrinsic"),
    "resolution": _answer(
        REFUSED, _LENSES + _SIZES + "resolution beyond-view range-scale length-unit", "resolution focal lens size"
    ),
    "baseline": _answer(
        MENDED | LOST, _SCALES + "baseline stereo", "baseline range disparity", "range_scale odometry_scale"
    ),
    "corner order": _answer(REFUSED, "corner-order corners tag-corners mount-axes tag-axes", "corner"),
    "pose convention": _answer(
        REFUSED,
        _MOUNTS + "detection-poses detection-axes pose-inverse tag-poses quaternion-order orientation tag-axes axes "
        "bearing-axis",
        "invers quaternion axes orientation",
    ),
    "odometry axes": _answer(
        REFUSED,
        _ODOMETRY + _MOUNTS + "odometry-poses quaternion-order odometry-inverse",
        "axes sign odometry quaternion",
    ),
    "jump": _answer(MENDED, "odometry-jumps odometry-jump odometry-break jump break", "jump"),
    "silence": _answer(MENDED, "odometry-silence odometry-silent silence odometry-gap gap odometry-break", "silen gap"),
    "map scale": _answer(OUTDATED, "map-scale map-unit scale", "scale " + _UNITS),
    "map mirror": _answer(OUTDATED, "map-mirror map-mirrored mirrored mirrored-map", "mirror"),
    "map site": _answer(OUTDATED | LOST, _SITES, "site map"),
    "map part": _answer(OUTDATED | LOST, _SITES + "map-mirrored", "site map mirror"),
    "map axes": _answer(
        OUTDATED | LOST, _SITES + "map-axes map-mirror map-mirrored mirrored-map map-tag-axes tag-axes", "axes map"
    ),
}
"""By the cause of a world. 'anything': a run that isn't called sound, whatever it names."""
