"""Figures 1 to 4 of the persistence filter's paper (Rosen 2016)."""
