"""Rigid motions of the plane and of space behind one protocol, and rigid alignment."""
