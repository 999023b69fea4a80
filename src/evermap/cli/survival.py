"""`evermap survival`: how long features stay, as words, numbers and pictures; estimated, and learned."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evermap.cli.options import AsJson, ConfigFile, Settings, ShowConfig, argument, configure, duration_s, option
from evermap.cli.terminal import check_picture, print_json, print_table, progress_bar, say, warn, write_picture
from evermap.errors import ConfigError

if TYPE_CHECKING:
    from evermap.existence.models import Choice
    from evermap.runs.track.lifetimes import LifetimeEstimate, LifetimeGroup, LifetimeTable
    from evermap.survival import LifetimePrior

PLOT = """\
Draw lifetime priors in four views.

The views are hazard, cumulative hazard, survival and density over the time since a feature was first seen.
Durations have a unit (us, ms, s, min, h, d, w, y), rates are per such a unit, shares are below 1.

\b
A prior is one of:
  exponential:half-life=2d                            half are gone after 2 days; or mean=3d, or rate=0.5/d
  unknown:1h..30d                                     the mean stay is unknown, between 1 hour and 30 days
  general-purpose:low=0.001/s,high=1/s                the same by its rates, as in Rosen 2016
  uniform:limit=3d                                    any stay up to 3 days, none longer
  weibull:scale=2d,shape=0.7                          shape < 1: the hazard falls with age; > 1: it rises
  lognormal:median=2d,spread=1.5                      half are gone after 2 days, the logarithms spread by 1.5
  gamma:scale=2d,shape=2                              two exponential stages of 2 days one after the other
  never-leaves                                        walls
  gone-overnight:p=0.3,seen=10:00,night=20:00..6:00   a night takes 30 %, a day nothing; first seen at 10:00
  gone-by-day:p=0.3,seen=10:00,day=8:00..18:00        a day takes 30 %, a night nothing
  hazard:0s=1/d,3d=0.01/d                             a rate of 1 a day for 3 days, then 0.01 a day
  mass:0s..1h=0.3,2d=0.5,never=0.2                    30 % leave within the first hour, 50 % after just 2 days
  periodic:period=1w,0s=0.2/d,5d=0/d,start=2d         a rate that repeats, here 5 days a week; first seen on day 2
or a mixture of them:
  0.3*exponential:half-life=1h+0.7*never-leaves

\b
Example:
  evermap survival plot unknown:1h..30d exponential:half-life=2d --out priors.png
"""
FIT = """\
Estimate lifetime distributions from censored lifetimes.

\b
The table has one row per lifetime, in seconds: left, the age at the last sighting, and right, when it was found gone
(equal: the end was observed; empty: never seen gone). Optionally entry (age at its first observation, left truncation),
weight, class_id, x_m, y_m. `evermap track` writes such tables.

\b
Estimators:
  npmle                                   maximum likelihood without a family (Turnbull), for any bounds
  kaplan-meier                            the same with bands, if each end was observed or never seen
  exponential, weibull, lognormal, gamma  maximum likelihood within a family; extrapolates
  general-purpose                         an unknown rate between two limits
  two-exponentials, some-never-leave      some stay briefly, others long; or permanently
  best                                    the family with the smallest AIC
  gp                                      a Gaussian process hazard with credible bands; groups learn from all
  pooled                                  what maps learn by: the same without a family, and without any end

\b
Every result is a prior: --json gives its text for `evermap persist --prior`, --out a file for `--set model=FILE`.
In JSON, null stands for infinity: in support_right, for mass without an observed end.

\b
Examples:
  evermap survival fit lifetimes.csv --by class --figure survival.png --out priors.json
  evermap survival fit lifetimes.csv --by class,chunk --estimator best --json
  evermap persist looks.csv --set model=priors.json
"""
LEARN = """\
Learn the durations of stays and absences.

From looks alone, without truth or a list of changes. Every kind of model is learned without the last part of the looks
and scored on predicting it; the best is learned again from all looks.

\b
Example:
  evermap survival learn looks.csv --out model.json --figure model.png
  evermap persist tomorrow.csv --set model=model.json
