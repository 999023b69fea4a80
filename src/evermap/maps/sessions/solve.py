"""A session is solved: as given, or under the causes that explain it better."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from evermap.config import Config
from evermap.errors import DataError, NumericalError
from evermap.explain.answer import in_given_units
from evermap.explain.causes.suspect import Inputs
from evermap.explain.competition import explain
from evermap.explain.evidence import AnySession, SpatialSession
from evermap.explain.put_right import find_late_sensor, find_put_right
from evermap.explain.scores import ScreenedSession
from evermap.explain.trial import Explained, SessionSolution, Trial
from evermap.maps.living import EXISTS, LivingMap
from evermap.maps.sessions.planar import PlanarVisit
from evermap.maps.sessions.session import Session, Visit
from evermap.maps.sessions.spatial import solve_visit
from evermap.slam.estimate import Solved, solve
from evermap.types import AnyRecording, Landmarks, Progress, is_in_space


def solve_session(
    recording: AnyRecording,
    config: Config,
    prior_map: Landmarks | None,
    remarks: tuple[str, ...],
    *,
    realtime: bool = False,
    progress: Progress | None = None,
) -> Visit:
    """Return a recording with identities solved, by itself or in a map that is given; arguments as of `run_slam`."""
    if is_in_space(recording):
        return solve_visit(recording, config, prior_map, remarks, progress=progress)
    alone = solve(recording, config.slam, prior_map=prior_map, remarks=remarks, realtime=realtime, progress=progress)
    return PlanarVisit(alone)


def explain_session(
    inputs: Inputs,
    config: Config,
    remarks: tuple[str, ...],
    *,
    realtime: bool = False,
    progress: Progress | None = None,
    is_read_well: bool = False,
    is_suspected: bool = False,
    solution: SessionSolution[Visit] | None = None,
) -> Explained[Visit]:
    """Return a session solved, with its result: as given, or under the causes that explain it better (`explain`), its
    calibration in the units that were given.

    Args:
        inputs: with identities.
        config: settings.
        remarks: on the recording, the first warnings.
        realtime: as of `run_slam`, of the session as given.
        progress: the same.
        is_read_well: whether pairs of sightings are known to show no mistake.
        is_suspected: whether scores say that a calibration is not as stated.
        solution: of the inputs as given, where it is known.

    Raises:
        DataError, NumericalError: as of `run_slam`.
    """

    def under(given: Inputs, known: Solved | None = None, **more: Any) -> SessionSolution[Visit]:
        visit: Visit
        if known is None:
            visit = solve_session(given.recording, config, given.prior_map, remarks, **more)
        else:
            visit = PlanarVisit(known)
        result = visit.concluded()
        if not np.isfinite(result.trajectory.pose_world_robot).all():
            raise NumericalError("the solution has poses that are no numbers", hint="check units, mounts and stamps")
        return SessionSolution(visit, ScreenedSession(solution_of(visit), given), result)

    told = list[str]()
    try:
        as_given = solution or under(inputs, realtime=realtime, progress=progress)
    except (DataError, NumericalError):
        found = None
        if config.slam.explain.on:
            found = explain(inputs, None, under, config.slam, told.append)
        if found is None:
            raise
    else:
        if not config.slam.explain.on or as_given.result.interrupted or realtime:
            return Explained(Trial(as_given, (), math.nan, 1.0), ())
        found = explain(
            inputs, as_given, under, config.slam, told.append, is_read_well=is_read_well, is_suspected=is_suspected
        )
        assert found is not None
    if not found.causes:
        return found
    result = replace(in_given_units(found.best), causes=found.causes)
    return replace(found, best=replace(found.best, solution=replace(found.best.solution, result=result)))


def solution_of(visit: Visit) -> AnySession:
    """Return what a session's estimate is, as causes are asked of it."""
    return visit.solved if isinstance(visit, PlanarVisit) else SpatialSession(visit.intake, visit.solved)


def with_causes(session: Session, living: LivingMap, config: Config) -> Session:
    """Return a session that was set aside with causes other than changes, if any explain why it does not fit the map.

    It is not entered under them: that is for who trusts them, or mends the recording.
    """
    if session.found or not config.slam.explain.on or not len(living.places):
        return session
    found = find_causes(session, living, config)
    return session if found is None else replace(session, slam=replace(session.slam, causes=found.causes))


def find_causes(
    session: Session, living: LivingMap, config: Config, *, is_suspected: bool = False
) -> Explained[Visit] | None:
    """Return what explains a session, solved by itself with the map as one that is given; None if nothing can be.

    `is_suspected` is as of `explain`.
    """
    expected = living.landmarks(p_least=EXISTS) if len(living.places) else None
    try:
        return explain_session(Inputs.of(session.recording, expected), config, (), is_suspected=is_suspected)
    except (DataError, NumericalError):
        return None


def with_put_right(session: Session, config: Config) -> Session:
    """Return a session that was found in its map with what the estimator itself put right: clocks and scales."""
    if not (session.found and config.slam.explain.on):
        return session
    causes = find_put_right(session.slam, Inputs.of(session.recording, None), config.slam)
    return replace(session, slam=replace(session.slam, causes=(*session.slam.causes, *causes)))


def is_doubtful(session: Session) -> bool:
    """Return whether causes are to be asked of a session with its verdict: it is neither sound nor weak, or its sensor
    is late.
    """
    slam = session.slam
    return not slam.is_trustworthy or find_late_sensor(slam, Inputs.of(session.recording, None)) is not None


def with_calibration(session: Session, found: Explained[Visit]) -> Session:
    """Return a session that was entered without what causes did, with these, and its calibration in the units given."""
    trial = replace(found.best, solution=replace(found.best.solution, result=session.slam))
    return replace(session, slam=replace(in_given_units(trial), causes=found.causes))
