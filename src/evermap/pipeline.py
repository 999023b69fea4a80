"""From recordings to trajectories and maps: the main jobs, told in the order in which they happen.

`run_slam` is one recording by itself, or in a map that is given. `run_session` is one session of a map that lives on.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.config import Config
from evermap.errors import ConfigError, DataError, NumericalError
from evermap.types import AnyRecording, AnyRecordingT, Landmarks, Progress, Recording, SlamResult, SpatialRecording

if TYPE_CHECKING:
    from evermap.maps.living import LivingMap
    from evermap.maps.sessions.session import Session
    from evermap.slam.estimate import Solved


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
        realtime: process at the recording's pace.
        progress: told after every frame. An interrupt (Ctrl-C) ends the run early, with what was done so far.

    Raises:
        InputError: no `Recording`, or one with values that cannot be, such as stamps that run backwards.
        DataError: nothing can be estimated, for example because no landmark was ever seen.
        ConfigError: settings that contradict each other or the recording.
        NumericalError: no finite optimum.
    """
    from evermap.maps.sessions.session import existing
    from evermap.slam.check import odd, valid
    from evermap.slam.estimate import solve
    from evermap.slam.intake import beliefs, prepare
    from evermap.slam.result import concluded

    config = config or Config()
    if isinstance(recording, SpatialRecording):
        return _run_in_space(recording, config, prior_map, progress)
    recording = valid(recording, config.sensor, prior_map)
    remarks = odd(recording, identities=config.slam.unknown_ids is not True, settings=config.slam.check)
    prior, noise = beliefs(recording.sensor, config.slam)
    recording, voted = _voted(recording, config)
    if config.slam.unknown_ids:
        from evermap.slam.association.identify import identified

        keep_ids = config.slam.unknown_ids == "empty"
        recording = identified(recording, prior, noise, prior_map=prior_map, keep_ids=keep_ids)
    prepared = prepare(recording, prior_map, (*remarks, *voted))
    with _one_thread():
        solved = solve(recording, prepared, prior, noise, config.slam, realtime=realtime, progress=progress)
        return existing(solved, concluded(solved), config.living)


def run_together(
    recordings: Mapping[int, Recording], config: Config | None = None, *, progress: Progress | None = None
) -> dict[int, SlamResult]:
    """Estimate several robots that drove at the same time as one problem: landmarks are one where their ids are.

    Robots that saw each other (`Recording.robot_sightings`) tie each other's poses. Each is solved alone first.

    Args:
        recordings: by the numbers by which robots call each other; in the plane, their stamps on one clock.
        config: settings; None for the defaults.
        progress: told after every frame of each.

    Returns:
        the result of each, all in the frame of the first one's first pose.

    Raises:
        InputError: no `Recording`, or one with values that cannot be.
        DataError: nothing can be estimated from one, or nothing ties one to the others.
        ConfigError: landmarks without identities are those of one robot (`slam.unknown_ids`).
        NumericalError: no finite optimum.
    """
    from evermap.maps.sessions.session import existing
    from evermap.slam.check import odd, valid
    from evermap.slam.estimate import solve
    from evermap.slam.intake import beliefs, prepare
    from evermap.slam.result import concluded
    from evermap.slam.together import Member, solve_together

    config = config or Config()
    if config.slam.unknown_ids:
        problem = "landmarks that several robots see are known by their ids"
        raise ConfigError(problem, field="slam.unknown_ids", hint="leave it out, or run the robots one by one")
    members = []
    with _one_thread():
        for number, given in recordings.items():
            recording = valid(given, config.sensor)
            remarks = odd(recording, settings=config.slam.check)
            prior, noise = beliefs(recording.sensor, config.slam)
            recording, voted = _voted(recording, config)
            prepared = prepare(recording, None, (*remarks, *voted))
            alone = solve(recording, prepared, prior, noise, config.slam, progress=progress)
            if alone.interrupted:
                raise KeyboardInterrupt
            members.append(Member(number, alone, noise))
        return {
            number: existing(solved, replace(concluded(solved, online.frame), online=online), config.living)
            for number, solved, online in zip(recordings, *solve_together(members), strict=True)
        }