"""

app = typer.Typer(name="survival", help="How long features stay.", no_args_is_help=True, rich_markup_mode=None)


@app.command("plot", help=PLOT)
def plot(
    priors: Annotated[list[str], argument("Lifetime priors, in the forms below.", metavar="PRIOR...")],
    out: Annotated[Path, option("Figure to write, .png or .svg.")] = Path("lifetimes.png"),
    until: Annotated[str | None, option("End of the time axis, as 30d.", default="when nearly all have left")] = None,
    log_time: Annotated[
        bool | None, option("--log/--linear", "Axis of time.", default="by the span of the lifetimes")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Draw lifetime priors in four views."""
    from evermap.survival.text import parse_prior
    from evermap.viz.lifetime_figures import plot_lifetimes

    check_picture(out, "out")
    named = {text: parse_prior(text) for text in priors}
    until_s = duration_s(until, "until")
    write_picture(out, plot_lifetimes(named, until_s=until_s, log_time=log_time))
    rows = {name: lifetime_numbers(prior) for name, prior in named.items()}
    if as_json:
        print_json({"out": str(out), "priors": rows})
        return
    for name, numbers in rows.items():
        print_table(name, lifetime_lines(numbers))
    say(f"drawn in {out}")


Lifetimes = Annotated[Path, argument("Table of lifetimes: .csv, .csv.gz or .parquet.", metavar="FILE", default=False)]
By = Annotated[
    str | None, option("Estimate classes, places or both separately.", metavar="class,chunk", default="all as one")
]
Estimator = Annotated[str | None, option("Estimator, one of the list below.", metavar="NAME", default="npmle")]
ChunkSide = Annotated[float | None, option("Side of the squares of --by chunk [m].", default="10")]
PriorsFile = Annotated[
    Path | None,
    option("File for the priors, for `evermap persist --set model=FILE`.", metavar="FILE.json", default="none"),
]
Curves = Annotated[Path | None, option("Draw the survival functions.", metavar="FILE.png", default="none")]


@app.command("fit", help=FIT)
def fit(
    input: Lifetimes,
    by: By = None,
    estimator: Estimator = None,
    chunk_m: ChunkSide = None,
    out: PriorsFile = None,
    figure: Curves = None,
    config: ConfigFile = None,
    settings: Settings = None,
    show_config: ShowConfig = False,
    as_json: AsJson = False,
) -> None:
    """Estimate lifetime distributions from censored lifetimes."""
    given = {"by": by, "estimator": estimator, "chunk_m": chunk_m}
    chosen = configure(config, settings, given, within="survival", show=show_config).survival
    from evermap.existence.models import is_model_file
    from evermap.runs.folder import check_output_file
    from evermap.runs.track.lifetimes import BY_CHUNK, check_estimator, estimates, groups_of, parse_by, read_lifetimes

    check_estimator(chosen.estimator)
    words = parse_by(chosen.by)
    if figure is not None:
        check_picture(figure, "figure", inputs=[input])
    if out is not None:
        check_output_file(out, inputs=[input], ending=".json", ours=is_model_file)
    if out is not None and BY_CHUNK in words:
        raise ConfigError("a model file has no places", field="out", hint="--by class, or the texts of --json")
    table = read_lifetimes(input)
    groups = groups_of(table, words, chosen.chunk_m)
    found: list[LifetimeEstimate] = []
    with progress_bar(f"{input.name}: estimating", speed=False) as progress:
        for one in estimates(chosen.estimator, table, groups):
            found.append(one)
            if progress:
                progress(len(found), len(groups))
    if out is not None:
        _keep(out, groups, found)
    if figure is not None:
        from evermap.viz.lifetime_figures import plot_survival

        curves = {group.label: one.fitted for group, one in zip(groups, found, strict=True)}
        write_picture(figure, plot_survival(curves))
    for remark in table.warnings:
        warn(remark)
    for group in groups:
        if (table.data.right_s[group.rows] == math.inf).all():
            warn(f"{group.label}: no end was observed, so the estimate never ends")
    if as_json:
        parts = [_content(table, group, one) for group, one in zip(groups, found, strict=True)]
        head = {"source": str(input), "by": list(words), "config": {"survival": chosen.to_dict()}}
        print_json({**head, "groups": parts} if words else {**head, **parts[0]})
        return
    for group, one in zip(groups, found, strict=True):
        print_table(group.label if words else input.name, _lines(table, group, one))
    if out is not None:
        say(f"written to {out}; use it with: evermap persist INPUT --set model={out}")
    if figure is not None:
        say(f"drawn in {figure}")


