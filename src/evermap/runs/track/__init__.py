"""Objects over time: `evermap track` makes lifetimes of detections, `evermap survival fit` makes priors of lifetimes.

Tables, runs, folders and reports; the tracker itself is `evermap.tracking`, the estimators are in `evermap.survival`.
Submodules are imported by name: this package itself loads nothing.
"""