def _voted(recording: AnyRecordingT, config: Config) -> tuple[AnyRecordingT, tuple[str, ...]]:
    """The recording without ids that are contradicted, where ids are used and that is asked for; and remarks on it."""
    from evermap.slam.votes import without_contradicted_ids

    if config.slam.unknown_ids is True or not config.slam.vote_ids:
        return recording, ()
    voted = without_contradicted_ids(recording, config.slam.space)
    return voted, voted.warnings[len(recording.warnings) :]


def _one_thread() -> AbstractContextManager[Any]:
    """Matrices are small: threads would only wait for each other, and sum in another order on another machine."""
    from threadpoolctl import threadpool_limits

    limited: AbstractContextManager[Any] = threadpool_limits(limits=1, user_api="blas")
    return limited


def _run_in_space(
    recording: SpatialRecording, config: Config, prior_map: Landmarks | None, progress: Progress | None
) -> SlamResult:
    """The same in space: all frames are read, then solved together."""
    from evermap.maps.sessions.session import existing
    from evermap.maps.sessions.spatial import SpatialVisit
    from evermap.slam.space.intake import prepare_space
    from evermap.slam.space.moving import has_traffic, run_in_traffic
    from evermap.slam.space.result import concluded_in_space
    from evermap.slam.space.solve import solve_space

    with _one_thread():
        voted: tuple[str, ...] = ()
        if not has_traffic(recording):
            recording, voted = _voted(recording, config)
        if config.slam.unknown_ids:
            from evermap.slam.association.in_space import identified_in_space

            keep_ids = config.slam.unknown_ids == "empty"
            recording = identified_in_space(recording, config.slam.space, prior_map, keep_ids=keep_ids)
        if has_traffic(recording):
            return run_in_traffic(recording, config.slam.space, config.track, prior_map, progress)
        intake = prepare_space(recording, config.slam.space, voted)
        visit = SpatialVisit(recording, intake, solve_space(intake, prior_map, progress=progress))
        return existing(visit, concluded_in_space(recording, intake, visit.solved), config.living)


def run_session(
    recording: AnyRecording,
    living: LivingMap | None = None,
    config: Config | None = None,
    *,
    progress: Progress | None = None,
) -> Session:
    """Enter one session into a living map: localise from an unknown pose, find what changed, extend it (MATH.md 5).

    Args:
        recording: the session; its truth is not looked at. It begins after the newest session of the map; one that is
            late is entered by `enter_session`.
        living: the map; None begins one, in the frame of the first pose.
        config: settings; None for the defaults.
        progress: told after every frame.

    Raises:
        InputError: no `Recording`.
        DataError: nothing can be estimated, or the session is earlier than the map.
        NumericalError: no finite optimum.
    """
    from evermap.maps.living import LivingMap
    from evermap.maps.sessions.session import check_in_order
    from evermap.valid import check_type

    config = config or Config()
    check_type(recording)
    in_space = isinstance(recording, SpatialRecording)
    if living is None or (in_space and not len(living.places)):
        begun = LivingMap.in_space() if in_space else LivingMap()
        living = replace(living, places=begun.places, stays=begun.stays) if living is not None else begun
        living = replace(living, clock=recording.clock)
    if len(recording.frames):
        living = living.from_now_on(float(recording.frames.stamp_s[0]))
    check_in_order(recording, living)
    if isinstance(recording, SpatialRecording):
        return _bring_in_space(recording, living, config, progress)
    return bring_in(solve_alone(recording, living, config, progress=progress), living, config)


