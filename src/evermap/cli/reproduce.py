"""`evermap reproduce`: the tables of the documents, computed again by the package evermap-studies."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperGroup

from evermap import plugins
from evermap.cli.options import Verb
from evermap.errors import ConfigError, suggestion


class Studies(TyperGroup):
    """The group of studies; those of installed packages, loaded when they are asked for."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the studies that are installed."""
        del ctx
        return list(plugins.found("evermap.studies"))

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Load a study's command.

        Raises:
            ConfigError: no study has this name.
        """
        del ctx
        found = plugins.found("evermap.studies")
        if found and cmd_name not in found:
            raise ConfigError(f"unknown study '{cmd_name}'", hint=suggestion(cmd_name, found))
        return command("evermap.studies", cmd_name)


def command(group: str, name: str) -> Any:
    """Return the command that another package brings under a name, or None.

    Args:
        group: of entry points, 'evermap.studies' or 'evermap.verbs'.
        name: of the command.
    """
    if name not in plugins.found(group):
        return None
    app = typer.Typer(rich_markup_mode=None, add_completion=False)
    app.command(name, cls=Verb)(plugins.load(group, name))
    return typer.main.get_command(app)


app = typer.Typer(cls=Studies, name="reproduce", no_args_is_help=True, rich_markup_mode=None)


@app.callback()
def reproduce() -> None:
    """Compute the tables of the documents again.

    \b
    Example:
      evermap reproduce rosen2016 --seed 1
      evermap reproduce partial-views --help
    """
    if not plugins.found("evermap.studies"):
        plugins.load("evermap.studies", "reproduce")
