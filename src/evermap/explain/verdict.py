"""The verdict that every run ends with: how far it can be trusted, by signs that need no truth.

Each sign has a range in which it is where all is well (`LIMITS`). Where the readings themselves contradict each other,
or a calibration is far from what sensors are like, the sensor or the odometry is suspected; where too much of a given
map is not as found, the map; where the solution contradicts the readings, it is lost. What remains may be right, but
too little known: then it is weak.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite, isnan, log

from evermap.config import SlamConfig
from evermap.explain.answer import OWN_STATES
from evermap.explain.scores import MOST_SHIFT, ScreenedSession, score_session
from evermap.explain.symptoms import Signs, measure_signs, with_scores
from evermap.slam.calibration import far_off
from evermap.slam.mistakes import Finding
from evermap.types import (
    AnyRecording,
    Cause,
    Landmarks,
    ParameterEstimate,
    SlamResult,
    Symptom,
    Verdict,
    VerdictKind,
)


@dataclass(frozen=True, slots=True)
class Limit:
    """Between what a sign is where all is well, and what it says beyond.

    Attributes:
        code: of the symptom.
        sign: name in `Signs`.
        text: the value in words, and {name} of the calibration state that is farthest off; what is expected follows.
        least, most: the range.
        kind: of the verdict, if nothing worse is found.
        why: what it means where it is beyond.
        hint: what would decide or mend it.
    """

    code: str
    sign: str
    text: str
    least: float
    most: float
    kind: VerdictKind
    why: str
    hint: str = ""


LOST, WEAK, OUTDATED, SUSPECT = (
    VerdictKind.LOST, VerdictKind.WEAK, VerdictKind.MAP_OUTDATED, VerdictKind.SENSOR_SUSPECT
)  # fmt: skip
SURE = 0.9
"""Probability from which a cause is told as such."""
LEAST_HAND = -2.3
"""Nats from which the drive is mirrored with less than a hundredth: of a thousand robots one has the sign wrong."""
WORST_NIS = 8.0
"""Four times the expectation of two numbers: errors are twice as large as they are said to be."""
LIMITS = (
    Limit(
        "not-finite", "n_unknown", "{:.0f} poses and landmarks are no numbers", -inf, 0.0, LOST,
        "the solution is none",
    ),
    Limit(
        "innovations", "nis", "innovations {:.3g} (2 expected)", -inf, WORST_NIS, LOST,
        "readings are farther from the solution than their noise allows",
    ),
    Limit(
        "used", "used", "{:.0%} of the detections used", 0.6, inf, LOST,
        "many detections contradict the solution",
    ),
    Limit(
        "identities", "named", "{:.0%} of the identified detections used", 0.6, inf, LOST,
        "many detections contradict the solution, or their identities are wrong",
    ),
    Limit(
        "worst-stretch", "used_worst", "{:.0%} used in the worst tenth of the drive", 0.3, inf, LOST,
        "a part of the drive contradicts the rest",
    ),
    Limit(
        "landmarks-contradicted", "contradicted", "{:.0%} of the landmarks contradicted by most of their detections",
        -inf, 0.25, LOST, "landmarks are not where they are seen",
    ),
    Limit(
        "misfit", "misfit_all", "detections off by {:.1%} of their range", -inf, 0.15, LOST,
        "detections are nowhere near their landmarks",
    ),
    Limit(
        "halves", "halves_share", "halves of the drive differ by {:.1%} of the range", -inf, 0.1, LOST,
        "landmarks are elsewhere by the second half of the drive than by the first",
    ),
    Limit(
        "without-loops", "lead_nats", "landmarks met again are worth {:.0f} nats over odometry alone", -7.0, inf, LOST,
        "detections without identities tie the poses to each other worse than odometry alone",
        "slower turns, landmarks that are further apart, or identities",
    ),
    Limit(
        "bent-odometry", "bent_nats", "{:.1f} nats for each landmark met again", -inf, 3.0, LOST,
        "landmarks without identities are mistaken for others", "landmarks that are further apart, or identities",
    ),
    Limit(
        "without-landmark", "dropped", "{:.0%} of the detections without identity are of no landmark", -inf, 0.4, LOST,
        "many detections contradict the solution", "fewer false detections, or identities",
    ),
    Limit(
        "odometry", "motion", "odometry off by {:.0%} of the motion", -inf, 0.3, SUSPECT,
        "odometry and sightings contradict each other",
        "odometry's direction, clock and noise, or the sensor's [mount]",
    ),
    Limit(
        "length", "longer", "trajectory {:.3g} times as long as by odometry", 1.0 / 1.15, 1.15, SUSPECT,
        "odometry and sightings contradict each other on the length of the drive",
        "units and scale of the odometry, or the size of tags and the unit of ranges",
    ),
    Limit(
        "held", "held", "poses {:.1f} standard deviations elsewhere if {name}", -inf, MOST_SHIFT, SUSPECT,
        "a calibration that was held as stated is another",
        "the calibration of the sensor measured again, or stated as uncertain in sensor.toml",
    ),
    Limit(
        "alternation", "alternation", "errors of odometry alternate, by {:.1f} standard deviations", -inf, 2.5, SUSPECT,
        "stamps of the detections are late by another delay each", "stamps of exposure, not of arrival",
    ),
    Limit(
        "map-changed", "moved", "{:.0%} of the map's landmarks in view changed", -inf, 0.5, OUTDATED,
        "too much of the map is not as it was", "a new map, or the edition of the map that was built",
    ),
    Limit(
        "map-displaced", "displaced", "{:.0%} of the map's landmarks in view elsewhere", -inf, 1.0 / 3.0, WEAK,
        "so many moved that it may as well be the others", "a map that was built again, or some landmarks surveyed",
    ),
    Limit(
        "scale", "apart", "lengths by odometry and by detections differ by {:.1%}", -inf, 0.04, WEAK,
        "nothing says which of the two measures true metres",
        "a map with surveyed positions, or what is known better: sigma_scale of [sensor] or sigma_odometer_scale of "
        "[odometry] in sensor.toml",
    ),
    Limit(
        "stated-scale", "away_scale", "a scale is {:.1f} standard deviations from what is stated", -inf, 3.0, WEAK,
        "lengths by odometry and by detections differ more than is stated of either",
        "a map with surveyed positions, or the size of tags and the wheel radius measured again",
    ),
    Limit(
        "stated", "away", "{:.1f} standard deviations from what is stated: {name}", -inf, 4.0, WEAK,
        "the calibration is not as stated", "what is known of it, in sensor.toml",
    ),
    Limit(
        "clocks", "shift", "poses by the other clock are {:.1f} standard deviations away", -inf, 1.0, WEAK,
        "odometry and detections are stamped differently, and nothing says which clock is right",
        "stamps of one clock, or the delay of the odometry taken off its stamps",
    ),
    Limit(
        "over-odometry", "over_odometry", "detections scatter {:.2f} times as far as by odometry alone", -inf, 1.2,
        LOST,
        "odometry alone explains the detections better than the solution does",
    ),
    Limit(
        "noise-of-detections", "noise_seen", "detections {:.1f} times as noisy as sensors usually are", -inf, 4.0, WEAK,
        "the solution hardly listens to the detections", "calibration of the sensor, or its noise as stated",
    ),
    Limit(
        "noise-of-odometry", "noise_driven", "odometry {:.1f} times as noisy as is usual", -inf, 2.5, WEAK,
        "the solution hardly follows the odometry", "calibration and clock of the odometry, or the sensor's [mount]",
    ),
    Limit(
        "adrift", "adrift", "{:.0f} poses beside a break of the odometry with detections that are not used", -inf, 0.0,
        WEAK, "odometry broke, and detections do not agree where", "the stretch left out, or two drives",
    ),
    Limit(
        "unexplained", "unexplained", "{:.0f} landmarks with many detections in a row unused", -inf, 0.0, WEAK,
        "a landmark moved during the drive, or is another one, and it was not found which",
        "another drive past it",
    ),
    Limit(
        "uncertainty", "sigma_share", "positions known to {:.1%} of the size of the place", -inf, 0.05, WEAK,
        "hardly anything ties the poses to each other", "a drive that comes back to landmarks seen before",
    ),
    Limit(
        "landmarks", "n_landmarks", "{:.0f} landmarks", 2.0, inf, WEAK,
        "so few landmarks check each other hardly", "more landmarks",
    ),
    Limit(
        "blind", "blind_share", "nothing seen for {:.0%} of the drive", -inf, 0.5, WEAK,
        "there the poses are those of the odometry", "landmarks where nothing is seen",
    ),
    Limit(
        "mirrored", "hand", "{:.1f} nats for the sign of turns, by the side on which the sensor sits", LEAST_HAND, inf,
        WEAK, "of ranges alone the drive fits better mirrored",
        "a map with surveyed positions, or one landmark that is known to be on the left",
    ),
)  # fmt: skip
"""In the order of what is told first.

