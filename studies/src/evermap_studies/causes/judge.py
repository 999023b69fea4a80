"""What a run said of a world, against what is true of it."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any
from zlib import crc32

import numpy as np

from evermap.errors import EvermapError
from evermap.types import AnyRecording, ChangeKind, Landmarks, MapChange, SlamResult, VerdictKind
from evermap_studies.causes.answers import ANSWERS, Answer
from evermap_studies.causes.catalogue import World
from evermap_studies.causes.drives import NEXT, Drive, Event, as_recording, last_places, old_map, simulate

Row = dict[str, Any]
RATIO = 1.5
"""Error of poses at most, over that of an oracle that knows the cause."""
SLACK_M = 0.005
"""Added to that: nobody minds."""
TOLD, CERTAIN = 0.5, 0.99
"""Probabilities from which a change is told, and from which it is certain."""
INSTANT_S = 2.0
"""How far off the instant of a change may be."""
FAR = 0.04
"""Difference of a map from the truth [m] from which a landmark may be told as moved."""
MUST = 0.15
"""Difference [m] from which it has to be."""
VAGUE = frozenset({"landmarks-move", "no-odometry", "too-little"})
"""Findings that refuse a recording without a cause."""
NOWHERE_M = 1e9
"""Error of poses that are no numbers."""
NEES = 4.0
"""Mean squared error of poses over its expectation, from which a run isn't what it says."""


@dataclass(frozen=True, slots=True)
class Case:
    """A world of one seed.

    Attributes:
        given, right: the drive as evermap is given it, and the one that the oracle solves.
        events: landmarks that moved.
    """

    world: World
    seed: int
    given: Drive
    right: Drive
    events: tuple[Event, ...]

    @property
    def oracle_key(self) -> str:
        """What the oracle's run depends on."""
        own = self.world.name if self.events else ""
        return f"{crc32(repr(self.world.make).encode()):08x} {self.world.in_map} {self.seed} {own}"


def make_case(world: World, seed: int) -> Case:
    """Return a world of a seed; same seed, same case."""
    rng = np.random.default_rng([seed, crc32(world.name.encode())])
    right = simulate(world.make, seed, in_map=world.in_map)
    events: tuple[Event, ...] = ()
    if world.events is not None:
        events = world.events(right, rng)
        right = simulate(world.make, seed, events, in_map=world.in_map)
    given = right
    if events:
        given = replace(given, true_places=last_places(right, events))
        given = replace(given, places=old_map(right, seed)) if world.in_map else given
    return Case(world, seed, world.mistake(given, rng), right, events)


@dataclass(frozen=True, slots=True)
class Solved:
    """A run: its result or the line that refused it, and what `check` found."""

    result: SlamResult | None
    recording: AnyRecording
    findings: tuple[tuple[str, bool], ...]
    refusal: str
    crashed: bool
    cpu_s: float


def solve(drive: Drive) -> Solved:
    """Run evermap on a drive as its command does, with default settings."""
    from evermap.config import Config
    from evermap.pipeline import run_slam
    from evermap.slam.check import check_recording
    from evermap.slam.plane import in_its_space

    recording, result, refusal, crashed = as_recording(drive), None, "", False
    config = Config() if drive.named else Config.model_validate({"slam": {"unknown_ids": True}})
    dim = None if drive.places is None else int(drive.places.position_m.shape[1])
    scored: AnyRecording = recording
    findings: tuple[tuple[str, bool], ...] = ()
    started = time.process_time()
    try:
        scored = in_its_space(recording, config.slam, dim=dim)
        result = run_slam(recording, config, prior_map=drive.places)
    except EvermapError as error:
        refusal = error.one_line()
    except Exception as error:  # a traceback is a defect: it is counted, and the study goes on
        refusal, crashed = f"{type(error).__name__}: {error}"[:200], True
    cpu_s = time.process_time() - started
    if result is None or result.verdict is None:
        try:
            findings = tuple((one.code, one.usable) for one in check_recording(recording, config).findings)
        except Exception as error:
            findings = ((type(error).__name__, False),)
    return Solved(result, scored, findings, refusal, crashed, cpu_s)


