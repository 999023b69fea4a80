"""`evermap survival learn`: how features come and go, learned from a table of looks and kept in a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evermap.cli.picture import check_picture, write_picture
from evermap.cli.terminal import print_json, print_table, progress_bar, say

if TYPE_CHECKING:
    from evermap.existence.choose import Choice
    from evermap.runs.persist.learning import LearnedModels


def learn(
    table_path: Annotated[
        Path, typer.Argument(metavar="INPUT", help="Table of looks, as `evermap persist` reads it.", show_default=False)
    ],
    out: Annotated[Path, typer.Option(help="File for the model.")] = Path("model.json"),
    figure: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Draw what the model foretells.", show_default="none")
    ] = None,
    recurrent: Annotated[
        str, typer.Option(metavar="KIND", help="Kind of model, as in `evermap persist --help`.")
    ] = "auto",
    per: Annotated[str, typer.Option(metavar="all|class|feature", help="Whose looks are put together.")] = "auto",
    p_miss: Annotated[float, typer.Option(help="P(no detection | there) where the table does not say.")] = 0.1,
    p_false: Annotated[float, typer.Option(help="P(detection | not there) where the table does not say.")] = 0.1,
    as_json: Annotated[bool, typer.Option("--json", help="Print what was learned as JSON.")] = False,
) -> None:
    """Learn how long things stay and stay away.

    From looks alone: no truth, no list of changes. Every kind of model is learned without the last part of the looks
    and asked to foretell it; the best is learned again from all of them.

    \b
    Example:
      evermap survival learn looks.csv --out model.json --figure model.png
      evermap persist tomorrow.csv --model model.json
    """
    if figure is not None:
        check_picture(figure, "--figure", inputs=[table_path])
    from evermap.runs.folder import check_output_file
    from evermap.runs.persist.learning import learn_models
    from evermap.runs.persist.modelfile import save_models
    from evermap.runs.persist.table import read_looks

    check_output_file(out, inputs=[table_path], ending=".json")
    table = read_looks(table_path, p_miss=p_miss, p_false=p_false)
    looks = table.looks(table.order())
    with progress_bar(f"{table_path.name}: learning", speed=False) as progress:
        tell = None if progress is None else lambda done: progress(done, 1.0)
        learned = learn_models(table, looks, recurrent, per, progress=tell)
    save_models(learned.models, learned.per, out)
    if figure is not None:
        from evermap.viz.presence_model_figure import plot_presence_models

        write_picture(figure, plot_presence_models(dict(zip(learned.models.names, learned.models.models, strict=True))))
    content = {"out": str(out), "per": learned.per, "models": _content(learned)}
    if as_json:
        print_json(content)
        return
    for name, choice in zip(learned.models.names, learned.choices, strict=True):
        print_table(name or table_path.name, _lines(choice))
    say(f"written to {out}; use it with: evermap persist INPUT --model {out}")


def _content(learned: LearnedModels) -> dict[str, Any]:
    """For `--json`."""
    return {
        name or "all": {"kind": choice.kind, "held_out_s": choice.held_out_s, "scores": dict(choice.scores)}
        for name, choice in zip(learned.models.names, learned.choices, strict=True)
    }


def _lines(choice: Choice) -> list[tuple[str, str]]:
    """What a person wants to know of a model."""
    import numpy as np

    from evermap.survival.durations import duration_text
    from evermap.viz.presence_model_figure import week_of_presence

    lines = [("kind", choice.kind)]
    if choice.scores:
        best = max(choice.scores.values())
        others = [f"{name} {score - best:.1f}" for name, score in choice.scores.items() if name != choice.kind]
        lines.append((f"log score of the others, last {duration_text(choice.held_out_s)}", ", ".join(others)))
    _, week = week_of_presence(choice.model)
    lines.append(("there on the whole", f"{100.0 * float(np.mean(week)):.1f} % of the time"))
    return lines
