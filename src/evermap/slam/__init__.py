"""Estimation of one session: factor graph, calibration and noise."""
