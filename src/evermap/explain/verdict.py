"""The verdict that every run ends with: how far it can be trusted, by signs that need no truth.

Each sign has a range in which it is where all is well (`LIMITS`). Where the readings themselves contradict each other,
or a calibration is far from what sensors are like, the sensor or the odometry is suspected; where too much of a given
map is not as found, the map; where the solution contradicts the readings, it is lost. What remains may be right, but
too little known: then it is weak.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite

from evermap.config import SlamConfig
from evermap.explain.symptoms import Signs, measure_signs
from evermap.slam.check import far_off
from evermap.slam.mistakes import Finding
from evermap.types import AnyRecording, Cause, Landmarks, SlamResult, Symptom, Verdict, VerdictKind


@dataclass(frozen=True, slots=True)
class Limit:
    """Between what a sign is where all is well, and what it says beyond.

    Attributes:
        code: of the symptom.
        sign: name in `Signs`.
        text: the value in words; what is expected follows.
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


LOST, WEAK, OUTDATED = VerdictKind.LOST, VerdictKind.WEAK, VerdictKind.MAP_OUTDATED
LIMITS = (
    Limit(
        "innovations", "nis", "innovations {:.3g} (2 if consistent)", 0.5, 4.0, LOST,
        "the readings are farther from the solution than their noise",
    ),
    Limit(
        "used", "used", "{:.0%} of the detections used", 0.6, inf, LOST,
        "most of what is left out contradicts the solution",
    ),
    Limit(
        "used-worst", "used_worst", "{:.0%} used in the worst tenth of the drive", 0.2, inf, LOST,
        "a part of the drive contradicts the rest",
    ),
    Limit(
        "contradicted", "contradicted", "{:.0%} of the landmarks contradicted by most of their detections", -inf, 0.35,
        LOST, "landmarks are not where they are seen",
    ),
    Limit(
        "misfit", "misfit_all", "detections off by {:.1%} of their range (median)", -inf, 0.15, LOST,
        "detections are nowhere near their landmarks",
    ),
    Limit(
        "odometry", "motion", "trajectory and odometry differ by {:.0%} of the motion (median)", -inf, 0.5, LOST,
        "trajectory and odometry contradict each other",
    ),
    Limit(
        "length", "longer", "trajectory {:.3g} times as long as by odometry", 0.5, 2.0, LOST,
        "trajectory and odometry contradict each other",
    ),
    Limit(
        "map-changed", "moved", "{:.0%} of the map's landmarks in view are reported as changed", -inf, 0.5, OUTDATED,
        "too much of the map is not where it was", "map the place anew, or `evermap map` with the entries mended",
    ),
    Limit(
        "uncertain", "sigma_share", "positions known to {:.1%} of the size of the place", -inf, 0.1, WEAK,
        "the recording hardly ties the poses to each other", "drive past landmarks that were seen before",
    ),
    Limit(
        "landmarks", "n_landmarks", "{:.0f} landmarks", 2.0, inf, WEAK,
        "one landmark fixes no pose", "more landmarks",
    ),
    Limit(
        "blind", "blind_share", "nothing seen for {:.0%} of the drive", -inf, 0.5, WEAK,
        "there the poses are those of the odometry", "more landmarks where nothing is seen",
    ),
)  # fmt: skip
"""Set by `python -m benchmarks.verdicts` on one half of its worlds; the other half is held out."""
SURE = 0.9
"""Probability from which a cause is told as such."""


def with_verdict(
    result: SlamResult,
    recording: AnyRecording,
    settings: SlamConfig,
    prior_map: Landmarks | None = None,
    *,
    findings: Sequence[Finding] = (),
    set_aside: str = "",
) -> SlamResult:
    """Return the result with its verdict; arguments as of `judge`."""
    verdict = judge(result, recording, settings, prior_map, findings=findings, set_aside=set_aside)
    return replace(result, verdict=verdict)