def _bring_in_space(
    recording: SpatialRecording, living: LivingMap, config: Config, progress: Progress | None
) -> Session:
    """The same in space, where a session is solved within the map from the beginning."""
    from evermap.maps.sessions import believe, spatial
    from evermap.maps.sessions import session as steps
    from evermap.maps.vicinity import Vicinity, cliques_of
    from evermap.slam.space.intake import prepare_space
    from evermap.slam.space.moving import has_traffic

    if has_traffic(recording):
        return _bring_in_traffic(recording, living, config, progress)
    recording, voted = _voted(recording, config)
    recording, living = steps.admitted(recording, living)
    intake = prepare_space(recording, config.slam.space, voted)
    with _one_thread():
        whole, vicinity = living, None
        if len(whole.places) > config.living.whole_places:
            vicinity = Vicinity.of(whole, cliques_of(whole, spatial.names_of(intake).ravel()), config.living)
            living = vicinity.part
        p_site = believe.aged(living, config.living, intake.start_s).p_here
        visit, where = spatial.visited(intake, recording, living, p_site, config.living, progress)
        if where is None and len(whole.places):
            return steps.lost(visit, whole, config.living, steps.NOT_FOUND)
        if vicinity is not None and where is not None:
            vicinity, where = steps.widened(vicinity, where, visit.path_m, visit.floor_sensor, config.living)
            living = vicinity.part
        living = visit.named(living)
        return steps.judged_twice(living, where, visit, vicinity, config.living)


def _bring_in_traffic(
    recording: SpatialRecording, living: LivingMap, config: Config, progress: Progress | None
) -> Session:
    """The same with boxes without identity, which get theirs from the map."""
    from evermap.maps.sessions import believe
    from evermap.maps.sessions import session as steps
    from evermap.maps.sessions.boxes import visited_in_traffic, without_strays
    from evermap.slam.space.moving import take_in_traffic

    recording, whole = steps.admitted(recording, living)
    with _one_thread():
        taken = take_in_traffic(recording, config.slam.space, config.track)
        p_site = believe.aged(whole, config.living, float(taken.recording.frames.stamp_s[0])).p_here
        visit, where = visited_in_traffic(taken, whole, p_site, config, progress)
        if where is None and len(whole.places):
            return steps.lost(visit, whole, config.living, steps.NOT_FOUND)
        living, vicinity = visit.named(whole), None
        if where is not None and len(whole.places) > config.living.whole_places:
            vicinity, where = steps.around(living, where, visit, config.living)
            living = vicinity.part
        session = steps.judged_twice(living, where, visit, vicinity, config.living)
        return replace(session, living=without_strays(session.living), recording=taken.recording)


def solve_alone(recording: Recording, living: LivingMap, config: Config, *, progress: Progress | None = None) -> Solved:
    """Estimate poses and landmarks of a session as one Gaussian: the first half of `run_session`.

    It is the same for all maps that agree on classes and deleted landmarks, whatever else they believe.
    """
    from evermap.maps.sessions.nameless import named_in, without_ids
    from evermap.maps.sessions.session import admitted
    from evermap.slam.check import odd
    from evermap.slam.cleaning import clean
    from evermap.slam.intake import beliefs

    recording = replace(recording, sensor=config.sensor.applied_to(recording.sensor))
    anonymous = config.slam.unknown_ids
    recording = clean(without_ids(recording) if anonymous is True else recording, config.slam.cleaning)
    recording, voted = _voted(recording, config)
    remarks = (*odd(recording, identities=anonymous is not True, settings=config.slam.check), *voted)
    recording, _ = admitted(recording, living)
    if anonymous:
        prior, noise = beliefs(recording.sensor, config.slam)
        recording, _ = admitted(named_in(recording, living, prior, noise, config.living), living)
    return _solved(recording, remarks, config, progress)


def _solved(recording: Recording, remarks: tuple[str, ...], config: Config, progress: Progress | None = None) -> Solved:
    """The same of a clean recording whose landmarks have names."""
    from evermap.slam.estimate import solve
    from evermap.slam.intake import beliefs, prepare

    prior, noise = beliefs(recording.sensor, config.slam)
    prepared = prepare(recording, remarks=remarks)
    # what moved is asked when it lies over the map
    settings = config.slam.model_copy(update={"method": "nohyp", "unknown_ids": False})
    with _one_thread():
        return solve(recording, prepared, prior, noise, settings, progress=progress)


