"""Covariances in space where corners of a tag err alike for a while, and settings that space reads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.config import Config
from evermap.metrics.summary import compare_with_truth
from evermap.pipeline import run_slam
from evermap.types import SpatialRecording

from .corridors import tagged_corridor


def lasting(recording: SpatialRecording, seed: int, sigma_px: float, time_s: float) -> SpatialRecording:
    """Shift all corners of each tag alike, by an autoregressive sequence of its own."""
    seen, random = recording.detections, np.random.default_rng([seed, 3])
    stamp_s, corner = recording.frames.stamp_s[seen.frame], seen.corner_px.copy()
    for tag in np.unique(seen.landmark_id):
        mine, by = np.flatnonzero(seen.landmark_id == tag), random.normal(size=2)
        for before, row in zip([mine[0], *mine[:-1]], mine, strict=True):
            keep = np.exp(-(stamp_s[row] - stamp_s[before]) / time_s)
            by = keep * by + np.sqrt(1.0 - keep**2) * random.normal(size=2)
            corner[row] += sigma_px * by
    return replace(recording, detections=replace(seen, corner_px=corner))


@pytest.mark.parametrize("seeds", [(1, 2), pytest.param((1, 2, 3, 4), marks=pytest.mark.slow)], ids=len)
def test_tags_whose_corners_err_alike_are_no_better_known_than_that(seeds):
    """NEES of landmarks is 4 to 20 times its expectation if frames count as independent, as where corners are white."""
    found = []
    for sigma_px in (0.0, 3.0):
        nees = []
        for seed in seeds:
            recording = lasting(tagged_corridor(seed).recording, seed, sigma_px, 5.0)
            scores = compare_with_truth(recording, run_slam(recording))
            assert scores.landmarks_anchored is not None
            nees.append(np.nanmean(scores.landmarks_anchored.nees) / 3.0)
        found.append(float(np.median(nees)))
    assert 0.2 < found[0] < 1.5
    assert 0.4 < found[1] < 2.5


def test_noise_may_be_as_stated_and_every_identity_believed():
    recording = tagged_corridor(5, p_wrong=0.03).recording
    usual = run_slam(recording)
    stated = run_slam(recording, Config.model_validate({"slam": {"estimate_noise": False}}))
    level = {one.name: one.value for one in stated.parameters}
    assert level["sigma_corner_px"] == Config().slam.space.sigma_px
    believed = run_slam(recording, Config.model_validate({"slam": {"robust": False, "vote_ids": False}}))
    assert np.all(believed.innovations.p_inlier == 1.0)
    assert np.any(usual.innovations.p_inlier < 0.5)
