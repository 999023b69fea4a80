"""The main jobs, each as its steps: screen the recording, identify landmarks without an id, solve, ask what exists."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.compiled import single_threaded
from evermap.config import Config
from evermap.errors import ConfigError, DataError, InputError
from evermap.types import (
    AnyRecording,
    AssociationEvidence,
    Cause,
    IntArray,
    Landmarks,
    Progress,
    Recording,
    SlamResult,
    is_in_space,
)

if TYPE_CHECKING:
    from evermap.explain.trial import SessionSolution
    from evermap.maps.living import LivingMap
    from evermap.maps.sessions.placing import Localised
    from evermap.maps.sessions.planar import PlanarVisit
    from evermap.maps.sessions.session import Session, Visit
    from evermap.maps.sessions.spatial import SpatialVisit
    from evermap.slam.estimate import Solved
    from evermap.slam.mistakes import Finding


@single_threaded()
def run_slam(
    recording: AnyRecording,
    config: Config | None = None,
    *,
    prior_map: Landmarks | None = None,
    realtime: bool = False,
    progress: Progress | None = None,
) -> SlamResult:
    """Estimate trajectory, landmarks, calibration and noise of one recording, in the plane or in space.

    Args:
        recording: what a reader returned; its truth is not looked at.
        config: settings; None for the defaults.
        prior_map: landmarks to localise in, with covariances; None maps from scratch in the frame of the first pose.
        realtime: process at the recording's pace; in space all frames are solved together.
        progress: told after every frame. An interrupt (Ctrl-C) ends the run early, with what was done so far.

    Raises:
        InputError: no `Recording`, or one with invalid values, such as stamps that run backwards.
        DataError: nothing can be estimated, for example because no landmark was ever seen.
        ConfigError: settings that contradict each other or the recording.
        NumericalError: no finite optimum.
    """
    from evermap.explain.faults import with_mended
    from evermap.explain.verdict import with_verdict
    from evermap.slam.space.moving import has_traffic, run_in_traffic

    case = _name_landmarks(_screen(recording, prior_map, config or Config()))
    if has_traffic(case.recording):
        settings, track = case.config.slam, case.config.track
        result = run_in_traffic(case.recording, settings.space, track, case.prior_map, progress)
        return with_verdict(result, case.recording, settings, findings=case.found)
    case = _leave_out_motion(case)
    result, solution = _conclude(case, realtime=realtime, progress=progress)
    if realtime or not case.config.slam.explain.on:
        return result
    case, result, solution, carried = _leave_out_carried(case, result, solution)
    if not result.causes and _is_held(result):  # its scores cost too much to be asked before all else is sound
        result, _ = _conclude(case, is_suspected=True, solution=solution)
    return with_mended(result, carried)


@dataclass(frozen=True, slots=True)
class _Case:
    """What `run_slam` estimates.

    Attributes:
        config: settings.
        read: the recording with the identities that it was read with.
        recording: as it is estimated.
        prior_map: that was given; None without.
        remarks: on the recording, the first warnings.
        found: what was read wrongly.
        doubled: identities that two landmarks have at once.
        evidence: for identities that were found, not read.
        is_read_well: whether pairs of sightings are known to show no mistake.
        left_out: identities of landmarks that are carried about.
    """

    config: Config
    read: AnyRecording
    recording: AnyRecording
    prior_map: Landmarks | None
    remarks: tuple[str, ...]
    found: tuple[Finding, ...]
    doubled: IntArray
    evidence: AssociationEvidence | None = None
    is_read_well: bool = False
    left_out: tuple[int, ...] = ()


def _screen(recording: AnyRecording, prior_map: Landmarks | None, config: Config) -> _Case:
    """Return a recording in its space, without what is certainly wrong with it."""
    from evermap.slam import check, plane
    from evermap.slam.ownership import with_owned
    from evermap.slam.votes import list_doubled_ids

    recording, riders = check.leave_out_riders_in_space(recording, config.slam)
    recording, owned = with_owned(recording, config)
    read, prior_map, told = plane.with_prior(recording, prior_map, config.slam)
    recording, remarks, found = check.screened(read, config, prior_map)
    remarks, found = (*(one.message for one in riders), *owned, *told, *remarks), (*riders, *found)
    return _Case(config, read, recording, prior_map, remarks, found, list_doubled_ids(read, recording))


def _name_landmarks(case: _Case) -> _Case:
    """Return the same with identities of landmarks that were read without, where these are asked for."""
    from evermap.maps.sessions import nameless
    from evermap.slam import association

    config, remarks = case.config, case.remarks
    if config.slam.unknown_ids and case.prior_map is not None:
        recording, evidence = nameless.identify_in(case.recording, case.prior_map, config)
    else:
        recording, evidence = association.identify_landmarks(case.recording, config.slam)
    if evidence is not None:
        remarks = (*remarks, *association.describe_doubts(evidence, config.slam.association))
    is_read_well = recording.detections is case.read.detections and all(finding.usable for finding in case.found)
    return replace(case, recording=recording, evidence=evidence, remarks=remarks, is_read_well=is_read_well)


def _leave_out_motion(case: _Case) -> _Case:
    """Return the same, in the plane, without what moves while the robot drives, and without what rides along."""
    from evermap.slam.mistakes import NO_ODOMETRY
    from evermap.slam.moving_bodies import without_motion

    config, recording, remarks = case.config, case.recording, case.remarks
    if not is_in_space(recording):
        recording, moved = without_motion(recording, config)
        remarks = (*remarks, *moved)
        if any(finding.code == NO_ODOMETRY for finding in case.found):  # all landmarks move: to ask which says nothing
            config = _without_changes(config)
    is_shorter = len(case.read.detections) != len(recording.detections)  # what rides along in the plane was left out
    read = recording if is_shorter else case.read
    return replace(case, config=config, read=read, recording=recording, remarks=remarks)


def _conclude(case: _Case, **more: Any) -> tuple[SlamResult, SessionSolution[Visit]]:
    """Return a case solved, what exists, faults and verdict; and its solution; `more` as of `explain_session`."""
    from evermap.explain.causes.suspect import Inputs
    from evermap.maps.sessions import session, solve
    from evermap.slam.space.up import with_known_up

    config, prior_map = case.config, case.prior_map
    given = Inputs.of(case.recording, prior_map)
    solution = solve.explain_session(given, config, case.remarks, is_read_well=case.is_read_well, **more).best.solution
    visit, asked = solution.visit, solution.asked
    result = replace(session.add_existence(visit, solution.result, config.living), association=case.evidence)
    if prior_map is not None:
        not_missed = [*case.doubled.tolist(), *case.left_out]  # what was read was not missed
        expected = prior_map[~np.isin(prior_map.landmark_id, not_missed)]
        result = with_known_up(session.looked_for(visit, result, expected, config.living), prior_map.up)
    result = _judge(
        result, asked.inputs.recording, config, asked.inputs.prior_map, case.found, case.doubled,
        as_read=case.read, asked=asked,
    )  # fmt: skip
    return result, solution


def _leave_out_carried(
    case: _Case, result: SlamResult, solution: SessionSolution[Visit]
) -> tuple[_Case, SlamResult, SessionSolution[Visit], tuple[Cause, ...]]:
    """Return case, result and solution without landmarks that are carried about, where there are any, and which."""
    from evermap.explain.carried import Carried, find_carried, name_carried
    from evermap.slam.votes import with_read_identities, without_identities

    def find(result: SlamResult, solution: SessionSolution[Visit]) -> tuple[Carried, ...]:
        return find_carried(result, with_read_identities(solution.asked.inputs.recording, case.read), case.prior_map)

    as_given = case, result, solution, ()
    if case.config.slam.unknown_ids is True or not (suspects := find(result, solution)):
        return as_given
    names = tuple(one.landmark_id for one in suspects)
    rest, read = without_identities(case.recording, names), without_identities(case.read, names)
    without = replace(case, recording=rest, read=read, left_out=names)
    result, solution = _conclude(without)
    confirmed = find(result, solution)  # along poses that they do not bend
    if tuple(one.landmark_id for one in confirmed) != names:
        return as_given
    return without, result, solution, tuple(name_carried(one, case.read) for one in confirmed)


def _without_changes(config: Config) -> Config:
    """Return settings by which no landmark moves, and no cause is asked."""
    explain = config.slam.explain.model_copy(update={"on": False})
    return config.model_copy(update={"slam": config.slam.model_copy(update={"method": "nohyp", "explain": explain})})


def _is_held(result: SlamResult) -> bool:
    """Return whether a calibration that was held as stated seems to be another."""
    verdict = result.verdict
    return verdict is not None and any(one.is_alarming and one.code == "held" for one in verdict.symptoms)


def _judge(
    result: SlamResult,
    recording: AnyRecording,
    config: Config,
    expected: Landmarks | None,
    found: tuple[Finding, ...],
    doubled: IntArray | tuple[int, ...] = (),
    **more: Any,
) -> SlamResult:
    """Return a result with the faults that it shows, and its verdict; `more` is as of `with_verdict`."""
    from evermap.explain.faults import find_faults, with_mended
    from evermap.explain.verdict import with_verdict

    faults, mended = find_faults(result, recording, found, expected, doubled)
    result = replace(result, causes=(*result.causes, *faults))
    result = with_verdict(result, recording, config.slam, expected, findings=found, **more)
    return with_mended(result, mended)


@single_threaded()
def run_together(
    recordings: Mapping[int, AnyRecording], config: Config | None = None, *, progress: Progress | None = None
) -> dict[int, SlamResult]:
    """Estimate several robots that drove at the same time as one problem: landmarks are one where their ids are.

    Robots in the plane that saw each other (`Recording.robot_sightings`) tie each other's poses. Each is solved alone
    first. The results are in the frame of the first robot's first pose.

    `recordings` are by the numbers by which robots call each other, all in the plane or all in space, their stamps on
    one clock. The other arguments are those of `run_slam`.

    Raises:
        InputError: no recordings, some with invalid values, or some in the plane and some in space.
        DataError: nothing can be estimated from one, or nothing ties one to the others.
        ConfigError: landmarks without identities are those of one robot (`slam.unknown_ids`).
        NumericalError: no finite optimum.
    """
    from evermap.estimate.tie import without_frames
    from evermap.explain.verdict import with_verdict
    from evermap.maps.sessions import planar, session, spatial
    from evermap.slam import check, estimate, planar_together

    config = config or Config()
    if len({is_in_space(recording) for recording in recordings.values()}) > 1:
        problem = "some of the recordings are in the plane, some in space"
        raise InputError(problem, field="recordings", hint="robots that drove together in one or the other")
    if config.slam.unknown_ids:
        problem, hint = "landmarks that several robots see are known by their ids", "run the robots one by one"
        raise ConfigError(problem, field="slam.unknown_ids", hint=hint)
    alone, visits, results, findings = {}, list[spatial.SpatialVisit](), {}, {}
    for number, given in recordings.items():
        apart = replace(given, measurements=without_frames(given.measurements))
        recording, remarks, findings[number] = check.screened(apart, config)
        if is_in_space(recording):
            visits.append(spatial.solve_visit(recording, config, None, remarks, progress=progress))
            continue
        alone[number] = estimate.solve(recording, config.slam, remarks=remarks, progress=progress)
        if alone[number].interrupted:
            raise KeyboardInterrupt
    if visits:
        frames = ["first_pose", *["first_robot"] * (len(visits) - 1)]
        joint = spatial.solve_visits_together(visits, config.slam.localize)
        for number, one, frame in zip(recordings, joint, frames, strict=True):
            result = session.add_existence(one, one.concluded(frame), config.living)
            results[number] = with_verdict(result, one.recording, config.slam, findings=findings[number])
        return results
    for number, solved, online in zip(alone, *planar_together.solve_together(alone), strict=True):
        visit = planar.PlanarVisit(solved)
        result = session.add_existence(visit, replace(visit.concluded(online.frame), online=online), config.living)
        results[number] = with_verdict(result, solved.recording, config.slam, findings=findings[number])
    return results


@single_threaded()
def run_session(
    recording: AnyRecording,
    living: LivingMap | None = None,
    config: Config | None = None,
    *,
    progress: Progress | None = None,
) -> Session:
    """Enter one session into a living map: localise from an unknown pose, find what changed, extend it (MATH.md 5).

    A session that is earlier than the map is for `enter_session`. Without a map (`living`) it begins one, in the frame
    of its first pose. The other arguments are those of `run_slam`.

    Raises:
        InputError: no `Recording`.
        DataError: nothing can be estimated, or the session is earlier than the map.
        NumericalError: no finite optimum.
    """
    from evermap.maps.sessions import admission, boxes, nameless, planar, session, solve
    from evermap.slam import check
    from evermap.slam.ownership import with_owned
    from evermap.slam.space.moving import has_traffic

    config = config or Config()
    recording, riders = check.leave_out_riders_in_space(recording, config.slam)
    stated = recording.objects
    recording, owned = with_owned(recording, config)
    recording = admission.with_overlap(admission.in_its_space(recording, living, config), living)
    living, whole = admission.open_map(living, recording), replace(recording, objects=stated)
    located: Localised[PlanarVisit] | Localised[SpatialVisit]
    if is_in_space(recording):
        recording, remarks, found = check.screened(nameless.without_ids(recording, config), config)
        remarks = (*owned, *remarks)
        admission.check_static(recording, config)
        recording, living = admission.admit(recording, living)
        if config.slam.unknown_ids:
            recording, living = admission.admit(nameless.name_in(recording, living, config), living)
        located = boxes.localised(recording, living, config, remarks, progress)
    else:
        alone = solve_alone(recording, living, config, progress=progress)
        living, found = admission.with_names_of(living, alone.recording), alone.findings
        located = planar.localised(alone, living, config)
    found = (*riders, *found)
    entered = solve.with_causes(session.bring_in(located, living, config.living), living, config)
    if has_traffic(whole):
        return _add_verdict(session.with_start_of(entered, whole), None, living, config, found)
    judged = _judge_in_map(entered, located.visit, living, config, found)
    return session.with_start_of(judged, whole)


@single_threaded()
def solve_alone(recording: Recording, living: LivingMap, config: Config, *, progress: Progress | None = None) -> Solved:
    """Estimate poses and landmarks of a session as one Gaussian: the first half of `run_session` in the plane.

    It is the same for all maps that agree on classes and deleted landmarks, whatever else they believe.
    """
    from evermap.maps.sessions import admission, nameless, planar
    from evermap.slam import check, estimate
    from evermap.slam.moving_bodies import without_motion

    recording, remarks, found = check.screened(nameless.without_ids(recording, config), config, repair=True)
    recording = admission.admit_recording(recording, living)
    if config.slam.unknown_ids:
        recording = admission.admit_recording(nameless.name_in(recording, living, config), living)
    recording, moved = without_motion(recording, config)
    remarks = (*remarks, *moved)
    solved = estimate.solve(*planar.prepare_alone(recording, config), remarks=remarks, progress=progress)
    return replace(solved, findings=found)


@single_threaded()
def bring_in(alone: Solved, living: LivingMap, config: Config) -> Session:
    """Enter a session that was solved alone into a map: the second half of `run_session` in the plane."""
    from evermap.maps.sessions import admission, planar, session

    living = admission.with_names_of(living, alone.recording)
    located = planar.localised(alone, living, config)
    entered = session.bring_in(located, living, config.living)
    return _judge_in_map(entered, located.visit, living, config, alone.findings)


def _judge_in_map(
    entered: Session, visit: Visit, before: LivingMap, config: Config, found: tuple[Finding, ...]
) -> Session:
    """Return a session with its verdict; one that can't be trusted as it is without what causes other than changes did,
    where there are any: as `run_slam` solves a recording.
    """
    from evermap.maps.sessions import session, solve

    judged = _add_verdict(solve.with_put_right(entered, config), visit, before, config, found)
    if not (config.slam.explain.on and entered.found and solve.is_doubtful(judged)):
        return judged
    explained = solve.find_causes(entered, before, config, is_suspected=_is_held(judged.slam))
    if explained is None or not explained.causes:
        return judged
    taken = explained.best.taken
    if taken and not any(one.suspect.of_map for one in taken):
        located = _localise(explained.best.inputs.recording, before, config)
        again = session.bring_in(located, before, config.living)
        if again.found:
            again = solve.with_calibration(again, explained)
            return _add_verdict(again, located.visit, before, config, found)
    named = replace(entered, slam=replace(entered.slam, causes=explained.causes))
    named = _add_verdict(named, visit, before, config, found)
    return judged if named.slam.is_trustworthy else named  # a solution that was not put right is no better for a cause


def _localise(
    recording: AnyRecording, living: LivingMap, config: Config
) -> Localised[PlanarVisit] | Localised[SpatialVisit]:
    """Return a recording that was admitted to a map, solved where it lies in it."""
    from evermap.maps.sessions import boxes, planar
    from evermap.slam import estimate

    if is_in_space(recording):
        return boxes.localised(recording, living, config)
    return planar.localised(estimate.solve(*planar.prepare_alone(recording, config)), living, config)


def _add_verdict(
    entered: Session, visit: Visit | None, before: LivingMap, config: Config, found: tuple[Finding, ...]
) -> Session:
    """Return a session with its verdict, beside the map as it was `before` it; its solution, the `visit`, is asked what
    it held as stated, but not in traffic (None). One that does not enter the map reports no changes.
    """
    from evermap.explain.causes.suspect import Inputs
    from evermap.explain.scores import ScreenedSession
    from evermap.maps.sessions import session, solve

    expected = before.landmarks(p_least=0.0) if len(before.places) else None
    reason = entered.set_aside[0] if entered.set_aside else ""
    asked = None
    if visit is not None and entered.found and config.slam.explain.on:
        asked = ScreenedSession(solve.solution_of(visit), Inputs.of(visit.recording, None))
    slam = _judge(entered.slam, entered.recording, config, expected, found, set_aside=reason, asked=asked)
    return session.without_doubted(replace(entered, slam=slam), before, config.living)


def refuse_localization(living: LivingMap, config: Config) -> None:
    """Raise where nobody can localise in a map, whatever the recording.

    Raises:
        ConfigError: `slam.unknown_ids`: that is not causal.
        DataError: the map is empty.
    """
    if config.slam.unknown_ids:
        problem = "landmarks without identity are associated by what is seen later, which is not causal"
        raise ConfigError(problem, field="slam.unknown_ids", hint="leave it out, or enter the session")
    if not len(living.places):
        raise DataError("the map is empty", field="living", hint="enter a session first")


@single_threaded()
def run_localization(
    recording: AnyRecording,
    living: LivingMap,
    config: Config | None = None,
    *,
    realtime: bool = False,
    progress: Progress | None = None,
) -> SlamResult:
    """Localise in a living map that stays as it is: causal, from an unknown pose, at a fixed cost per frame.

    Arguments are those of `run_slam`, with the map.

    Raises:
        ConfigError: `slam.unknown_ids`: that is not causal.
        DataError: the map is empty, ranges come without bearings, or the robot's place in it could not be found.
    """
    from evermap.explain.verdict import with_verdict
    from evermap.maps import vicinity
    from evermap.maps.sessions import admission, believe, spatial
    from evermap.slam import check, intake
    from evermap.slam.localize_recording import localize, localize_in_space
    from evermap.slam.space.moving import has_traffic

    config = config or Config()
    refuse_localization(living, config)
    recording, riders = check.leave_out_riders_in_space(recording, config.slam)
    recording = check.valid(admission.in_its_space(recording, living, config), config.sensor)  # type: ignore[type-var]
    recording, others = check.leave_out_riders(recording, config.slam)
    riders = (*riders, *others)
    if is_in_space(recording):
        recording, living = admission.admit(recording, living)
        named, start_s = recording.detections.landmark_id, float(recording.frames.stamp_s[0])
        if has_traffic(recording):  # boxes at rest are told from those that move by what comes later
            p_site = believe.aged(living, config.living, start_s).p_here
            return run_slam(recording, config, prior_map=spatial.standing(living, p_site), progress=progress)
        places = living.list_sighted(vicinity.predict_sites(living, named, config.living, start_s))
        joint = living.covariance_m2
        result = localize_in_space(recording, places, config, joint_m2=joint, realtime=realtime, progress=progress)
        found = (*riders, *check.odd(recording, config.slam))
        result = with_verdict(result, recording, config.slam, living.landmarks(p_least=0.0), findings=found)
        return replace(result, warnings=(*(finding.message for finding in found), *result.warnings))
    found = (*riders, *check.odd(recording, config.slam))
    recording, living = admission.admit(recording, living)
    named, start_s = recording.detections.landmark_id, float(recording.frames.stamp_s[0])
    places = living.list_sighted(vicinity.predict_sites(living, named, config.living, start_s))
    joint, believed = living.covariance_m2, intake.beliefs(recording.sensor, config.slam)
    result = localize(recording, places, *believed, config, joint_m2=joint, realtime=realtime, progress=progress)
    result = with_verdict(result, recording, config.slam, living.landmarks(p_least=0.0), findings=found)
    return replace(result, warnings=(*(finding.message for finding in found), *result.warnings))