Recurrent = Annotated[
    str | None, option("How features return: none, auto, or a kind of model to learn.", metavar="KIND", default="none")
]
Per = Annotated[
    str | None, option("Which features share a learned model.", metavar="all|class|feature", default="by the table")
]
PMiss = Annotated[float | None, option("P(no detection | there) if the table has no p_miss.", default="0.1")]
PFalse = Annotated[float | None, option("P(detection | not there) if the table has no p_false.", default="0.1")]


@app.command("learn", help=LEARN)
def learn(
    input: Annotated[Path, argument("Table of looks, as `evermap persist` reads it.", metavar="INPUT", default=False)],
    out: Annotated[Path, option("File for the model.")] = Path("model.json"),
    figure: Annotated[
        Path | None, option("Figure of the model's predictions.", metavar="FILE.png", default="none")
    ] = None,
    recurrent: Recurrent = None,
    per: Per = None,
    p_miss: PMiss = None,
    p_false: PFalse = None,
    config: ConfigFile = None,
    settings: Settings = None,
    show_config: ShowConfig = False,
    as_json: AsJson = False,
) -> None:
    """Learn the durations of stays and absences."""
    given = {"recurrent": recurrent, "per": per, "p_miss": p_miss, "p_false": p_false}
    chosen = configure(config, settings, given, within="persist", show=show_config).persist
    if recurrent is None and chosen.stays_once:  # there is nothing to learn of one stay
        chosen = chosen.model_copy(update={"recurrent": "auto"})
    if figure is not None:
        check_picture(figure, "figure", inputs=[input])
    from evermap.existence.models import is_model_file
    from evermap.runs.folder import check_output_file
    from evermap.runs.persist.models import learn_models, save_models
    from evermap.runs.persist.table import read_looks

    check_output_file(out, inputs=[input], ending=".json", ours=is_model_file)
    table = read_looks(input, p_miss=chosen.p_miss, p_false=chosen.p_false)
    with progress_bar(f"{input.name}: learning", speed=False) as progress:
        tell = None if progress is None else lambda done: progress(done, 1.0)
        learned = learn_models(table, table.looks(table.order()), chosen, progress=tell)
    save_models(learned.models, learned.per, out)
    if figure is not None:
        from evermap.viz.presence_figures import plot_presence_models

        write_picture(figure, plot_presence_models(dict(zip(learned.models.names, learned.models.models, strict=True))))
    if as_json:
        print_json({"out": str(out), **learned.to_dict(), "config": {"persist": chosen.to_dict()}})
        return
    for name, choice in zip(learned.models.names, learned.choices, strict=True):
        print_table(name or input.name, _format_learned(choice))
    say(f"written to {out}; use it with: evermap persist INPUT --set model={out}")


def _keep(out: Path, groups: Sequence[LifetimeGroup], estimates: Sequence[LifetimeEstimate]) -> None:
    """The priors as models of one stay."""
    import numpy as np

    from evermap.existence.one_stay import OneStay
    from evermap.runs.persist.models import ModelOfEach, save_models

    models = tuple(OneStay(found.prior, found.text) for found in estimates)
    names = tuple(group.class_id or "" for group in groups)
    per = "all" if groups[0].class_id is None else "class"
    save_models(ModelOfEach(models, names, np.zeros(0, dtype=np.int64)), per, out)


def _counts(table: LifetimeTable, group: LifetimeGroup) -> dict[str, Any]:
    """Return the number of lifetimes of each sort."""
    import numpy as np

    left, right, entry = (getattr(table.data, name)[group.rows] for name in ("left_s", "right_s", "entry_s"))
    exact, (seen_from_s, seen_to_s) = left == right, table.data[group.rows].at_risk_s
    return {
        "samples": len(group.rows),
        "weight": float(table.data.weight[group.rows].sum()),
        "exact": int(exact.sum()),
        "intervals": int((np.isfinite(right) & ~exact).sum()),
        "never_seen_gone": int(np.isinf(right).sum()),
        "truncated": int((entry > 0.0).sum()),
        "seen_from_s": seen_from_s,
        "seen_to_s": seen_to_s,
    }


