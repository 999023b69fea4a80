"""Landmarks with several positions: gates, births, and the alternation of Nielsen and Hendeby (2024)."""
