"""Simulated worlds of the studies."""
