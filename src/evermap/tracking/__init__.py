"""Objects over time: tracklets, assignment, the working set, re-identification, static spells (MATH.md section 7)."""
