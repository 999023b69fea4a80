"""The `evermap` command: collects the verbs and turns every ending into one line and an exit code.

Exit codes: 0 fine, 2 the user's mistake (one line: what, where, what to try), 1 a defect of ours, 130 interrupted.
"""

from __future__ import annotations

import errno
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from evermap import __version__, interrupts, plugins
from evermap.cli import (
    audit,
    bench,
    check,
    convert,
    in_map,
    info,
    init,
    learn,
    live,
    moved,
    persist,
    reproduce,
    score,
    serve,
    slam,
    survival,
    together,
    track,
    view,
)
from evermap.cli import map as living_map
from evermap.cli.options import Verb, name_options, option
from evermap.cli.terminal import EXIT_USER, fail, say, warn
from evermap.errors import EvermapError, EvermapWarning

EXIT_DEFECT = 1
EXIT_INTERRUPTED = 130

_show_any_warning = warnings.showwarning

# The bases of what the command line library raises (it exports only the leaves).
_UsageError: Any = typer.BadParameter.__mro__[1]
_ClickException: Any = typer.BadParameter.__mro__[2]


class Verbs(TyperGroup):
    """The group of verbs, ours and those of other packages; the one place where exceptions end."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of all verbs, those of other packages first."""
        return [*plugins.found("evermap.verbs"), *super().list_commands(ctx)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return the command of a verb; None if there is none of this name."""
        return super().get_command(ctx, cmd_name) or reproduce.command("evermap.verbs", cmd_name)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that is to run, of a command line that may be in an old spelling."""

        def options_of(verb: str) -> Mapping[str, Any]:
            found = self
            for word in verb.split():
                found = found.get_command(ctx, word)
            return moved.options_of(found)

        tables = moved.MOVED
        group, words = ("evermap.studies", args[1:2]) if args[0] == "reproduce" else ("evermap.verbs", args[:1])
        if words and words[0] in plugins.found(group):  # options of it that its package has moved
            name = " ".join(args[:2] if args[0] == "reproduce" else args[:1])
            tables = {name: getattr(plugins.load(group, words[0]), "moved", {})}
        args, ctx.meta[moved.NOW] = moved.renew(args, options_of, tables)
        return super().resolve_command(ctx, args)

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Parse and run; a wrong command line is one line as any other mistake, not a paragraph."""
        kwargs["standalone_mode"] = False
        try:
            sys.exit(super().main(*args, **kwargs))
        except _ClickException as error:
            if type(error).__name__ == "NoArgsIsHelpError":  # `evermap` alone: its message is the help
                error.show()
                sys.exit(EXIT_USER)
            command = error.ctx.command_path if isinstance(error, _UsageError) and error.ctx else "evermap"
            fail(f"{' '.join(error.format_message().split()).rstrip('.')} (try: {command} --help)")
            sys.exit(EXIT_USER)

    def invoke(self, ctx: Any) -> Any:
        """Run the verb; every exception that we cause or can explain becomes a line on stderr and an exit code."""
        warnings.showwarning = _show_warning
        try:
            with _last_line(ctx):
                return super().invoke(ctx)
        except EvermapError as error:
            name_options(error, ctx)
            fail(error.one_line())
            raise typer.Exit(EXIT_USER) from None
        except KeyboardInterrupt as stop:
            say("interrupted: " + (str(stop) or "no result was written"))
            raise typer.Exit(EXIT_INTERRUPTED) from None
        except (_ClickException, typer.Exit, typer.Abort):
            raise
        except Exception as error:
            if isinstance(error, OSError) and error.errno == errno.EPIPE:  # `evermap ... | head`
                raise
            if ctx.params.get("debug"):
                raise
            fail(
                f"a bug in evermap, not a mistake of yours: {type(error).__name__}: {' '.join(str(error).split())} "
                "(please report it with the output of: evermap --debug ...)"
            )
            raise typer.Exit(EXIT_DEFECT) from None


@contextmanager
def _last_line(ctx: Any) -> Iterator[None]:
    """Name the new spelling of an old command line once it has run; an error stays one line."""
    try:
        yield
    except typer.Exit as end:
        if end.exit_code != EXIT_USER and (line := ctx.meta.get(moved.NOW)):
            say(line)
        raise
    if line := ctx.meta.get(moved.NOW):
        say(line)


app = typer.Typer(
    cls=Verbs,
    name="evermap",
    help="Landmark maps that stay true while the world changes.",
    epilog="Start with: evermap demo",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

app.command("init")(init.init)
app.command("check")(check.check)
app.command("info")(info.info)
app.command("slam", help=slam.HELP)(slam.slam)
app.command("localize", help=in_map.LOCALIZE)(in_map.localize)
app.command("together", help=together.HELP)(together.together)
app.command("audit", help=audit.HELP)(audit.audit)
app.command("live")(live.live)
app.command("play")(live.play)
app.command("persist", help=persist.HELP)(persist.persist)
app.command("track", help=track.HELP)(track.track)
app.command("view")(view.view)
app.command("convert")(convert.convert)
app.command("score", context_settings=score.PASSED_ON)(score.score)
app.add_typer(living_map.app)
app.add_typer(serve.app)
app.command("work")(serve.work)
app.command("learn", help=learn.HELP)(learn.learn)
app.add_typer(survival.app)
app.add_typer(reproduce.app)
app.command("bench")(bench.bench)


def _translate_errors(group: typer.Typer) -> None:
    """Let all commands, also those of sub-groups, speak of options where the core speaks of arguments."""
    for command in group.registered_commands:
        command.cls = Verb
    for below in group.registered_groups:
        assert below.typer_instance is not None
        _translate_errors(below.typer_instance)


_translate_errors(app)


def _show_warning(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
    """Our own in one line; those of libraries with the place in the code, as ever."""
    if issubclass(category, EvermapWarning):
        warn(str(message))
    else:
        _show_any_warning(message, category, *where, **more)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"evermap {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, option("--version", "Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
    debug: Annotated[bool, option("--debug", "Show the traceback of a bug.")] = False,
) -> None:
    """Take the options of all verbs; they are read in `Verbs.invoke`."""


def run() -> None:
    """Parse the command line, run it, and end this process."""
    interrupts.leave_on_signals()
    try:
        app(prog_name="evermap")
    except SystemExit as end:
        interrupts.ends_with(end.code if isinstance(end.code, int) else 0 if end.code is None else EXIT_DEFECT)
        raise
