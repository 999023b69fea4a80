"""`evermap survival`: how long features stay, as words, numbers and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from evermap.cli.fit import fit
from evermap.cli.learn import learn
from evermap.cli.lifetime_numbers import lifetime_lines, lifetime_numbers
from evermap.cli.picture import check_picture, write_picture
from evermap.cli.terminal import print_json, print_table, say
from evermap.errors import ConfigError

app = typer.Typer(name="survival", help="How long features stay.", no_args_is_help=True, rich_markup_mode=None)
app.command("fit")(fit)
app.command("learn")(learn)


@app.command("plot")
def plot(
    priors: Annotated[list[str], typer.Argument(metavar="PRIOR...", help="Lifetimes, written as below.")],
    out: Annotated[Path, typer.Option(help="Figure to write, .png or .svg.")] = Path("lifetimes.png"),
    until: Annotated[
        str | None, typer.Option(help="End of the time axis, as 30d.", show_default="when nearly all have left")
    ] = None,
    log_time: Annotated[
        bool | None,
        typer.Option("--log/--linear", help="Axis of time.", show_default="by the span of the lifetimes"),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the numbers as JSON.")] = False,
) -> None:
    """Draw lifetime priors in four views.

    The views are hazard, cumulative hazard, survival and density over the time since a feature was first seen.
    Durations have a unit (us, ms, s, min, h, d, w, y), rates are per such a unit, shares are below 1.

    \b
    A prior is one of:
      exponential:half-life=2d                            half are gone after 2 days; or mean=3d, or rate=0.5/d
      unknown:1h..30d                                     the mean stay is unknown, between 1 hour and 30 days
      general-purpose:low=0.001/s,high=1/s                the same by its rates, as in Rosen 2016
      uniform:limit=3d                                    any stay up to 3 days, none longer
      weibull:scale=2d,shape=0.7                          shape < 1: what has stayed stays longer; > 1: it wears out
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
    from evermap.survival.durations import parse_duration_s
    from evermap.survival.text import parse_prior
    from evermap.viz.lifetime_figure import plot as draw

    check_picture(out, "--out")
    named = {text: parse_prior(text) for text in priors}
    try:
        until_s = None if until is None else parse_duration_s(until)
    except ConfigError as error:
        raise ConfigError(error.problem, field="--until", hint=error.hint) from None
    write_picture(out, draw(named, until_s=until_s, log_time=log_time))
    rows = {name: lifetime_numbers(prior) for name, prior in named.items()}
    if as_json:
        print_json({"out": str(out), "priors": rows})
        return
    for name, numbers in rows.items():
        print_table(name, lifetime_lines(numbers))
    say(f"drawn in {out}")
