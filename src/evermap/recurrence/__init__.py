"""Is it there now, and when will it be back? Filters of features that come and go, and how their habits are learned.

Presence is an alternating renewal process: stays and absences follow each other, each with its own lifetime
(MATH.md section 4). Submodules are imported by name: this package itself loads nothing.
"""