def errors(solved: Solved, drive: Drive) -> Row:
    """Return errors of poses [m], of odometry alone, and squared errors over their expectation; None of no result."""
    from evermap.metrics.summary import compare_with_truth, metrics_dict
    from evermap.metrics.trajectory import evaluate_trajectory

    nothing: Row = {"error_m": None, "aligned_m": None, "odometry_m": None, "nees": None}
    if solved.result is None:
        return nothing
    if not np.isfinite(solved.result.trajectory.pose_world_robot).all():
        return {**nothing, "error_m": NOWHERE_M, "aligned_m": NOWHERE_M, "odometry_m": 0.0}
    try:
        metrics = metrics_dict(compare_with_truth(solved.recording, solved.result))
        aligned, placed = metrics["pose_rmse_m"], None
        if drive.places is not None and not drive.moved_frame and solved.recording.truth is not None:
            found = evaluate_trajectory(
                solved.result.trajectory, solved.recording.truth, align=False, max_gap_s=1.0,
                looked_s=solved.recording.frames.stamp_s,
            )  # fmt: skip
            placed = None if found is None else found.rmse_m
    except (EvermapError, np.linalg.LinAlgError):
        return nothing
    nees = metrics["pose_nees_anchored_mean"] if drive.places is None else metrics["pose_nees_mean"]
    dof = metrics["nees_dof"] or 2
    return {
        "error_m": _rounded(aligned if placed is None else placed),
        "aligned_m": _rounded(aligned),
        "odometry_m": _rounded(metrics["dead_reckoning_rmse_m"]),
        "nees": _rounded(None if nees is None else nees / dof),
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(f"{value:.4g}")


def judge(case: Case, oracle: Row | None) -> Row:
    """Run a case and return everything that is scored; `oracle` are the errors of the oracle's run, if it had one."""
    world, answer = case.world, find_answer(case.world)
    solved = solve(case.given)
    result = solved.result
    verdict = None if result is None or result.verdict is None else result.verdict.kind
    exit_code = 1 if solved.crashed else 2 if solved.refusal else 0 if verdict is None or verdict.is_trustworthy else 3
    told = () if result is None else tuple(one for one in result.changes if one.probability >= TOLD)
    truth = true_changes(case)
    false, missed, timed = compare_changes(
        told, truth, case, () if result is None else result.gone.landmark_id.tolist()
    )
    row: Row = {
        "world": world.name, "seed": case.seed, "group": world.group, "cause": world.cause,
        "space": not case.given.is_planar, "in_map": world.in_map, "quick": world.quick,
        "exit": exit_code, "verdict": None if verdict is None else str(verdict), "refusal": solved.refusal,
        "causes": [] if result is None else [
            {"code": one.code, "subject": one.subject, "value": _rounded(one.value)} for one in result.causes
        ],
        "findings": [code for code, _ in solved.findings],
        "changes": [_as_text(one) for one in told],
        "true_changes": [f"{one.kind} {identity}" for identity, one in truth.items()],
        "false_changes": len(false), "certain_false_changes": sum(one.probability > CERTAIN for one in false),
        "missed_changes": missed, "timed": timed,
        **errors(solved, case.given),
        "oracle_key": case.oracle_key, "oracle_m": None if oracle is None else oracle["error_m"],
        "cpu_s": round(solved.cpu_s, 2),
    }  # fmt: skip
    row["named_by"] = named_by(world, ANSWERS[world.cause], solved, missed, truth)
    if world.also and not named_by(world, ANSWERS[world.also], solved, missed, truth):
        row["named_by"] = ""
    row["value_off"] = value_off(world, result)
    row["false_causes"] = _false_causes(answer, solved)
    row["bound_m"] = bound(world, row["oracle_m"])
    return {**row, **conclude(world, answer, row)}


def find_answer(world: World) -> Answer:
    """Return what is right of a world: of one with two causes, both are true, and either verdict."""
    answer = ANSWERS[world.cause]
    if not world.also:
        return answer
    other = ANSWERS[world.also]
    return replace(answer, verdicts=answer.verdicts | other.verdicts, codes=answer.codes | other.codes)


def bound(world: World, oracle_m: float | None) -> float | None:
    """Return the error of poses that is allowed."""
    if world.bound_m is not None:
        return world.bound_m
    return None if oracle_m is None else float(RATIO * oracle_m + SLACK_M)


def conclude(world: World, answer: Answer, row: Row) -> Row:
    """Return what is right of a row, and whether it is wrong in silence: called sound, and isn't."""
    verdict, error, limit = row["verdict"], row["error_m"], row["bound_m"]
    enters = row["exit"] == 0 and verdict in (None, "sound")
    near = error is not None and (limit is None or error <= limit)
    worse = row["aligned_m"] is not None and row["odometry_m"] is not None and row["aligned_m"] > row["odometry_m"]
    honest = row["nees"] is None or row["nees"] <= NEES
    verdict_right = verdict is None or verdict in {str(one) for one in answer.verdicts}
    named = bool(row["named_by"]) or answer.is_optional
    told_right = row["false_changes"] == 0 and row["false_causes"] == 0
    if world.group == "mistakes":
        right = named and not enters and row["exit"] != 1 and verdict_right
    elif world.cause == "anything":
        right = row["exit"] != 1 and (not enters or (honest and not worse and error is not None))
    elif row["exit"] == 0:
        right = named and told_right and near and verdict_right and row["missed_changes"] == 0
        right = right and (world.group != "sound" or (honest and not worse))
    else:
        refused = row["exit"] == 3 or (row["exit"] == 2 and not answer.verdicts <= {"sound", "weak"})
        right = named and told_right and verdict_right and refused
    unsaid = not row["named_by"] and not answer.is_optional and VerdictKind.SOUND not in answer.verdicts
    silent = enters and (worse or not honest or row["certain_false_changes"] > 0 or unsaid)
    return {"enters": enters, "right": bool(right), "silent": bool(silent)}


def named_by(world: World, answer: Answer, solved: Solved, missed: int, truth: Mapping[int, Any]) -> str:
    """Return where the cause is named: '' nowhere; 'cause', 'finding', 'change', 'state', 'undecided' or 'refusal'."""
    result = solved.result
    if answer.is_change:
        return "change" if result is not None and not missed and truth else ""
    if result is not None:
        if any(one.code in answer.codes for one in result.causes):
            return "cause"
        if any(end in (pair.one.name, pair.other.name) for pair in result.undecided for end in answer.states):
            return "undecided"
        verdict = result.verdict
        symptoms = verdict.symptoms if verdict is not None and verdict.kind is VerdictKind.WEAK else ()
        if any(one.is_alarming and one.code in answer.codes for one in symptoms):
            return "undecided"
        for state in result.parameters:
            if not any(state.name.endswith(end) for end in answer.states) or state.fixed or not state.sigma > 0.0:
                continue
            neutral = 1.0 if "scale" in state.name else 0.0
            right = [
                value
                for value in world.values
                if abs(state.value - value) <= max(3 * state.sigma, world.within * abs(value))
            ]
            if right and abs(state.value - neutral) > 3.0 * state.sigma and abs(state.value - neutral) > 1e-3:
                return "state"
    if any(code in answer.codes for code, _ in solved.findings):
        return "finding"
    if solved.refusal and not solved.crashed and any(word in solved.refusal.lower() for word in answer.words):
        return "refusal"
    return ""


def value_off(world: World, result: SlamResult | None) -> float | None:
    """Return by which share the value of a named cause is off the nearest that is right; None of none."""
    if result is None or not world.values:
        return None
    codes = ANSWERS[world.cause].codes
    found = [one.value for one in result.causes if one.code in codes and math.isfinite(one.value)]
    off = [abs(one - value) / abs(value) for one in found for value in world.values]
    return _rounded(min(off)) if off else None


def _false_causes(answer: Answer, solved: Solved) -> int:
    """Number of causes that are told as likely, or for which `check` refuses the recording, and are false."""
    if solved.result is None:
        return 0
    likely = [one.code for one in solved.result.causes if not one.probability < TOLD]
    refused = [code for code, is_usable in solved.findings if not is_usable and code not in VAGUE]
    return sum(code not in answer.codes for code in (*likely, *refused))


@dataclass(frozen=True, slots=True)
class TrueChange:
    """What happened to a landmark: displacement [m], instant (-inf: before), whether it has to be told."""

    kind: str
    displacement_m: np.ndarray[Any, Any]
    at_s: float
    must: bool = True


def true_changes(case: Case) -> dict[int, TrueChange]:
    """Return what changed, by identity: against the map that is given, or while the robot drove."""
    found: dict[int, TrueChange] = {}
    site, by_row = case.right.site, dict[int, Event]()
    assert site is not None
    for event in case.events:
        by_row.setdefault(event.row, event)
    starts = {tuple(np.round(site.pose[row, :3], 6)) for row in by_row}
    for row, event in by_row.items():
        identity, was = int(site.landmark_id[row]), site.pose[row]
        if event.pose is None:
            found[identity] = TrueChange("vanished", np.full(3, np.nan), event.at_s, case.world.in_map)
            continue
        last = [one for one in case.events if one.row == row][-1]
        assert last.pose is not None
        shift = last.pose[:3] - was[:3]
        exchanged = len(by_row) == 2 and tuple(np.round(event.pose[:3], 6)) in starts
        kind = "exchanged" if exchanged else "moved" if np.linalg.norm(shift) > 1e-6 else "turned"
        found[identity] = TrueChange(kind, shift, event.at_s, ANSWERS[case.world.cause].is_change)
    if not found and case.given.places is not None and "edition" in case.world.name:
        given, true = case.given.places, case.given.true_places
        _, mine, theirs = np.intersect1d(given.landmark_id, true.landmark_id, return_indices=True)
        shift = true.position_m[theirs] - given.position_m[mine]
        shift = shift - np.median(shift, axis=0)
        for row in np.flatnonzero(np.linalg.norm(shift, axis=1) > FAR).tolist():
            must = bool(np.linalg.norm(shift[row]) > MUST)
            found[int(given.landmark_id[mine[row]])] = TrueChange("moved", shift[row], -math.inf, must)
    return found


def compare_changes(
    told: Sequence[MapChange], truth: Mapping[int, TrueChange], case: Case, gone: Sequence[int] = ()
) -> tuple[list[MapChange], int, bool | None]:
    """Return the changes that are told and are none, how many are missing, and whether all instants are right.

    `gone` are landmarks that are in the map, and aren't there any more, whether a change says so or not.
    """
    false, timed = [], list[bool]()
    right = {identity for identity in gone if identity in truth and truth[identity].kind == "vanished"}
    known: Landmarks | None = case.given.places
    for change in told:
        ids = [identity % NEXT for identity in change.landmark_ids]
        if change.kind is ChangeKind.APPEARED:
            mapped = known is not None and np.isin(change.landmark_ids, known.landmark_id).any()
            if mapped:
                false.append(change)
            continue
        if not all(identity in truth and _agrees(change, truth[identity]) for identity in ids) or not _placed(
            change, ids, truth, case
        ):
            false.append(change)
            continue
        right.update(ids)
        timed += [_in_time(change, truth[identity].at_s, case) for identity in ids]
    missed = sum(one.must and identity not in right for identity, one in truth.items())
    return false, missed, all(timed) if timed else None


def _agrees(change: MapChange, truth: TrueChange) -> bool:
    if change.kind is ChangeKind.VANISHED:
        return truth.kind == "vanished"
    if change.kind is ChangeKind.SWAPPED:
        return truth.kind == "exchanged"
    return truth.kind != "vanished"


def _placed(change: MapChange, ids: Sequence[int], truth: Mapping[int, TrueChange], case: Case) -> bool:
    """Whether a group went where it is told to have gone; its length alone in a map of another frame."""
    if change.kind in (ChangeKind.VANISHED, ChangeKind.SWAPPED):
        return True
    mean = np.mean([truth[one].displacement_m for one in ids], axis=0)
    told = np.zeros(3)
    told[: len(change.displacement_m)] = change.displacement_m
    if case.given.moved_frame or case.given.places is None:
        off = abs(float(np.linalg.norm(told)) - float(np.linalg.norm(mean)))
    else:
        off = float(np.linalg.norm((told - mean)[: len(change.displacement_m)]))
    return off <= max(0.15, 0.25 * float(np.linalg.norm(mean)))


def _in_time(change: MapChange, at_s: float, case: Case) -> bool:
    """Whether the interval that is told holds the instant, to `INSTANT_S`."""
    early, late = change.stamp_from_s, change.stamp_to_s
    if at_s == -math.inf:
        return not math.isfinite(early) or late <= case.given.frame_s[0] + INSTANT_S
    return math.isfinite(early) and early - INSTANT_S <= at_s <= late + INSTANT_S


def _as_text(change: MapChange) -> str:
    ids = ", ".join(map(str, change.landmark_ids))
    length = float(np.linalg.norm(change.displacement_m))
    return f"{change.kind} {ids}: {length:.2f} m, {math.degrees(change.rotation_rad):.0f} deg, {change.probability:.3f}"
