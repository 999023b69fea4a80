"""`evermap map`: the history of a living map: what changed, why, and back."""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evermap.cli.map_edits import AsJson, MapFile, delete, gc, pin, revert, undelete, unpin, verify
from evermap.cli.terminal import check_picture, echo, print_json, print_table, say, write_picture
from evermap.errors import ConfigError

if TYPE_CHECKING:
    from evermap.maps.living import LivingMap

app = typer.Typer(
    name="map",
    help="Living maps: history, differences, reasons, orders.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

_AtRevision = Annotated[
    int | None, typer.Option("--revision", metavar="N", help="Look at this one.", show_default="newest")
]


@app.command("log")
def log(file: MapFile, as_json: AsJson = False) -> None:
    """List the revisions.

    Every session, edit and revert, with what it changed.

    \b
    Example:
      evermap map log site.evermap
    """
    from evermap.cli.map_content import revision_dict, revision_row
    from evermap.maps.store import open_store

    with open_store(file) as store:
        revisions = store.log()
        clock = store.load().clock
    if as_json:
        print_json(
            {
                "map": file,
                "head": revisions[-1].number if revisions else 0,
                "clock": clock.value,
                "revisions": [*map(revision_dict, revisions)],
            }
        )
        return
    head = ("revision", "written (UTC)", "kind", "of", "starts", "landmarks", "changes", "took")
    print_table(file, [revision_row(item, clock) for item in revisions], head, numbers=(0, 7))


@app.command("show")
def show(
    file: MapFile,
    revision: _AtRevision = None,
    ahead: Annotated[str, typer.Option(help="How far to look ahead, as 12h or 3d.")] = "1d",
    everything: Annotated[bool, typer.Option("--all", help="List what is believed gone, too.")] = False,
    figure: Annotated[Path | None, typer.Option(metavar="FILE.png", help="Draw the map.", show_default="none")] = None,
    as_json: AsJson = False,
) -> None:
    """List the landmarks.

    Whether they exist, where, since when, and whether they will be there tomorrow.

    \b
    Example:
      evermap map show site.evermap --ahead 3d --figure map.png
    """
    from evermap.cli.map_content import landmark_dicts, landmark_row, life_dicts, prior_dicts
    from evermap.maps.store import open_store
    from evermap.stamps import stamp_text
    from evermap.survival.durations import parse_duration_s
    from evermap.types import json_number

    ahead_s = parse_duration_s(ahead)
    if figure is not None:
        check_picture(figure, "--figure", inputs=[file])
    with open_store(file) as store:
        number = store.head() if revision is None else revision
        living = store.load(number)
    content = landmark_dicts(living, living.p_exists(living.stamp_s + ahead_s))
    if figure is not None:
        write_picture(figure, living.plot(title=f"{Path(file).name}, revision {number}"))
    if as_json:
        about = {"map": file, "revision": number, "stamp_s": json_number(living.stamp_s), "clock": living.clock.value}
        told = {"priors": prior_dicts(living), "lifetimes": life_dicts(living)}
        print_json({**about, "ahead_s": ahead_s, "landmarks": content, **told})
        return
    listed = [
        item for item in content if everything or item["pinned"] or (item["p_exists"] >= 0.5 and not item["deleted"])
    ]
    head = ("landmark", "class", "P(exists)", f"in {ahead}", "place [m]", "+-", "since", "last seen", "sites", "")
    title = f"{file}, revision {number}, seen until {stamp_text(living.stamp_s, living.clock)}"
    print_table(title, [landmark_row(item, living.clock) for item in listed], head, numbers=(0, 2, 3, 5, 8))
    for said in prior_dicts(living):
        of = f"of class {said['class']}" if said["class"] else "of all other classes"
        away = f", absences {said['absence']}" if said["absence"] else ""
        echo(f"lifetimes {of} start from {said['stay']}{away}, worth {said['worth_stays']} stays")
    if len(listed) < len(content):
        say(f"{len(content) - len(listed)} more are believed gone or deleted; --all lists them")


@app.command("diff")
def diff(
    file: MapFile,
    a: Annotated[int, typer.Argument(metavar="A", help="The earlier revision; 0 is the empty map.")],
    b: Annotated[int | None, typer.Argument(metavar="B", help="The later one.", show_default="newest")] = None,
    as_json: AsJson = False,
) -> None:
    """Tell what changed between two revisions.

    What appeared, vanished, moved, swapped places and returned, by how much the map grew, and what operators did.

    \b
    Example:
      evermap map diff site.evermap 3 7
    """
    from evermap.cli.map_content import change_line
    from evermap.maps.diff import diff as between
    from evermap.maps.store import open_store
    from evermap.runs.summary import change_dict
    from evermap.viz.change_words import grew

    with open_store(file) as store:
        found = between(store, a, b)
        new = store.load(found.b)
    if as_json:
        told = {"changes": [*map(change_dict, found.changes)], "grown": found.grown.tolist()}
        edited = [{"landmark": name, "what": word} for name, word in found.edits]
        print_json({"map": file, "a": found.a, "b": found.b, **told, "edits": edited})
        return
    lines = [change_line(change, new.clock) for change in found.changes]
    lines += grew(len(found.grown), [*map(new.label, found.grown.tolist())])
    lines += [f"landmark {new.label(name)} {word} by an operator" for name, word in found.edits]
    for line in lines:
        echo(line)
    if not lines:
        say(f"no difference between revisions {found.a} and {found.b}")


@app.command("export")
def export(
    file: MapFile,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Where to write the landmarks: .parquet, .geojson, .csv, or .yaml for an occupancy grid.",
            show_default=False,
        ),
    ] = None,
    lifetimes: Annotated[
        Path | None,
        typer.Option(metavar="FILE.json", help="Where to write how long things stay, by class.", show_default=False),
    ] = None,
    revision: _AtRevision = None,
    p_least: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Leave out what exists with a smaller probability.")
    ] = 0.5,
    cell_m: Annotated[float, typer.Option(min=1e-3, max=1e3, help="Edge of a cell of the grid [m].")] = 0.05,
    radius_m: Annotated[float, typer.Option(min=0.0, max=1e3, help="Radius around a landmark in the grid [m].")] = 0.25,
    as_json: AsJson = False,
) -> None:
    """Write existing landmarks, or learned lifetimes, to a file.

    For other tools, for `evermap slam --prior-map`, for `--prior` of another map, and as a mask for filters of Nav2.

    \b
    Examples:
      evermap map export site.evermap --out map.geojson
      evermap map export site.evermap --lifetimes lifetimes.json
      evermap map export site.evermap --out keepout.yaml --p-least 0.1
    """
    from evermap.maps.store import open_store
    from evermap.runs.folder import check_output_file

    if out is None and lifetimes is None:
        raise ConfigError("nothing to write", field="--out", hint="--out map.geojson, or --lifetimes lifetimes.json")
    write = None if out is None else _writer(out, cell_m, radius_m)
    for path in (out, lifetimes):
        if path is not None:
            check_output_file(path, inputs=[file], ending=".json" if path is lifetimes else "")
    with open_store(file) as store:
        number = store.head() if revision is None else revision
        living = store.load(number)
    landmarks = living.landmarks(p_least=p_least)
    if write is not None:
        write(landmarks, out)
    classes = [] if lifetimes is None else _write_lifetimes(living, lifetimes)
    if as_json:
        told = {"out": None if out is None else str(out), "landmarks": len(landmarks)}
        said = {"lifetimes": None if lifetimes is None else str(lifetimes), "classes": classes}
        print_json({"map": file, "revision": number, **told, **said})
        return
    if out is not None:
        say(f"wrote {len(landmarks)} landmarks of revision {number} to {out}")
    if lifetimes is not None:
        say(f"wrote lifetimes of {len(classes)} classes to {lifetimes}; use it with: evermap slam --prior {lifetimes}")


