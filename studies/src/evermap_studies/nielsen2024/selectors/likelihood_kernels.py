"""Kernel of the innovations of every look under every mode."""

from __future__ import annotations

import math

import numpy as np

from evermap.slam.kernels import N_SENSOR
from evermap.types import FloatArray, IntArray
from evermap_studies.nielsen2024.selectors.compiled import detection_residual, kernel


@kernel
def predict_rows(
    pose: FloatArray,
    landmark: IntArray,
    mode: FloatArray,
    reading: FloatArray,
    sigma: FloatArray,
    mount: FloatArray,
    states: FloatArray,
    pose_covariance: FloatArray,
    mode_covariance: FloatArray,
    range_m: FloatArray,
    bearing_rad: FloatArray,
    range_sigma_m: FloatArray,
    bearing_sigma_rad: FloatArray,
    squared_distance: FloatArray,
    log_density: FloatArray,
) -> None:
    """Fill the fields of `likelihood.Predicted` where there is a mode; arguments as in `likelihood.Readings`."""
    h = np.zeros(2)
    by_pose, by_landmark, by_states = np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, N_SENSOR))
    for row in range(len(landmark)):
        for k in range(mode.shape[1]):
            position = mode[landmark[row], k]
            if math.isnan(position[0]):
                continue
            # against a reading of zero the residual is the negative expected reading
            detection_residual(pose[row], position, states, mount, 0.0, 0.0, h, by_pose, by_landmark, by_states)
            h[0], h[1] = -h[0], -h[1]
            s_rr, s_rb, s_bb = sigma[row, 0] ** 2, 0.0, sigma[row, 1] ** 2
            p, m = pose_covariance[row], mode_covariance[landmark[row], k]
            for i in range(3):
                for j in range(3):
                    s_rr += by_pose[0, i] * p[i, j] * by_pose[0, j]
                    s_rb += by_pose[0, i] * p[i, j] * by_pose[1, j]
                    s_bb += by_pose[1, i] * p[i, j] * by_pose[1, j]
            for i in range(2):
                for j in range(2):
                    s_rr += by_landmark[0, i] * m[i, j] * by_landmark[0, j]
                    s_rb += by_landmark[0, i] * m[i, j] * by_landmark[1, j]
                    s_bb += by_landmark[1, i] * m[i, j] * by_landmark[1, j]
            range_m[row, k], bearing_rad[row, k] = h[0], h[1]
            range_sigma_m[row, k], bearing_sigma_rad[row, k] = math.sqrt(s_rr), math.sqrt(s_bb)
            if math.isnan(reading[row, 0]):
                continue
            dr = reading[row, 0] - h[0]
            db = reading[row, 1] - h[1]
            db -= 2.0 * math.pi * math.floor((db + math.pi) / (2.0 * math.pi))
            det = s_rr * s_bb - s_rb * s_rb
            squared = (s_bb * dr * dr - 2.0 * s_rb * dr * db + s_rr * db * db) / det
            squared_distance[row, k] = squared
            log_density[row, k] = -0.5 * (squared + math.log(det)) - math.log(2.0 * math.pi)
