"""Landmarks with several discrete positions (Nielsen 2024): selectors, simulation and recordings."""
