"""Common parts of the verbs: options, the configuration, and errors that name options instead of arguments."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from evermap.cli.terminal import remark_as
from evermap.errors import ConfigError, EvermapError

if TYPE_CHECKING:
    from evermap.config import Config


def option(*texts: str, default: bool | str = True, **how: Any) -> Any:
    """Describe an option of a verb: its names, where they are not those of the argument, and its help.

    Args:
        texts: names, then the help.
        default: shown as the default; False for none.
        how: as of `typer.Option`.
    """
    *names, help_text = texts
    return typer.Option(*names, help=help_text, show_default=default, **how)


def argument(help_text: str, *, default: bool | str = True, **how: Any) -> Any:
    """Describe an argument of a verb; as `option`."""
    return typer.Argument(help=help_text, show_default=default, **how)


MOST_WORKERS = 1024
"""Of one command on one machine."""
DEFAULT_STORE, STORE_VARIABLE = "evermap-maps", "EVERMAP_STORE"
"""Store of a server where none is named, and the environment variable that names another."""

ConfigFile = Annotated[
    Path | None, option("--config", "TOML file; see slam --show-config.", metavar="FILE", default=False)
]
Settings = Annotated[
    list[str] | None, option("--set", "Override one setting, as section.key=value; repeatable.", metavar="KEY=VALUE")
]
ShowConfig = Annotated[bool, option("--show-config", "Print the configuration in force as commented TOML and exit.")]
AsJson = Annotated[bool, option("--json", "Print the summary as JSON.")]
ResultAsJson = Annotated[bool, option("--json", "Print as JSON.")]
MapFile = Annotated[str, argument("The map, as `evermap map enter` writes it.", metavar="FILE")]
AtRevision = Annotated[int | None, option("--revision", "Use this revision.", metavar="N", default="newest")]
Force = Annotated[bool, option("--force", "Write into --out even if it holds other files; these are kept.")]
UnknownIds = Annotated[
    bool, option("--unknown-ids", "Ignore the landmark ids of the detections; associate by geometry.")
]
Robot = Annotated[int | None, option("Robot of a recording that has several.", default=False)]
Topics = Annotated[
    Path | None, option("Settings file of the topics, as `evermap init bag` writes it.", metavar="FILE", default=False)
]
TableOut = Annotated[Path | None, option("Folder for the results.", default="evermap-out/<input>")]
Workers = Annotated[
    str | None,
    option(
        "Processes here, of which 1 needs no Dask; or the Dask scheduler whose workers do it.",
        metavar="NUMBER|tcp://HOST:PORT",
        default="one per core, if Dask is installed",
    ),
]
Priors = Annotated[
    list[str] | None,
    option(
        "Prior of the lifetimes, as in `evermap survival plot --help`; repeatable for classes.",
        metavar="[CLASS=]PRIOR",
        default="unknown:1min..10y",
    ),
]

_OTHER_NAMES = {"class_priors": "prior", "cluster": "workers", "living": "map_file"}
"""Arguments of the core whose option has another name."""


def workers_of(text: str | None) -> tuple[int | None, str | None]:
    """Return the number of processes of `--workers`, or the address of a cluster.

    Raises:
        ConfigError: no process, too many, or neither a number nor an address.
    """
    if text is None or ":" in text:
        return None, text
    try:
        count = int(text)
    except ValueError:
        count = 0
    if not 1 <= count <= MOST_WORKERS:
        raise ConfigError(f"'{text}' is no number of processes", field="workers",
                          hint=f"1 to {MOST_WORKERS}, or tcp://HOST:PORT of a Dask scheduler")  # fmt: skip
    return count, None


def configure(
    path: Path | None,
    settings: Sequence[str] | None,
    values: Mapping[str, Any] | None = None,
    *,
    within: str = "",
    also: Sequence[str] = (),
    show: bool = False,
) -> Config:
    """Return the configuration of `--config`, `--set` and single options; where asked to, print it and exit.

    Args:
        path: TOML file.
        settings: `section.key=value` each.
        values: what other options say, by key; None where an option was not given.
        within: section that keys without a dot are of; others but it and `also` are not read.
        also: further sections that the command reads, or keys, as 'output.rerun'.
        show: print the configuration and exit.

    Raises:
        ConfigError: an unknown key, one that the command does not read, or a value out of its bounds.
    """
    from evermap.config import Config, load_config, refuse_unread, to_toml

    config = load_config(path, settings or [], values, within=within)
    reads = {within.partition(".")[0], *also}
    parts = {one.partition(".")[0] for one in also if "." in one}  # of a section some keys are read
    unread = [
        *(name for name in Config.model_fields if name not in reads | parts),
        *(
            f"{name}.{one}"
            for name in parts
            for one in type(getattr(config, name)).model_fields
            if f"{name}.{one}" not in reads
        ),
    ]
    refuse_unread(settings or [], {"by this command": unread if within else []}, within=within)
    if show:
        typer.echo(to_toml(config), nl=False)
        raise typer.Exit
    return config


def refuse_given(problem: str, hint: str, **given: object) -> None:
    """Refuse options that would be ignored: those that are neither None nor empty."""
    for field, value in given.items():
        if value is not None and value != []:
            raise ConfigError(problem, field=field, hint=hint)


def priors_by_class(texts: Sequence[str] | None) -> tuple[str | None, dict[str, str] | None]:
    """Return the prior without a class and those of classes, of `PRIOR` and `door=exponential:half-life=2d`.

    Raises:
        ConfigError: the same class twice.
    """
    common: str | None = None
    by_class: dict[str, str] = {}
    for text in texts or []:
        found = re.fullmatch(r"\s*([^:=*]+?)\s*=(.+)", text)  # in a prior, a colon or a star comes before any '='
        name = found[1] if found else ""
        if (name in by_class) if found else (common is not None):
            whose = f"class '{name}'" if found else "all features"
            raise ConfigError(f"given twice for {whose}", field="prior", hint="CLASS=PRIOR for a single class")
        if found:
            by_class[name] = found[2].strip()
        else:
            common = text.strip()
    return common, by_class or None


def duration_s(text: str | None, field: str) -> float | None:
    """Return the seconds of a duration like 3d, None for None; a ConfigError names `field`."""
    from evermap.survival.durations import parse_duration_s

    try:
        return None if text is None else parse_duration_s(text)
    except ConfigError as error:
        raise ConfigError(error.problem, field=field, hint=error.hint) from None


@contextmanager
def database_errors() -> Iterator[None]:
    """Make an error of a database that cannot be used one of `--store`."""
    from sqlalchemy.exc import DBAPIError

    try:
        yield
    except DBAPIError as error:
        hint = "check the address, the rights of the user, and that the server runs"
        raise ConfigError(f"the database cannot be used: {error.orig}", field="store", hint=hint) from None


def default_out(name: str) -> Path:
    """Return `evermap-out/mrclam_dataset6-robot-1` for 'MRCLAM_Dataset6 robot 1', and `evermap-out/looks` for
    'looks.csv.gz'.
    """
    name = re.sub(r"(\.csv|\.gz|\.parquet)+$", "", name.lower())
    return Path("evermap-out") / (re.sub(r"[^a-z0-9_.]+", "-", name).strip("-.") or "run")


class _SpeaksOfOptions:
    """Mixin of commands and groups whose errors and remarks name options instead of the core's arguments."""

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        """Return the context of the command, which is from now on the one that errors and remarks are told in."""
        ctx = super().make_context(*args, **kwargs)  # type: ignore[misc]
        remark_as.set(lambda text: with_options(text, ctx))
        ctx.meta[TOLD_IN] = ctx
        return ctx


