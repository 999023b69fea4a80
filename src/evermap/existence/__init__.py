"""Is it still there? Recursive filters of a feature's persistence, one inverse-odds number and one stamp each.

`single` is the whole Rosen 2016 filter as pure functions on batches, `one` wraps it for a single feature, `batch` is
the compiled road for millions of rows. `joint` and `jff` filter the landmarks of rigid bodies (Bateman 2020).
Submodules are imported by name: this package itself loads nothing.
"""
