"""The clique filter whose detection model learns as it goes, run over the simulated runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evermap.existence import single
from evermap.sensing import learned
from evermap.sensing.profile import Assumed, Profile
from evermap.survival import Exponential
from evermap.types import FloatArray
from evermap_studies.worlds.cliques import CliqueRun


def learned_beliefs(run: CliqueRun, prior: Exponential, profile: Profile | None = None) -> tuple[FloatArray, Profile]:
    """Follow one run.

    Args:
        run: of the simulation; only poses, places and detections of it are used.
        prior: of the lifetimes.
        profile: what is known of the sensor; None for nothing but the limits of its field.

    Returns:
        (F, C) beliefs, 1 before a clique's birth, and the profile at the end.
    """
    steps, cliques = len(run.position_m), len(run.first)
    model = learned.init(run.landmark_m, run.clique, profile or Assumed(field=run.world.field))
    belief = single.init(cliques, prior)
    p_there = np.ones((steps, cliques))
    for step in range(steps):
        born = run.first <= step
        pose = run.pose_position_m[step], run.pose_rotation[step]
        model, seen = learned.look(model, float(step), *pose, run.detected[step], active=born)
        belief = belief.observe(seen.stamp_s - run.first, seen.log_there, seen.log_gone)
        p_there[step] = belief.predict(np.maximum(step - run.first, 0.0))
        model = learned.confirm(model, seen, p_there[step])
    return p_there, model.profile


def learned_profile(runs: Sequence[CliqueRun], prior: Exponential) -> Profile:
    """What a sensor's profile is after some runs, one after the other past new objects."""
    profile = Profile.of(Assumed(field=runs[0].world.field))
    for run in runs:
        _, profile = learned_beliefs(run, prior, profile)
    return profile
