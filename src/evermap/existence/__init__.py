"""Is it still there? Recursive filters of a feature's presence, for features that stay once and those that return.

`recursion` holds the formulas of the persistence filter; `one_stay` filters one feature, `single` batches and streams,
`batch` millions of rows. `phase_type` and `run_length` are models of features that come and go, `sites` is the chain of
a clique over its sites, `protocol` what all models answer.
Submodules are imported by name: this package itself loads nothing.
"""
