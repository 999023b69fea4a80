"""Lifetime priors as text, for command lines and files, and as plain values, for JSON; both are read back exactly.

A form is a name and, after a colon, values: `exponential:half-life=2d`, `name:key=value,key=value`. Weighted forms are
added to a mixture: `0.3*exponential:half-life=1h + 0.7*never-leaves`. `FORMS` lists all of them with an example each.
What a map learns about a stated prior is written before it: `factors:0s=1.2,1d=0.8 of weibull:scale=2d,shape=0.7`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from evermap.errors import ConfigError, suggestion
from evermap.survival.base import LifetimePrior
from evermap.survival.durations import parse_duration_s, parse_hour, parse_number, parse_positive, parse_rate_hz
from evermap.survival.families import Exponential, Gamma, GeneralPurpose, LogNormal, Mixture, Uniform, Weibull
from evermap.survival.hazards import (
    PeriodicHazard,
    PiecewiseConstantHazard,
    ScaledHazard,
    StepLifetime,
    gone_daily,
    never_leaves,
)

Values = Mapping[str, Any]
Reader = Callable[[str], Any]
_FACTORS, _OF = "factors:", " of "


@dataclass(frozen=True, slots=True)
class Form:
    """One way to write a prior.

    Attributes:
        example: text that `parse_prior` takes.
        meaning: half a line for people.
        build: makes the prior from the values.
        needed: required keys, with the reader of each.
        optional: keys that may be given.
        bare: key whose value stands alone, without `key=`.
        series: what further keys give: 'rates' from a time on, 'shares' that leave at a time, in a span or `never`.
    """

    example: str
    meaning: str
    build: Callable[[Values], LifetimePrior]
    needed: Mapping[str, Reader] = field(default_factory=dict)
    optional: Mapping[str, Reader] = field(default_factory=dict)
    bare: str | None = None
    series: str = ""

    @property
    def keys(self) -> dict[str, Reader]:
        """Return all keys with their readers."""
        return {**self.needed, **self.optional}


def parse_prior(text: str) -> LifetimePrior:
    """Read a prior from text.

    Args:
        text: a form of `FORMS`, or weighted forms added: `0.3*exponential:half-life=1h + 0.7*never-leaves`.

    Raises:
        ConfigError: says in one line which part is wrong, and the nearest known word.
    """
    factors, of, rest = text.partition(_OF)
    if of and factors.strip().startswith(_FACTORS):
        return _parse_factors(factors.strip().removeprefix(_FACTORS), parse_prior(rest))
    try:
        parts = [part.strip() for part in re.split(r"(?<![0-9][eE])\+", text)]
        if not all(parts):
            raise ConfigError("empty" if len(parts) == 1 else "a part of the sum is empty", hint="never-leaves")
        if len(parts) == 1 and "*" not in text:
            return _parse_form(text.strip())
        return _parse_mixture(parts)
    except ConfigError as error:
        about = f"{error.field}: " if error.field else ""
        raise ConfigError(f"prior '{text}': {about}{error.problem}", hint=error.hint) from None


def _parse_factors(text: str, prior: LifetimePrior) -> ScaledHazard:
    """Read factors of a hazard by age."""
    steps = [item.partition("=") for item in text.split(",")]
    edges_s = tuple(_time_s(edge.strip()) for edge, _, _ in steps)
    return ScaledHazard(prior, edges_s, tuple(parse_number(factor) for _, _, factor in steps))


def _parse_mixture(parts: Iterable[str]) -> Mixture:
    weights, priors = [], []
    for part in parts:
        weight, star, form = part.partition("*")
        if not star:
            raise ConfigError(f"no weight in '{part}'", hint=f"0.5*{part}")
        weights.append(parse_number(weight))
        priors.append(_parse_form(form.strip()))
    if abs(sum(weights) - 1.0) > 1e-6:
        raise ConfigError(f"the weights sum to {sum(weights):g}", hint="weights that sum to 1")
    return Mixture.of(priors, weights)


def _parse_form(text: str) -> LifetimePrior:
    name, _, body = text.partition(":")
    form = FORMS.get(name.strip())
    if form is None:
        raise ConfigError(f"unknown lifetime '{name}'", hint=suggestion(name.lower(), FORMS))
    values: dict[str, Any] = {}
    series: list[tuple[float, ...]] = []
    for entry in filter(None, (item.strip() for item in body.split(","))):
        key, equals, value = (item.strip() for item in entry.partition("="))
        if not equals and form.bare is not None:
            key, value = form.bare, entry
        elif not equals:
            raise ConfigError(f"'{entry}' is not of the form key=value", hint=form.example)
        if key in values:
            raise ConfigError("given twice", field=key)
        if key in form.keys:
            values[key] = _read(form.keys[key], key, value)
        elif form.series == "rates" and key[:1].isdigit():
            series.append((_time_s(key), _read(parse_rate_hz, key, value)))
        elif form.series == "shares" and (key[:1].isdigit() or key == "never"):
            series.append((*_span_s(key), _read(parse_number, key, value)))
        else:
            raise ConfigError(
                f"{name} has no '{key}'", hint=suggestion(key.lower(), form.keys) if form.keys else form.example
            )
    missing = [key for key in form.needed if key not in values]
    if missing or (form.series and not series):
        raise ConfigError(f"needs {missing[0] if missing else form.series}", hint=form.example)
    if form.series == "rates" and series[0][0] > 0.0:
        raise ConfigError("the first rate must start at 0", hint=form.example)
    columns = {"rates": ("edges_s", "rates"), "shares": ("starts_s", "ends_s", "masses"), "": ()}[form.series]
    return form.build(values | dict(zip(columns, zip(*series, strict=True), strict=True)))


def _time_s(text: str) -> float:
    """Read a duration, which may be 0."""
    return 0.0 if re.fullmatch(r"0(\.0)?[a-z]*", text) else parse_duration_s(text)


def _span_s(text: str) -> tuple[float, float]:
    """Read start and end of `1h..2h`, of `never`, or of a single time."""
    if text == "never":
        return math.inf, math.inf
    start, dots, end = text.partition("..")
    return _time_s(start), _time_s(end) if dots else _time_s(start)


def _read(reader: Reader, key: str, value: str) -> Any:
    try:
        return reader(value)
    except ConfigError as error:
        raise ConfigError(error.problem, field=error.field or key, hint=error.hint) from None


def _between(reader: Reader) -> Reader:
    """Return a reader of `from..to`."""

    def read(text: str) -> tuple[Any, Any]:
        low, dots, high = text.partition("..")
        if not dots:
            raise ConfigError(f"'{text}' is not a range", hint="two values with two dots between them")
        return reader(low), reader(high)

    return read


def _exponential(values: Values) -> Exponential:
    if len(values) != 1:
        raise ConfigError("needs one of half-life, mean and rate", hint=FORMS["exponential"].example)
    if "half-life" in values:
        return Exponential.from_half_life(values["half-life"])
    return Exponential.from_mean(values["mean"]) if "mean" in values else Exponential(values["rate"])


def _unknown(values: Values) -> GeneralPurpose:
    shortest_s, longest_s = values["mean stays"]
    if not shortest_s < longest_s:
        raise ConfigError("the shorter mean stay comes first", hint=FORMS["unknown"].example)
    return GeneralPurpose.from_mean_stays(shortest_s, longest_s)


def _daily(key: str, usual: tuple[float, float]) -> Callable[[Values], PeriodicHazard]:
    return lambda v: gone_daily(v["p"], first_seen_hour=v["seen"], hours=v.get(key, usual))


FORMS: Mapping[str, Form] = {
    "exponential": Form(
        "exponential:half-life=2d",
        "half are gone after 2 days; or mean=3d, or rate=0.5/d",
        _exponential,
        optional={"half-life": parse_duration_s, "mean": parse_duration_s, "rate": parse_rate_hz},
    ),
    "unknown": Form(
        "unknown:1h..30d",
        "the mean stay is unknown, between 1 hour and 30 days",
        _unknown,
        needed={"mean stays": _between(parse_duration_s)},
        bare="mean stays",
    ),
    "general-purpose": Form(
        "general-purpose:low=0.001/s,high=1/s",
        "the same by its rates, as in Rosen 2016",
        lambda v: GeneralPurpose(v["low"], v["high"]),
        needed={"low": parse_rate_hz, "high": parse_rate_hz},
    ),
    "uniform": Form(
        "uniform:limit=3d",
        "any stay up to 3 days, none longer",
        lambda v: Uniform(v["limit"]),
        needed={"limit": parse_duration_s},
    ),
    "weibull": Form(
        "weibull:scale=2d,shape=0.7",
        "shape < 1: the hazard falls with age; > 1: it rises",
        lambda v: Weibull(v["scale"], v["shape"]),
        needed={"scale": parse_duration_s, "shape": parse_positive},
    ),
    "lognormal": Form(
        "lognormal:median=2d,spread=1.5",
        "half are gone after 2 days, the logarithms spread by 1.5",
        lambda v: LogNormal.from_half_life(v["median"], v["spread"]),
        needed={"median": parse_duration_s, "spread": parse_positive},
    ),
    "gamma": Form(
        "gamma:scale=2d,shape=2",
        "two exponential stages of 2 days one after the other",
        lambda v: Gamma(v["scale"], v["shape"]),
        needed={"scale": parse_duration_s, "shape": parse_positive},
    ),
    "never-leaves": Form("never-leaves", "walls", lambda _: never_leaves()),
    "gone-overnight": Form(
        "gone-overnight:p=0.3,seen=10:00,night=20:00..6:00",
        "a night takes 30 %, a day nothing; first seen at 10:00",
        _daily("night", (20.0, 6.0)),
        needed={"p": parse_number, "seen": parse_hour},
        optional={"night": _between(parse_hour)},
    ),
    "gone-by-day": Form(
        "gone-by-day:p=0.3,seen=10:00,day=8:00..18:00",
        "a day takes 30 %, a night nothing",
        _daily("day", (8.0, 18.0)),
        needed={"p": parse_number, "seen": parse_hour},
        optional={"day": _between(parse_hour)},
    ),
    "hazard": Form(
        "hazard:0s=1/d,3d=0.01/d",
        "a rate of 1 a day for 3 days, then 0.01 a day",
        lambda v: PiecewiseConstantHazard(v["edges_s"], v["rates"]),
        series="rates",
    ),
    "mass": Form(
        "mass:0s..1h=0.3,2d=0.5,never=0.2",
        "30 % leave within the first hour, 50 % after just 2 days",
        lambda v: StepLifetime(v["starts_s"], v["ends_s"], v["masses"]),
        series="shares",
    ),
    "periodic": Form(
        "periodic:period=1w,0s=0.2/d,5d=0/d,start=2d",
        "a rate that repeats, here 5 days a week; first seen on day 2",
        lambda v: PeriodicHazard(v["period"], v["edges_s"], v["rates"], start_s=v.get("start", 0.0)),
        needed={"period": parse_duration_s},
        optional={"start": parse_duration_s},
        series="rates",
    ),
}
"""All forms, by name."""


def prior_text(prior: LifetimePrior) -> str:
    """Write a prior as text, in seconds and with all digits, for `parse_prior`; ConfigError if it has no form."""
    match prior:
        case Exponential():
            return f"exponential:rate={prior.rate!r}/s"
        case Weibull():
            return f"weibull:scale={prior.scale_s!r}s,shape={prior.shape!r}"
        case LogNormal():
            return f"lognormal:median={math.exp(prior.mu)!r}s,spread={prior.sigma!r}"
        case Gamma():
            return f"gamma:scale={prior.scale_s!r}s,shape={prior.shape!r}"
        case Uniform():
            return f"uniform:limit={prior.limit_s!r}s"
        case GeneralPurpose():
            return f"general-purpose:low={prior.low!r}/s,high={prior.high!r}/s"
        case PiecewiseConstantHazard():
            steps = zip(prior.edges_s, prior.rates, strict=True)
            return "hazard:" + ",".join(f"{float(edge)!r}s={float(rate)!r}/s" for edge, rate in steps)
        case ScaledHazard():
            steps = zip(prior.edges_s, prior.factors, strict=True)
            learned = ",".join(f"{float(edge)!r}s={float(factor)!r}" for edge, factor in steps)
            return f"{_FACTORS}{learned}{_OF}{prior_text(prior.prior)}"
        case StepLifetime():
            return "mass:" + ",".join(_shares(prior))
        case Mixture():
            parts = zip(prior.weights, prior.components, strict=True)
            return "+".join(f"{float(weight)!r}*{prior_text(part)}" for weight, part in parts)
    raise ConfigError(f"a {type(prior).__name__} cannot be written as text", field="prior")


def _shares(prior: StepLifetime) -> list[str]:
    """Return `when=share` for every mass; those of equal points, of equal spans and of `never` are added."""
    total: dict[str, float] = {}
    for start, end, mass in zip(prior.starts_s, prior.ends_s, prior.masses, strict=True):
        when = "never" if math.isinf(end) else f"{end!r}s" if start == end else f"{start!r}s..{end!r}s"
        total[when] = total.get(when, 0.0) + mass
    return [f"{when}={mass!r}" for when, mass in total.items()]


CLASSES: Mapping[str, type[Any]] = {
    kind.__name__: kind
    for kind in (
        Exponential, Gamma, GeneralPurpose, LogNormal, Mixture, PeriodicHazard, PiecewiseConstantHazard,
        ScaledHazard, StepLifetime, Uniform, Weibull,
    )
}  # fmt: skip
"""Models that consist of numbers, by name: all but a hazard that is a function of the user's."""


