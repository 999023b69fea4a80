"""Lifetimes learned from tracks, patrols and looks at rooms, against the truth."""