TOLD_IN = "evermap.verb"
"""Key of the context of the innermost command, in what all contexts share."""


def name_options(error: EvermapError, ctx: Any) -> None:
    """Let an error name options of the command that raised it instead of the core's arguments."""
    verb = ctx.meta.get(TOLD_IN)
    if verb is None:
        return
    error.problem = with_options(error.problem, verb)
    error.hint = error.hint and with_options(error.hint, verb)
    if error.line is None:  # in a line of a file it is a column or a key
        error.field = error.field and (_option(error.field, verb) or error.field)


class Verb(_SpeaksOfOptions, TyperCommand):
    """A command whose errors and remarks name options."""


class VerbGroup(_SpeaksOfOptions, TyperGroup):
    """A group that is a command itself."""


def with_options(text: str, ctx: Any) -> str:
    """Return a text with the options of a command instead of the arguments in `backquotes`."""
    return re.sub(r"`([a-z0-9_.]+)`", lambda found: _option(found[1], ctx) or found[0], text)


def _option(name: str, ctx: Any) -> str | None:
    """Return the option of an argument of the core; None if it has none.

    An argument `step_s` is the option whose parameter is called so; a configuration key `persist.step_s` is, too, if
    that option was given.
    """
    shown = {param.name: _name_parameter(param) for param in ctx.command.params}
    shown |= {name: shown[other] for name, other in _OTHER_NAMES.items() if other in shown}
    leaf = name.rpartition(".")[2]
    if leaf != name and "COMMANDLINE" not in str(ctx.get_parameter_source(_OTHER_NAMES.get(leaf, leaf))):
        return None
    return shown.get(leaf)


def _name_parameter(param: Any) -> str:
    """Return how a parameter is called on the command line: its longest option, or the name of an argument."""
    return str(max(param.opts, key=len) if param.param_type_name == "option" else param.metavar or param.name.upper())
