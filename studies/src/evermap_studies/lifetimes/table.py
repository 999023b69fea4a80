"""The tables of what is learned about lifetimes, in Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from evermap_studies.lifetimes.truth import ESTIMATORS, NAIVE, SHARES
from evermap_studies.markdown import markdown_table, number

DESCRIPTIONS = {
    "chosen family": "bounds and entries; exponential, Weibull, log-normal or two exponentials, by AIC",
    "Gaussian process": "bounds and entries; hazard a Gaussian process over age",
    "bounds alone": "bounds; forgets what no visit has seen",
    "middle of the bounds": "Kaplan-Meier of the middles; forgets that too",
    "sightings as lifetimes": "Kaplan-Meier of first to last sighting; ignores all censoring",
    "mean of sightings": "an exponential of the same mean; ignores all censoring",
}


def as_markdown(table: Mapping[str, Any]) -> str:
    """The whole table as Markdown; no trailing line end."""
    parts = [_verdict(table), "### Months of patrols", _made(table), _by_share(table), _by_group(table)]
    parts += ["### Six laws", _laws(table)]
    parts += ["### The thesis' simulation", _tracking(table), _parked(table)]
    if table["rooms"]:
        parts += ["### Rooms", _rooms(table)]
    return "\n\n".join(parts)


def _verdict(table: Mapping[str, Any]) -> str:
    expected = table["expected_coverage"]
    lines = []
    for name in (name for name in ESTIMATORS if name not in NAIVE):
        share = table["coverage"][name]
        met = "yes" if share >= expected else "**no**"
        lines.append([f"95 % bands hold the truth: {name}", f"≥ {expected:.0%}", f"{share:.1%}", met])
    return markdown_table(["", "expected", "measured", "met"], lines)


def _made(table: Mapping[str, Any]) -> str:
    s = table["settings"]
    return (
        f"{s['repetitions']} times {s['objects']} objects and {s['duration_s'] / 86400.0:.0f} days, seed {s['seed']}; "
        f"all tables and figures in {table['processing_s']:.0f} s."
    )


def _by_share(table: Mapping[str, Any]) -> str:
    header = ["estimate", "what it makes of a stay", "all", *(f"{share:.0%} gone" for share in SHARES), "largest bias"]
    lines = []
    for name in ESTIMATORS:
        mine = [value for value in table["truth"] if value["estimator"] == name]
        at = np.mean([value["coverage"] for value in mine], axis=0)
        bias = max((float(b) for value in mine for b in value["bias"]), key=abs)
        lines.append(
            [name, DESCRIPTIONS[name], f"{table['coverage'][name]:.1%}", *(f"{a:.0%}" for a in at), f"{bias:+.3f}"]
        )
    return markdown_table(header, lines, words=(0, 1))


def _by_group(table: Mapping[str, Any]) -> str:
    names = [name for name in ESTIMATORS if name not in NAIVE]
    rows = [value for value in table["truth"] if value["estimator"] == names[0]]
    lines = []
    for row in rows:
        where = row["class"], row["place"]
        line = [*where]
        for name in names:
            (value,) = [v for v in table["truth"] if v["estimator"] == name and (v["class"], v["place"]) == where]
            line += [f"{np.mean(value['coverage']):.0%}", f"{np.mean(value['rmse']):.3f}"]
        lines.append(line)
    header = ["class", "place", *(word for name in names for word in (name, "error"))]
    return markdown_table(header, lines, words=(0, 1))


def _laws(table: Mapping[str, Any]) -> str:
    """Coverage of bands, and the loss of forecasts beyond that of who knows the law, over all sizes of samples."""
    rows = table["laws"]
    names = list(dict.fromkeys(row["estimator"] for row in rows))
    lines = []
    for law, truncated in dict.fromkeys((row["law"], row["truncated"]) for row in rows):
        line = [law, "yes" if truncated else "no"]
        for name in names:
            mine = [r for r in rows if (r["law"], r["truncated"], r["estimator"]) == (law, truncated, name)]
            excess = [f"{row['excess']:.4f}" for row in mine]
            line += [f"{np.mean([row['coverage'] for row in mine]):.1%}", " / ".join(excess)] if mine else ["", ""]
        lines.append(line)
    counts = " / ".join(map(str, dict.fromkeys(row["n"] for row in rows)))
    columns = [
        word for name in names for word in (f"{name}: 95 % bands", f"loss beyond the law's, {counts} stays [nats]")
    ]
    return markdown_table(["law", "truncated", *columns], lines, words=(0, 1))


def _tracking(table: Mapping[str, Any]) -> str:
    rows = [value for value in table["moving"] if "run" in value]
    forms = {"mota": "{:.3f}", "idf1": "{:.3f}", "motp_m": "{:.3f}", "switches": "{:.0f}", "fragmentations": "{:.0f}"}
    lines = [[str(row["run"]), *(form.format(row[name]) for name, form in forms.items())] for row in rows]
    mean = [form.format(np.mean([row[name] for row in rows])) for name, form in forms.items()]
    header = ["run", "MOTA", "IDF1", "distance [m]", "switches", "fragmentations"]
    return markdown_table(header, [*lines, ["mean", *mean]])


def _parked(table: Mapping[str, Any]) -> str:
    rows = [value for value in table["moving"] if "class" in value]
    lines = [
        [
            row["class"],
            str(row["stays"]),
            f"{row['mean_s']:.0f}",
            f"{row['true_mean_s']:.0f}",
            f"{row['largest_error']:.3f}",
            f"{row['coverage']:.0%}",
        ]
        for row in rows
    ]
    header = ["class", "stays", "mean [s]", "true mean [s]", "largest error of survival", "truth in the band"]
    return markdown_table(header, lines)


def _rooms(table: Mapping[str, Any]) -> str:
    lines = [
        [
            row["room"],
            f"{row['every_s'] / 60.0:.0f}",
            str(row["stays"]),
            str(row["stays_seen"]),
            *(number("{:.2f}", row[kind][name]) for kind in ("distance", "distance_beyond") for name in row[kind]),
        ]
        for row in table["rooms"]
    ]
    header = ["room", "look every [min]", "stays", "seen", "bounds", "entered", "bounds, beyond", "entered, beyond"]
    return markdown_table(header, lines)
