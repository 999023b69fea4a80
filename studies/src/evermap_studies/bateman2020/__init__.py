"""Cliques seen in space (Bateman 2020): the filters of the thesis, its worlds and its tables."""
