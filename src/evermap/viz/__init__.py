"""Figures, the HTML report and the rerun scene of a run. Nothing here needs a display."""