def prior_to_dict(prior: LifetimePrior) -> dict[str, Any]:
    """Return `{"lifetime": name, field: value, ...}` of JSON's own types; infinity is the word 'inf'.

    Raises:
        ConfigError: the prior does not consist of numbers.
    """
    name = type(prior).__name__
    if CLASSES.get(name) is not type(prior):
        raise ConfigError(f"{name} cannot be written down", field="prior", hint=f"one of {', '.join(CLASSES)}")
    values: Any = prior
    return {"lifetime": name} | {item.name: _plain(getattr(values, item.name)) for item in fields(values)}


def prior_from_dict(content: Mapping[str, Any]) -> LifetimePrior:
    """Read a prior that `prior_to_dict` wrote; ConfigError for unknown or missing fields, or invalid values."""
    kind = CLASSES.get(str(content.get("lifetime")))
    if kind is None:
        raise ConfigError(f"unknown lifetime {content.get('lifetime')!r}", field="lifetime", hint=", ".join(CLASSES))
    known = {item.name for item in fields(kind)}
    for name in sorted(known ^ (content.keys() - {"lifetime"})):
        problem = "is missing" if name in known else f"unknown field of {kind.__name__}"
        raise ConfigError(problem, field=name)
    try:
        prior: LifetimePrior = kind(**{name: _value(content[name]) for name in known})
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ConfigError(f"is not what is expected: {error}", field=kind.__name__) from error
    return prior


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float | int):
        return "inf" if value == float("inf") else float(value)
    return prior_to_dict(value)


def _value(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_value(item) for item in value)
    return prior_from_dict(value) if isinstance(value, Mapping) else float(value)