@app.command("why")
def why(
    file: MapFile,
    landmark: Annotated[str, typer.Argument(metavar="LANDMARK", help="Its id, or its name.")],
    revision: _AtRevision = None,
    figure: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Draw its belief over time.", show_default="none")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Tell why a landmark is believed to be there, or gone.

    What was seen of it, and how much each of that says.

    \b
    Example:
      evermap map why site.evermap 17 --figure why.png
    """
    from evermap.cli.map_content import answer_dict, draw_why, print_why
    from evermap.maps.store import open_store
    from evermap.maps.why import why as of_landmark

    if figure is not None:
        check_picture(figure, "--figure", inputs=[file])
    with open_store(file) as store:
        answer = of_landmark(store, landmark, revision)
    if figure is not None:
        draw_why(figure, answer)
    if as_json:
        print_json({"map": file, **answer_dict(answer)})
        return
    print_why(answer)


def _write_lifetimes(living: LivingMap, path: Path) -> list[str]:
    """The lifetimes of a map as a file of models; returns the classes in it."""
    from evermap.existence.models import NamedModels, save_models
    from evermap.existence.run_length import RunLength
    from evermap.maps.learning import lifetimes_by_class

    models = {name: RunLength.from_lifetimes(found) for name, found in lifetimes_by_class(living).items()}
    save_models(NamedModels(models, "class"), path)
    return list(models)


def _writer(out: Path, cell_m: float, radius_m: float) -> Any:
    """What writes such a file.

    Raises:
        ConfigError: no map is written to such a file.
    """
    from evermap.io import write_map_geojson, write_map_parquet
    from evermap.io.grid import write_grid
    from evermap.io.landmarks import write_map_csv

    writers = {
        ".yaml": partial(write_grid, cell_m=cell_m, radius_m=radius_m),
        ".parquet": write_map_parquet,
        ".geojson": write_map_geojson,
        ".json": write_map_geojson,
        ".csv": write_map_csv,
    }
    with suppress(KeyError):
        return writers[out.suffix.lower()]
    raise ConfigError(
        f"cannot write a '{out.suffix}' file", path=out, field="--out", hint="map.parquet, .geojson, .csv or .yaml"
    )


for command in (verify, gc, revert, pin, unpin, delete, undelete):
    app.command()(command)
