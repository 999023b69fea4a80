"""`evermap map`: the history of a living map: what changed, why, and back; an operator's word, as revisions."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evermap.cli.in_map import ENTER, enter
from evermap.cli.learn import Maps, Store, sites_of
from evermap.cli.map_export import NAV2, export, nav2
from evermap.cli.options import (
    AtRevision,
    ConfigFile,
    MapFile,
    ResultAsJson,
    Settings,
    Workers,
    argument,
    configure,
    option,
    workers_of,
)
from evermap.cli.terminal import (
    check_picture,
    command_line,
    echo,
    print_json,
    print_table,
    progress_bar,
    say,
    write_picture,
)
from evermap.errors import ConfigError, EvermapError

if TYPE_CHECKING:
    from evermap.maps.store import Revision
    from evermap.maps.why import Answer
    from evermap.types import Clock, MapChange

app = typer.Typer(
    name="map", help="Living maps: history, differences, reasons, edits.", no_args_is_help=True, rich_markup_mode=None
)

_Ids = Annotated[list[str], argument("Ids of landmarks, or their names.", metavar="LANDMARK...")]
_Note = Annotated[str, option("A note for the log.")]


@app.command("log")
def log(file: MapFile, as_json: ResultAsJson = False) -> None:
    """List the revisions.

    Every session, edit and revert, with its changes.

    \b
    Example:
      evermap map log site.evermap
    """
    from evermap.maps.diff import read_log
    from evermap.maps.store import open_store
    from evermap.runs.map_dicts import revision_dict

    with open_store(file) as store:
        revisions = read_log(store)
        clock = store.load().clock
    if as_json:
        newest = revisions[-1].number if revisions else 0
        told = {"head": newest, "clock": clock.value, "revisions": [*map(revision_dict, revisions)]}
        print_json({"map": file, **told})
        return
    head = ("revision", "written (UTC)", "kind", "of", "starts", "landmarks", "changes", "took")
    print_table(file, [revision_row(item, clock) for item in revisions], head, numbers=(0, 7))


@app.command("show")
def show(
    file: MapFile,
    revision: AtRevision = None,
    ahead: Annotated[str, option("Time of the forecast, as 12h or 3d.")] = "1d",
    everything: Annotated[bool, option("--all", "Also list landmarks that are believed gone.")] = False,
    figure: Annotated[Path | None, option("Draw the map.", metavar="FILE.png", default="none")] = None,
    as_json: ResultAsJson = False,
) -> None:
    """List the landmarks.

    Whether they exist, where, since when, and whether they will be there tomorrow.

    \b
    Example:
      evermap map show site.evermap --ahead 3d --figure map.png
    """
    from evermap.io.landmarks import up_dict
    from evermap.maps.store import open_store
    from evermap.runs.map_dicts import hours_dict, landmark_dicts, life_dicts, prior_dicts
    from evermap.survival.durations import parse_duration_s
    from evermap.types import json_number, stamp_text

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
        about: dict[str, Any] = {
            "map": file,
            "revision": number,
            "stamp_s": json_number(living.stamp_s),
            "clock": living.clock.value,
        }
        about["up"] = up_dict(living.landmarks().up)
        told = {"priors": prior_dicts(living), "lifetimes": life_dicts(living), **hours_dict(living)}
        print_json({**about, "ahead_s": ahead_s, "landmarks": content, **told})
        return
    listed = [
        item for item in content if everything or item["pinned"] or (item["p_exists"] >= 0.5 and not item["deleted"])
    ]
    head = ("landmark", "class", "P(exists)", f"in {ahead}", "place [m]", "+-", "since", "last seen", "sites", "")
    title = f"{file}, revision {number}, seen until {stamp_text(living.stamp_s, living.clock)}"
    print_table(title, [_landmark_row(item, living.clock) for item in listed], head, numbers=(0, 2, 3, 5, 8))
    if living.dim == 3:
        echo(f"up: {living.up.text}")
    for said in prior_dicts(living):
        of = f"of class {said['class']}" if said["class"] else "of all other classes"
        away = f", absences {said['absence']}" if said["absence"] else ""
        echo(f"lifetimes {of} start from {said['stay']}{away}, worth {said['worth_stays']} stays")
    if len(listed) < len(content):
        say(f"{len(content) - len(listed)} more are believed gone or deleted; --all lists them")


@app.command("diff")
def diff(
    file: MapFile,
    a: Annotated[int, argument("The earlier revision; 0 is the empty map.", metavar="A")],
    b: Annotated[int | None, argument("The later one.", metavar="B", default="newest")] = None,
    as_json: ResultAsJson = False,
) -> None:
    """List the changes between two revisions.

    Landmarks that appeared, vanished, moved, swapped places and returned, growth of the map, and operators' edits.

    \b
    Example:
      evermap map diff site.evermap 3 7
    """
    from evermap.maps.diff import diff as between
    from evermap.maps.store import open_store
    from evermap.runs.map_dicts import diff_dict
    from evermap.viz.change_words import grew

    with open_store(file) as store:
        found = between(store, a, b)
        new = store.load(found.b)
    if as_json:
        print_json({"map": file, **diff_dict(found)})
        return
    lines = [_change_line(change, new.clock) for change in found.changes]
    lines += grew(len(found.grown), [*map(new.label, found.grown.tolist())])
    lines += [f"landmark {new.label(name)} {word} by an operator" for name, word in found.edits]
    for line in lines:
        echo(line)
    if not lines:
        say(f"no difference between revisions {found.a} and {found.b}")


def revision_row(item: Revision, clock: Clock) -> list[str]:
    """Return a line of the log: the cells of a revision."""
    from evermap.types import stamp_text

    origin = item.provenance
    changes = [f"{count} {kind.value}" for kind, count in item.n_changes.items()]
    changes += [f"grew by {item.n_grown}"] if item.n_grown else []
    return [
        str(item.number),
        item.created_at.replace("T", " ").removesuffix("+00:00"),
        origin.kind.value,
        origin.note or origin.recording or "-",
        stamp_text(origin.stamp_from_s, clock),
        f"{item.n_existing} of {item.n_landmarks}",
        ", ".join(changes) or "-",
        f"{origin.wall_s:.1f} s" if math.isfinite(origin.wall_s) else "-",
    ]


def _change_line(change: MapChange, clock: Clock) -> str:
    """Return 'landmark 5 moved by (+0.50, 0.00) m between 10:02:00 and 10:20:00, probability 97 % (12 hits, 40
    misses)'.
    """
    from evermap.types import between_text
    from evermap.viz.change_words import probability, what

    when = between_text(change.stamp_from_s, change.stamp_to_s, clock)
    return f"{what(change)} {when}, {probability(change.probability)} ({change.n_hits} hits, {change.n_misses} misses)"


def _landmark_row(content: dict[str, Any], clock: Clock) -> list[str]:
    """Return the cells of a landmark."""
    from evermap.io.spatial import AT
    from evermap.maps.why import probability_text
    from evermap.types import or_nan, stamp_text

    placed = content["x_m"] is not None
    flags = " ".join(word for word in ("pinned", "deleted") if content[word])
    ahead = content["p_ahead"]
    return [
        content["label"],
        content["class"] or "-",
        probability_text(content["p_exists"]),
        "-" if ahead is None else probability_text(ahead),
        f"({', '.join(f'{content[axis]:.2f}' for axis in AT if axis in content)})" if placed else "-",
        f"{100 * content['sigma_m']:.1f} cm" if placed else "-",
        stamp_text(or_nan(content["since_s"]), clock),
        stamp_text(or_nan(content["seen_s"]), clock),
        str(content["sites"]),
        flags,
    ]


def _print_why(answer: Answer) -> None:
    """Print the answer, its reasons, and the evidence of every session."""
    from evermap.maps.why import probability_text
    from evermap.types import stamp_text

    echo(answer.headline)
    for reason in answer.reasons:
        echo(f"  - {reason}")
    for revision, change in answer.changes:
        echo(f"  revision {revision}: {_change_line(change, answer.clock)}")
    if answer.visits:
        head = ("revision", "session", "looks from", "to", "frames", "hits", "misses", "expected", "nats", "P(exists)")
        rows = [
            [
                str(visit.revision),
                " of ".join(filter(None, (visit.recording, visit.robot))) or "-",
                stamp_text(visit.from_s, answer.clock),
                stamp_text(visit.to_s, answer.clock),
                str(visit.n_looks),
                str(visit.n_hits),
                str(visit.n_misses),
                f"{visit.expected:.1f}",
                f"{visit.log_odds:+.1f}",
                probability_text(visit.p_exists),
            ]
            for visit in answer.visits
        ]
        print_table("what the sessions saw", rows, head, numbers=(0, 4, 5, 6, 7, 8, 9))


app.command("enter", help=ENTER)(enter)
app.command("export")(export)
app.command("nav2", help=NAV2)(nav2)


@app.command("why")
def why(
    file: MapFile,
    landmark: Annotated[str, argument("Its id, or its name.", metavar="LANDMARK")],
    revision: AtRevision = None,
    figure: Annotated[Path | None, option("Draw its belief over time.", metavar="FILE.png", default="none")] = None,
    as_json: ResultAsJson = False,
) -> None:
    """Explain why a landmark is believed to exist or gone.

    Lists its looks and the weight of each as evidence.

    \b
    Example:
      evermap map why site.evermap 17 --figure why.png
    """
    from evermap.maps.store import open_store
    from evermap.maps.why import why as of_landmark
    from evermap.runs.map_dicts import answer_dict

    if figure is not None:
        check_picture(figure, "--figure", inputs=[file])
    with open_store(file) as store:
        answer = of_landmark(store, landmark, revision)
    if figure is not None:
        from evermap.viz.living_map_figures import plot_why

        write_picture(figure, plot_why(answer))
    if as_json:
        print_json({"map": file, **answer_dict(answer)})
        return
    _print_why(answer)


@app.command("verify")
def verify(file: MapFile, as_json: ResultAsJson = False) -> None:
    """Check every byte of a map against its checksums.

    Exit code 2 if anything is damaged, with the revisions that are intact and how to go back to them.

    \b
    Example:
      evermap map verify site.evermap
    """
    from evermap.maps.store import verify_store
    from evermap.maps.store.history import ranges

    found = verify_store(file)
    if as_json:
        names = ("sound", "head", "intact", "damaged", "lost", "pruned", "problems")
        told = {name: getattr(found, name) for name in names}
        print_json({"map": file, **told, "chunks": found.n_chunks, "bytes": found.n_bytes})
    if not found.sound:
        raise found.error(Path(file))
    if not as_json:
        earlier = f"; lost to earlier damage: {', '.join(map(str, found.lost))}" if found.lost else ""
        pruned = f"; the content of {ranges(found.pruned)} is pruned" if found.pruned else ""
        count = len(found.intact) + len(found.pruned)
        say(f"{file}: all {count} revisions are intact ({found.n_chunks} parts were checked){earlier}{pruned}")


@app.command("gc")
def gc(
    maps: Maps = None,
    store: Store = None,
    keep: Annotated[int, option("Newest revisions to keep complete.", min=1, metavar="N")] = 10,
    dry_run: Annotated[bool, option("--dry-run", "Only list what would be deleted.")] = False,
    as_json: ResultAsJson = False,
) -> None:
    """Prune old revisions: delete their content, and shrink the file.

    The log, the evidence, the recordings and what operators said stay; but a pruned revision cannot be shown, compared,
    exported or reverted to, and no session can be entered before it any more. Of the maps of a server, the approved
    revisions stay.

    \b
    Examples:
      evermap map gc site.evermap --keep 20
      evermap map gc --store maps --keep 20
    """
    from evermap.maps.store import is_address, open_store
    from evermap.maps.store.history import ranges
    from evermap.server.database import find_approved

    if not maps and store is None:  # nothing is deleted by default
        raise ConfigError("nothing to prune", field="MAP", hint="files of maps, or --store WHERE")
    told = []
    for where in sites_of(maps or [], store).values():
        with open_store(where) as opened:
            at = opened.where
            approved = find_approved(where if is_address(where) else at)
            found = opened.prune(keep, also=[] if approved is None else [approved], dry_run=dry_run)
        item = {"map": at, "pruned": [*found.revisions], "kept": [*found.kept], "approved": approved}
        told.append({**item, "dry_run": dry_run, "parts": found.n_chunks, "bytes": found.n_bytes})
        if as_json:
            continue
        of = f"{at}: " if store is not None or len(maps or []) > 1 else ""
        if found.revisions:
            done = "would be pruned" if dry_run else "pruned"
            what = f"{found.n_chunks} parts, {found.n_bytes / 1e3:,.0f} kB"
            say(f"{of}{done}: the content of {ranges(found.revisions)} ({what}); {ranges(found.kept)} kept")
        else:
            say(f"{of}nothing to prune: {len(found.kept)} revisions have content")
    if as_json:
        print_json(told[0] if store is None and len(told) == 1 else {"maps": told})


@app.command("compact")
def compact(file: MapFile, as_json: ResultAsJson = False) -> None:
    """Shrink the file of a map, and lose nothing.

    All revisions but the newest are compressed together. Every command answers as before, and later sessions give the
    same map; an evermap that is older than this command cannot read the file any more. Sessions that come in afterwards
    are compressed by the next call. If the process is killed, the map is as it was.

    \b
    Example:
      evermap map compact site.evermap
    """
    from evermap.maps.store import is_address, open_store

    if is_address(file):
        raise ConfigError("is no file", field="MAP", hint="VACUUM FULL of the database's own tools")
    with open_store(file) as opened:
        before = Path(opened.where).stat().st_size
        opened.compact()
        after = Path(opened.where).stat().st_size
    if as_json:
        print_json({"map": file, "bytes_before": before, "bytes": after})
    else:
        say(f"{file}: {before / 1e3:,.0f} kB before, {after / 1e3:,.0f} kB now ({after / before:.0%})")


@app.command("reenter")
def reenter(
    maps: Maps = None,
    store: Store = None,
    out: Annotated[Path, option("Folder of the copies, to continue from.")] = Path("evermap-out/reentered"),
    adopt: Annotated[bool, option("--adopt", "Append them to the maps, each at once.")] = False,
    workers: Workers = None,
    config: ConfigFile = None,
    settings: Settings = None,
    as_json: ResultAsJson = False,
) -> None:
    """Enter all sessions of maps again, as with new settings.

    Each map is copied to --out and entered there; the maps stay as they are, and can be compared. With --adopt the new
    revisions are appended to the maps: a map has all of them or none, and `evermap map revert` goes back. What an
    attempt that was stopped has entered is not entered again.

    \b
    Examples:
      evermap map reenter maps/*.evermap --set living.returns=false --adopt
      evermap map reenter --store postgresql://evermap@db/fleet --workers tcp://scheduler:8786 --out /shared/reentered
    """
    count, cluster = workers_of(workers)
    chosen = configure(config, settings) if config or settings else None
    from evermap.runs.company import reenter_all

    sites = sites_of(maps or [], store, cluster)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot be made: {error.strerror}", path=out, field="out", hint="another folder") from None
    with progress_bar("entering sessions", speed=False) as progress:
        found = reenter_all(
            sites, out.absolute(), chosen, adopt=adopt, workers=count, cluster=cluster, progress=progress
        )
    done = {site: one for site, one in found.items() if not isinstance(one, EvermapError)}
    failed = {site: one for site, one in found.items() if isinstance(one, EvermapError)}
    if as_json:
        told = {name: {key: getattr(one, key) for key in one.__slots__} for name, one in done.items()}
        print_json({"out": str(out), "sites": told, "failed": {site: one.one_line() for site, one in failed.items()}})
    elif done:
        rows = [(site, *(f"{number:,}" for number in (one.sessions, one.kept, one.parent, one.revision)),
                 "yes" if one.adopted else "no") for site, one in done.items()]  # fmt: skip
        head = ("site", "sessions", "kept", "after revision", "newest", "adopted")
        print_table(f"in {out}", rows, head, numbers=(1, 2, 3, 4))
    for first in failed.values():
        first.problem += f" ({len(failed)} of {len(found)} maps stay as they are)" if len(found) > 1 else ""
        raise first


@app.command("revert")
def revert(
    file: MapFile,
    revision: Annotated[int, argument("Revision to restore; 0 is the empty map.", metavar="N")],
    note: _Note = "",
    as_json: ResultAsJson = False,
) -> None:
    """Go back to an older revision.

    By a new one with its content: nothing is lost, and a revert can be reverted. Of a damaged file every intact
    revision is kept; the file itself is set aside as FILE.damaged.

    \b
    Example:
      evermap map revert site.evermap 6 --note "the lidar was dirty"
    """
    from evermap.maps.store import Provenance, revert_store

    now, damaged = revert_store(file, revision, Provenance(command=command_line(), note=note))
    if as_json:
        aside = None if damaged is None else str(damaged)
        print_json({"map": file, "revision": now, "restores": revision, "parent": now - 1, "damaged_file": aside})
        return
    if damaged is None:
        back = f"; undo with: evermap map revert {file} {now - 1}"
    else:
        back = f"; the file was damaged: its intact revisions are kept, the damaged file is now {damaged}"
    say(f"revision {now} has the content of revision {revision}{back}")


EDITS = {
    "pin": ("pinned", "Keep these landmarks in the map, whatever is missed.", "3 4"),
    "unpin": ("unpinned", "Let the evidence decide about these landmarks again.", "3"),
    "delete": (
        "deleted",
        "Leave these landmarks out from now on.\n\nTheir detections are ignored until that is taken back.",
        '17 --note "a reflection"',
    ),
    "undelete": ("undeleted", "Use these landmarks again.", "17"),
}
"""What an operator may say of landmarks, by command: the word of the revision, the help, and the example."""


def edit(name: str) -> Callable[..., None]:
    """Return a command by which an operator's word becomes a revision; none where nothing would change."""
    word, does, example = EDITS[name]

    def command(file: MapFile, landmarks: _Ids, note: _Note = "", as_json: ResultAsJson = False) -> None:
        from evermap.maps.store import open_store
        from evermap.runs.edits import edit_landmarks

        with open_store(file) as store:
            parent = store.head()
            number, changed, said = edit_landmarks(store, landmarks, word, note=note, command=command_line())
        if as_json:
            print_json({"map": file, "revision": number, "parent": parent, word: changed})
        elif changed:
            say(f"revision {number}: {said}; undo with: evermap map revert {file} {parent}")
        else:
            say(f"nothing to do: {said}")

    command.__doc__ = f"{does}\n\n\b\nExample:\n  evermap map {name} site.evermap {example}"
    return command


for name in EDITS:
    app.command(name)(edit(name))


@app.command("rename")
def rename(
    file: MapFile,
    landmark: Annotated[str, argument("Its id, or its name.", metavar="LANDMARK")],
    name: Annotated[str, argument("What it is called from now on; '' for its own name again.", metavar="NAME")],
    note: _Note = "",
    as_json: ResultAsJson = False,
) -> None:
    """Call a landmark by another name, in all sessions from now on.

    Its identity stays, and what it was called before still finds it.

    \b
    Example:
      evermap map rename site.evermap "chair K381" "chair at the door"
    """
    from evermap.maps.store import open_store
    from evermap.runs.edits import rename_landmark

    with open_store(file) as store:
        parent = store.head()
        number, called, said = rename_landmark(store, landmark, name, note=note, command=command_line())
    if as_json:
        print_json({"map": file, "revision": number, "parent": parent, "label": called})
    elif number != parent:
        say(f"revision {number}: {said}; undo with: evermap map revert {file} {parent}")
    else:
        say(f"nothing to do: {said}")
