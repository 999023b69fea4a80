"""`evermap persist`: a table of looks into beliefs, changes and forecasts, with figures and a report.

`table` reads, `run` computes, `write` makes the folder; each is of use alone. Submodules are imported by name: this
package itself loads nothing.
"""
