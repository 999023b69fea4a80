"""`evermap survival fit`: how long things stay, estimated from lifetimes of which only bounds are known."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evermap.cli.lifetime_numbers import lifetime_lines, lifetime_numbers
from evermap.cli.picture import check_picture, write_picture
from evermap.cli.terminal import print_json, print_table, progress_bar, say, warn
from evermap.errors import ConfigError

if TYPE_CHECKING:
    from evermap.runs.track.estimate import Estimate
    from evermap.runs.track.lifetimes import Group, LifetimeTable


def fit(
    table_path: Annotated[
        Path, typer.Argument(metavar="FILE", help="Table of lifetimes: .csv, .csv.gz or .parquet.", show_default=False)
    ],
    by: Annotated[
        str, typer.Option(metavar="class,chunk", help="Tell classes, places or both apart.", show_default="all as one")
    ] = "",
    estimator: Annotated[str, typer.Option(metavar="NAME", help="How to estimate: one of the list below.")] = "npmle",
    chunk_m: Annotated[float, typer.Option(help="Side of the squares of --by chunk [m].")] = 10.0,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE.json", help="Keep the priors for `evermap persist --model`.", show_default="none"),
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Draw the survival functions.", show_default="none")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print all numbers as JSON.")] = False,
) -> None:
    """Estimate lifetimes of which only bounds are known.

    \b
    The table has a row a lifetime, in seconds: left, for how long it was seen to stay, and right, when it was found
    gone (equal: the end was watched; empty: never seen gone). It may have entry (known only because it was still
    there by then), weight, class_id, x_m, y_m. `evermap track` writes such tables.

    \b
    Estimators:
      npmle                                   the most probable distribution of all (Turnbull), for any bounds
      kaplan-meier                            the same with bands, where each end was watched or never seen
      exponential, weibull, lognormal, gamma  the most probable of a family; extrapolates
      general-purpose                         the rate is unknown between two limits
      two-exponentials, some-never-leave      some stay briefly, others long; or for ever
      best                                    the family with the least AIC
      gp                                      a Gaussian process hazard with credible bands; groups learn from all

    \b
    Every result is a prior: --json gives its text for `evermap persist --prior`, --out a file for --model.
    In JSON, null stands for infinity: in support_right, for mass that was never seen to end.

    \b
    Examples:
      evermap survival fit lifetimes.csv --by class --figure survival.png --out priors.json
      evermap survival fit lifetimes.csv --by class,chunk --estimator best --json
      evermap persist looks.csv --model priors.json
    """
    from evermap.runs.folder import check_output_file
    from evermap.runs.track.estimate import check_estimator, estimates
    from evermap.runs.track.lifetimes import BY_CHUNK, groups_of, parse_by, read_lifetimes

    check_estimator(estimator)
    words = parse_by(by)
    if figure is not None:
        check_picture(figure, "--figure", inputs=[table_path])
    if out is not None:
        check_output_file(out, inputs=[table_path], ending=".json")
    if out is not None and BY_CHUNK in words:
        raise ConfigError("a model file knows no places", field="--out", hint="--by class, or the texts of --json")
    table = read_lifetimes(table_path)
    groups = groups_of(table, words, chunk_m)
    found: list[Estimate] = []
    with progress_bar(f"{table_path.name}: estimating", speed=False) as progress:
        for one in estimates(estimator, table, groups):
            found.append(one)
            if progress:
                progress(len(found), len(groups))
    if out is not None:
        _keep(out, groups, found)
    if figure is not None:
        _draw(figure, groups, found)
    for remark in [*table.warnings, *_remarks(table, groups)]:
        warn(remark)
    if as_json:
        parts = [_content(table, group, one) for group, one in zip(groups, found, strict=True)]
        head = {"source": str(table_path), "by": list(words)}
        print_json({**head, "groups": parts} if words else {**head, **parts[0]})
        return
    for group, one in zip(groups, found, strict=True):
        print_table(group.label if words else table_path.name, _lines(table, group, one))
    if out is not None:
        say(f"written to {out}; use it with: evermap persist INPUT --model {out}")
    if figure is not None:
        say(f"drawn in {figure}")


def _keep(out: Path, groups: Sequence[Group], estimates: Sequence[Estimate]) -> None:
    """The priors as models of one stay."""
    import numpy as np

    from evermap.existence.one_stay import OneStay
    from evermap.runs.persist.modelfile import save_models
    from evermap.runs.persist.models import ModelOfEach

    models = tuple(OneStay(found.prior, found.text) for found in estimates)
    names = tuple(group.class_id or "" for group in groups)
    per = "all" if groups[0].class_id is None else "class"
    save_models(ModelOfEach(models, names, np.zeros(0, dtype=np.int64)), per, out)


def _draw(path: Path, groups: Sequence[Group], estimates: Sequence[Estimate]) -> None:
    from evermap.viz.survival_fit_figure import plot_survival

    write_picture(path, plot_survival({g.label: found.fitted for g, found in zip(groups, estimates, strict=True)}))


def _remarks(table: LifetimeTable, groups: Sequence[Group]) -> list[str]:
    """What a reader of the result must know."""
    import numpy as np

    endless = [g.label for g in groups if not np.isfinite(table.data.right_s[g.rows]).any()]
    return [f"{label}: nothing was seen to leave, so the estimate says that nothing ever does" for label in endless]


def _counts(table: LifetimeTable, group: Group) -> dict[str, Any]:
    """How many lifetimes there are of each sort."""
    import numpy as np

    left, right, entry = (getattr(table.data, name)[group.rows] for name in ("left_s", "right_s", "entry_s"))
    exact = left == right
    return {
        "samples": len(group.rows),
        "weight": float(table.data.weight[group.rows].sum()),
        "exact": int(exact.sum()),
        "intervals": int((np.isfinite(right) & ~exact).sum()),
        "never_seen_gone": int(np.isinf(right).sum()),
        "truncated": int((entry > 0.0).sum()),
    }


def _content(table: LifetimeTable, group: Group, found: Estimate) -> dict[str, Any]:
    """For `--json`."""
    who: dict[str, Any] = {}
    if group.class_id is not None:
        who["class_id"] = group.class_id
    if group.chunk is not None:
        who["chunk"] = list(group.chunk)
    return {
        **who,
        "estimator": found.estimator,
        **_counts(table, group),
        **found.numbers,
        **lifetime_numbers(found.prior),
        "prior": found.text,
    }


def _lines(table: LifetimeTable, group: Group, found: Estimate) -> list[tuple[str, str]]:
    """What a person wants to know."""
    counts = _counts(table, group)
    ends = f"{counts['exact']:,} watched, {counts['intervals']:,} between two looks"
    lines = [
        ("lifetimes", f"{counts['samples']:,}"),
        ("their ends", f"{ends}, {counts['never_seen_gone']:,} never seen"),
        ("estimator", found.estimator),
    ]
    if "loglik" in found.numbers:
        lines.append(("log likelihood", f"{found.numbers['loglik']:.6g}"))
    if len(found.text) < 80:
        lines.append(("prior", found.text))
    return [*lines, *lifetime_lines(lifetime_numbers(found.prior))]
