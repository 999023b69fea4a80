"""`evermap score`: maps that change against their truth, by the package evermap-score."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from evermap.cli.options import argument
from evermap.errors import ConfigError, MissingExtraError

HINT = "pip install evermap-score, or from a clone: pip install ./packages/evermap-score"
PASSED_ON: dict[str, Any] = {"ignore_unknown_options": True, "help_option_names": []}
"""All options are those of that package, `--help` too."""


def score(
    arguments: Annotated[list[str] | None, argument("As of evermap-score.", metavar="TRUTH ESTIMATE...")] = None,
) -> None:
    """Score maps that change against the truth.

    All arguments are those of evermap-score.

    \b
    Examples:
      evermap score truth.csv out/monday
      evermap score truth.csv ours.csv theirs.csv --looks looks.csv --markdown
      evermap score --help
    """
    try:
        from evermap_score import cli
        from evermap_score.errors import ScoreError
    except ModuleNotFoundError as missing:
        if missing.name is None or missing.name.partition(".")[0] != "evermap_score":
            raise
        raise MissingExtraError("evermap score needs the package evermap-score", hint=HINT) from None
    try:
        cli.main(arguments or [], program="evermap score")
    except ScoreError as error:
        raise ConfigError(str(error)) from None
    except SystemExit as end:  # after --help
        raise typer.Exit(end.code if isinstance(end.code, int) else 0) from None
