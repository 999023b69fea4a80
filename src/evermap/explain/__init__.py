"""Causes that are not changes of landmarks: what they undo of a recording, and how probable it is under each."""