def judge(
    result: SlamResult,
    recording: AnyRecording,
    settings: SlamConfig,
    prior_map: Landmarks | None = None,
    *,
    findings: Sequence[Finding] = (),
    set_aside: str = "",
) -> Verdict:
    """Return how far a run can be trusted.

    Args:
        result: of the run, with its causes.
        recording: as it was estimated; rows of the result's innovations are rows of its detections.
        settings: that it was estimated with.
        prior_map: that was given, or what a living map expected.
        findings: what `slam.check` found odd about the readings alone.
        set_aside: why a session could not be localised in its map; '' where it was, or there is none.
    """
    signs = measure_signs(result, recording, prior_map)
    symptoms = sorted(_symptoms(signs), key=lambda symptom: not symptom.is_alarming)
    causes = tuple(sorted(result.causes, key=lambda cause: -cause.probability))
    kind, message = _decide(result, signs, settings, findings, set_aside, symptoms, causes)
    return Verdict(kind, message, tuple(symptoms), causes)


def _symptoms(signs: Signs) -> Iterable[Symptom]:
    """Yield the signs that this run has, each with its range."""
    for limit in LIMITS:
        value = float(getattr(signs, limit.sign))
        if isfinite(value):
            expected = _range_text(limit)
            yield Symptom(limit.code, f"{limit.text.format(value)}, {expected}", value, limit.least, limit.most)


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
    result: SlamResult,
    signs: Signs,
    settings: SlamConfig,
    findings: Sequence[Finding],
    set_aside: str,
    symptoms: Sequence[Symptom],
    causes: Sequence[Cause],
) -> tuple[VerdictKind, str]:
    """Return the kind, and its reason in one line: what names its remedy comes first."""
    sure = [cause for cause in causes if not cause.probability < SURE]
    if of_map := [cause for cause in sure if _is_of_map(cause)]:
        return OUTDATED, _cause_text(of_map[0])
    if sure:
        return VerdictKind.SENSOR_SUSPECT, "; ".join(map(_cause_text, sure))
    if wrong := [finding.message for finding in findings if not finding.usable]:
        return VerdictKind.SENSOR_SUSPECT, "; ".join(wrong)
    if off := far_off(result.parameters, settings.check):
        return VerdictKind.SENSOR_SUSPECT, "; ".join(off)
    alarming = {symptom.code: symptom for symptom in symptoms if symptom.is_alarming}
    beyond = [limit for limit in LIMITS if limit.code in alarming]
    if lost := [limit for limit in beyond if limit.kind is LOST]:
        return LOST, _reasons(lost, alarming)
    if signs.common == 0:
        return OUTDATED, "no landmark of the map was seen: it is of another site, or its ids are others"
    if set_aside:
        return OUTDATED, f"not localised in the map: {set_aside}"
    if signs.in_map is False:
        return OUTDATED, "what was seen lies nowhere on the map: it is of another site, frame or scale, or mirrored"
    if outdated := [limit for limit in beyond if limit.kind is OUTDATED]:
        return OUTDATED, _reasons(outdated, alarming)
    if weak := [limit for limit in beyond if limit.kind is WEAK]:
        return WEAK, _reasons(weak, alarming)
    return VerdictKind.SOUND, "readings, odometry and solution agree"


def _is_of_map(cause: Cause) -> bool:
    return cause.subject.startswith("map") or cause.code.startswith("map")


def _cause_text(cause: Cause) -> str:
    return f"{cause.message} (try: {cause.fix})" if cause.fix else cause.message


def _reasons(limits: Sequence[Limit], alarming: dict[str, Symptom]) -> str:
    """Return what the first one means, all values, and what would help."""
    values = "; ".join(alarming[limit.code].message for limit in limits)
    hint = next((limit.hint for limit in limits if limit.hint), "")
    return f"{limits[0].why}: {values}" + (f" (try: {hint})" if hint else "")