def bring_in(alone: Solved, living: LivingMap, config: Config, *, cut: bool = True) -> Session:
    """Enter a session that was solved alone into a map: the second half of `run_session`.

    With `cut`, without what of it says nothing sure (`doubtful`).
    """
    from evermap.maps.sessions import believe
    from evermap.maps.sessions import session as steps

    visit = alone
    _, whole = steps.admitted(alone.recording, living)
    with _one_thread():
        large = len(whole.places) > config.living.whole_places
        vicinity, where = steps.near_session(whole, alone, config.living) if large else (None, None)
        living = whole if vicinity is None else vicinity.part
        # over the map as it is believed to be by now, and solved again with the map as its prior
        aged = believe.aged(living, config.living, alone.start_s)
        where = where if large else steps.laid(living, aged.p_here, alone, config.living)
        if where is None and len(living.places):
            return steps.lost(alone, whole, config.living, steps.NOT_FOUND)
        if where is not None:
            living, where, visit = steps.refit(
                living,
                aged.p_here,
                where,
                alone,
                config.living,
                robust=config.slam.robust,
                part=vicinity is not None,
            )
        if cut and config.living.search == "joint":
            some = steps.without(visit, steps.doubtful(visit, where, config.living))
            if some is None:
                return steps.lost(alone, whole, config.living, steps.CONTRADICTED)
            if some is not visit.recording:
                try:
                    return bring_in(_solved(some, visit.prepared.warnings, config), whole, config, cut=False)
                except (DataError, NumericalError):  # too little is left
                    return steps.lost(alone, whole, config.living, steps.CONTRADICTED)
        if where is not None and config.living.search == "joint" and not steps.fits(visit, alone, config.living):
            return steps.lost(alone, whole, config.living, steps.CONTRADICTED)
        return steps.judged_twice(living, where, visit, vicinity, config.living)


def run_localization(
    recording: AnyRecording,
    living: LivingMap,
    config: Config | None = None,
    *,
    realtime: bool = False,
    progress: Progress | None = None,
) -> SlamResult:
    """Localise in a living map that stays as it is: causal, from an unknown pose, at a fixed cost per frame.

    In space all frames are solved together, beside what the map says and what of it has moved, as `run_slam` with a
    prior map does.

    Args:
        recording: what a reader returned; its truth is not looked at.
        living: the map.
        config: settings; None for the defaults.
        realtime: process at the recording's pace.
        progress: told after every frame.

    Raises:
        ConfigError: `slam.unknown_ids`: that is not causal.
        DataError: the map is empty, or the robot's place in it could not be found.
    """
    from evermap.maps.sessions.believe import aged
    from evermap.maps.sessions.session import admitted
    from evermap.maps.sessions.spatial import standing
    from evermap.maps.vicinity import predicted_of
    from evermap.slam.check import odd, valid
    from evermap.slam.intake import beliefs
    from evermap.slam.localize_recording import localize

    config = config or Config()
    if config.slam.unknown_ids:
        problem = "landmarks without identity are told by what is seen later, which is not causal"
        raise ConfigError(problem, field="slam.unknown_ids", hint="leave it out, or enter the session")
    if not len(living.places):
        raise DataError("the map is empty", field="living", hint="enter a session first")
    if isinstance(recording, SpatialRecording):
        recording, living = admitted(recording, living)
        p_site = aged(living, config.living, float(recording.frames.stamp_s[0])).p_here
        return _run_in_space(recording, config, standing(living, p_site), progress)
    recording = valid(recording, config.sensor)
    remarks = odd(recording, settings=config.slam.check)
    recording, living = admitted(recording, living)
    named, start_s = np.unique(recording.detections.landmark_id), float(recording.frames.stamp_s[0])
    p_site = predicted_of(living, named, config.living, start_s)
    prior, noise = beliefs(recording.sensor, config.slam)
    result = localize(
        recording,
        living.sighted_rows(p_site),
        prior,
        noise,
        joint_m2=living.covariance_m2,
        realtime=realtime,
        progress=progress,
    )
    return replace(result, warnings=(*remarks, *result.warnings))