def _content(table: LifetimeTable, group: LifetimeGroup, found: LifetimeEstimate) -> dict[str, Any]:
    """Return the content of `--json`."""
    return {
        **({} if group.class_id is None else {"class_id": group.class_id}),
        **({} if group.chunk is None else {"chunk": list(group.chunk)}),
        "estimator": found.estimator,
        **_counts(table, group),
        **found.numbers,
        **lifetime_numbers(found.prior),
        "prior": found.text,
    }


def _lines(table: LifetimeTable, group: LifetimeGroup, found: LifetimeEstimate) -> list[tuple[str, str]]:
    """Return the lines for people."""
    counts = _counts(table, group)
    ends = f"{counts['exact']:,} observed, {counts['intervals']:,} between two looks"
    lines = [
        ("stays", f"{counts['samples']:,}, each of one object at one place"),
        ("their ends", f"{ends}, {counts['never_seen_gone']:,} never seen"),
        ("estimator", found.estimator),
        ("ages with data", _ages_with_data({**counts, **found.numbers}, found.prior)),
    ]
    if "loglik" in found.numbers:
        lines.append(("log likelihood", f"{found.numbers['loglik']:.6g}"))
    if "hours" in found.numbers:
        lines.append(("hours of the week", found.numbers["hours"]["line"]))
    if len(found.text) < 80:
        lines.append(("prior", found.text))
    return [*lines, *lifetime_lines(lifetime_numbers(found.prior))]


def _ages_with_data(numbers: Mapping[str, Any], prior: LifetimePrior) -> str:
    """Return between which ages an end would have been seen, and how many leave before by what is not in the table."""
    from evermap.survival.durations import duration_text

    from_s, to_s = numbers["seen_from_s"], numbers["seen_to_s"]
    until = "any" if to_s is None else duration_text(to_s)
    if not from_s:
        return f"up to {until}"
    share = -math.expm1(float(prior.log_survival(from_s)))
    return f"{duration_text(from_s)} to {until}; that {100.0 * share:.3g} % leave before is supposed, not seen"


def _format_learned(choice: Choice) -> list[tuple[str, str]]:
    """Return the lines on a model for people."""
    import numpy as np

    from evermap.survival.durations import duration_text
    from evermap.viz.presence_figures import week_of_presence

    lines = [("kind", choice.kind)]
    if choice.scores:
        best = max(choice.scores.values())
        others = [f"{name} {score - best:.1f}" for name, score in choice.scores.items() if name != choice.kind]
        lines.append((f"log score of the others, last {duration_text(choice.held_out_s)}", ", ".join(others)))
    _, week = week_of_presence(choice.model)
    lines.append(("there on the whole", f"{100.0 * float(np.mean(week)):.1f} % of the time"))
    return lines


_GONE = {
    "quarter_gone_s": (0.25, "a quarter is gone after"),
    "half_gone_s": (0.5, "half are gone after"),
    "three_quarters_gone_s": (0.75, "three quarters after"),
}
"""Quartiles of a lifetime: share that is gone, and the line for people."""


def lifetime_numbers(prior: LifetimePrior) -> dict[str, float | None]:
    """Return quartiles and mean in seconds, None for what never comes; and the share that never leaves."""
    from evermap.types import json_number

    times_s = {key: float(prior.quantile(p)) for key, (p, _) in _GONE.items()} | {"mean_stay_s": prior.mean()}
    return {key: json_number(value) for key, value in times_s.items()} | {"p_never_leaves": prior.p_never_leaves}


def lifetime_lines(numbers: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the same in words."""
    from evermap.survival.durations import duration_text

    times_s = [(title, math.inf if numbers[key] is None else numbers[key]) for key, (_, title) in _GONE.items()]
    times_s += [] if numbers["mean_stay_s"] is None else [("mean stay", numbers["mean_stay_s"])]
    lines = [(title, duration_text(time_s)) for title, time_s in times_s]
    if numbers["p_never_leaves"]:
        lines.append(("never leave", f"{100.0 * numbers['p_never_leaves']:.3g} %"))
    return lines
