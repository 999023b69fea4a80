"""Objects over time: `evermap track` makes lifetimes of detections, `evermap survival fit` makes priors of lifetimes.

Folders, tables and lifetimes of a run. The tracker and the reader of detections are in `evermap.tracking`, the
estimators in `evermap.survival`. Submodules are imported by name: this package itself loads nothing.
"""
