"""Runs of the verbs: read, run, write."""
