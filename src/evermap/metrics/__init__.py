"""Metrics: poses, landmarks, changes, beliefs and consistency, against truth where there is any."""
