"""Landmarks laid over landmarks: candidate motions, their joint Gaussian evidence, and whether one is accepted."""
