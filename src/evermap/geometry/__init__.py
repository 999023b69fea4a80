"""Planar motions and rigid alignment."""