Chosen by reason, beside runs of `python -m benchmarks.verdicts` (all of them were looked at); its worlds of fresh seeds
are held out. Those of detections without identities are the settings of `slam.association` that warn of the same.
"""
FEWEST_MOVED = 3
"""Changed landmarks from which a map is outdated: fewer are changes, whatever share they are."""
PUT_RIGHT, MOST_TURNED = frozenset({"clock", "turn-bias", "turn-scale"}), 0.3
"""Causes that leave a solution right that has taken them in; and the logarithm of a scale from which turns are another
unit, or of another robot."""


def with_verdict(
    result: SlamResult,
    recording: AnyRecording,
    settings: SlamConfig,
    prior_map: Landmarks | None = None,
    *,
    findings: Sequence[Finding] = (),
    set_aside: str = "",
    as_read: AnyRecording | None = None,
    asked: ScreenedSession | None = None,
) -> SlamResult:
    """Return the result with its verdict; arguments as of `judge`."""
    verdict = judge(
        result, recording, settings, prior_map,
        findings=findings, set_aside=set_aside, as_read=as_read, asked=asked,
    )  # fmt: skip
    return replace(result, verdict=verdict)


def judge(
    result: SlamResult,
    recording: AnyRecording,
    settings: SlamConfig,
    prior_map: Landmarks | None = None,
    *,
    findings: Sequence[Finding] = (),
    set_aside: str = "",
    as_read: AnyRecording | None = None,
    asked: ScreenedSession | None = None,
) -> Verdict:
    """Return how far a run can be trusted.

    Args:
        result: of the run, with its causes.
        recording: as it was estimated; rows of the result's innovations are rows of its detections.
        settings: that it was estimated with.
        prior_map: that was given, or what a living map expected.
        findings: what `slam.check` found odd about the readings alone.
        set_aside: why a session could not be localised in its map; '' where it was, or there is none.
        as_read: the recording with the identities that it was read with; None where they are the same.
        asked: the solution that the result is of. If all else is sound or weak, it is asked what it held as stated:
            what makes a run weak, lengths that contradict each other, may be what that does.
    """
    signs = measure_signs(result, recording, prior_map, as_read)
    wrong = [finding.message for finding in findings if not finding.usable]
    suspicions = [*wrong, *far_off(_without_doubtful(result), settings.check)]
    found = judge_signs(signs, suspicions, result.causes, set_aside)
    if found.kind not in (VerdictKind.SOUND, WEAK) or asked is None:
        return found
    scores = score_session(asked, result.trajectory)
    return judge_signs(with_scores(signs, scores), suspicions, result.causes, set_aside)


def _without_doubtful(result: SlamResult) -> tuple[ParameterEstimate, ...]:
    """Return calibration states but those of a cause that may as well be another: that says more, and what decides."""
    doubtful = [one for one in result.causes if one.instead and one.probability < SURE]
    names = {name for one in doubtful for name, _ in OWN_STATES.get(one.code, ())}
    return tuple(state for state in result.parameters if state.name not in names)


def judge_signs(
    signs: Signs, suspicions: Sequence[str] = (), causes: Sequence[Cause] = (), set_aside: str = ""
) -> Verdict:
    """Return the verdict by signs.

    Args:
        signs: that were measured.
        suspicions: what readings and calibration say of the sensor or the odometry, a line each.
        causes: that were found.
        set_aside: why a session could not be localised in its map.
    """
    symptoms = sorted(_symptoms(signs), key=lambda symptom: not symptom.is_alarming)
    ordered = tuple(sorted(causes, key=lambda cause: -cause.probability))
    kind, message = _decide(signs, suspicions, set_aside, symptoms, ordered)
    return Verdict(kind, message, tuple(symptoms), ordered)


def _symptoms(signs: Signs) -> Iterable[Symptom]:
    """Yield the signs that this run has, each with its range."""
    for limit in LIMITS:
        value = float(getattr(signs, limit.sign))
        few = limit.sign in ("moved", "displaced") and value * signs.common < FEWEST_MOVED
        if isfinite(value) and not few:
            expected = _range_text(limit)
            name = signs.held_name if limit.sign == "held" else signs.away_name
            text = limit.text.format(value, name=name or "any is another")
            yield Symptom(limit.code, f"{text}, {expected}", value, limit.least, limit.most)


def _range_text(limit: Limit) -> str:
    """Return 'at most 50%', in the unit of the sign."""
    form = limit.text[limit.text.index("{") : limit.text.index("}") + 1]
    parts = []
    if limit.least > -inf:
        parts.append(f"at least {form.format(limit.least)}")
    if limit.most < inf:
        parts.append(f"at most {form.format(limit.most)}")
    return " and ".join(parts)


def _decide(
    signs: Signs, suspicions: Sequence[str], set_aside: str, symptoms: Sequence[Symptom], causes: Sequence[Cause]
) -> tuple[VerdictKind, str]:
    """Return the kind, and its reason in one line: what names its remedy comes first."""
    sure = [cause for cause in causes if not (_is_put_right(cause) or cause.probability < SURE)]
    if of_map := [cause for cause in sure if _is_of_map(cause)]:
        return OUTDATED, _cause_text(of_map[0])
    if sure or suspicions:
        return SUSPECT, "; ".join([*map(_cause_text, sure), *(() if sure else suspicions)])
    alarming = {symptom.code: symptom for symptom in symptoms if symptom.is_alarming}
    beyond = [limit for limit in LIMITS if limit.code in alarming]
    for kind in (LOST, SUSPECT):
        if some := [limit for limit in beyond if limit.kind is kind]:
            return kind, _reasons(some, alarming)
    if signs.common == 0:
        return OUTDATED, "no landmark of the map was seen: it is of another site, or its ids are others"
    if set_aside:
        return OUTDATED, f"not localised in the map: {set_aside}"
    if signs.in_map is False:
        return OUTDATED, "what was seen lies nowhere on the map: it is of another site, frame or scale, or mirrored"
    if some := [limit for limit in beyond if limit.kind is OUTDATED]:
        return OUTDATED, _reasons(some, alarming)
    if doubtful := [cause for cause in causes if cause.probability < SURE and not _is_put_right(cause)]:
        return _find_kind_in_doubt(doubtful[0]), _doubt_text(doubtful[0])
    if some := [limit for limit in beyond if limit.kind is WEAK]:
        return WEAK, _reasons(some, alarming)
    return VerdictKind.SOUND, "readings, odometry and solution agree"


def _is_put_right(cause: Cause) -> bool:
    """Return whether it is what the estimator found by itself, without a comparison: a delay, or turns that are off."""
    if cause.code not in PUT_RIGHT or not isnan(cause.nats):
        return False
    return cause.code != "turn-scale" or abs(log(cause.value)) < MOST_TURNED


def _is_of_map(cause: Cause) -> bool:
    return cause.subject.startswith("map") or cause.code.startswith("map")


def _find_kind_in_doubt(cause: Cause) -> VerdictKind:
    """Return the kind of a run of which one of two explanations holds: it can't be used if something is surely wrong.

    States are integrated over 'as stated', too; what has none, and what may hold instead, are mistakes.
    """
    if not (isnan(cause.value) and cause.instead):
        return WEAK
    return OUTDATED if _is_of_map(cause) else SUSPECT


def _cause_text(cause: Cause) -> str:
    return f"{cause.message} (try: {cause.fix})" if cause.fix else cause.message


def _doubt_text(cause: Cause) -> str:
    """Return a cause that was taken, though another explanation may hold as well, and what would decide."""
    other = cause.instead or "nothing is off"
    text = f"of two explanations nothing says which holds: {cause.message} ({cause.probability:.0%}), or {other}"
    return f"{text} (try: a map with surveyed positions, or what is known of either, in sensor.toml)"


def _reasons(limits: Sequence[Limit], alarming: dict[str, Symptom]) -> str:
    """Return what the first one means, all values, and what would help."""
    values = "; ".join(alarming[limit.code].message for limit in limits)
    hint = next((limit.hint for limit in limits if limit.hint), "")
    return f"{limits[0].why}: {values}" + (f" (try: {hint})" if hint else "")
