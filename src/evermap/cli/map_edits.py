"""`evermap map revert | pin | unpin | delete | undelete`: an operator's word, as revisions that can be reverted.

`verify` and `gc` look after the file, `reenter` enters all sessions of many maps again.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from evermap.cli.learn import Maps, Store, sites_of
from evermap.cli.options import Cluster, ConfigFile, Settings, Workers, argument, configured, one_of, option
from evermap.cli.terminal import command_line, print_json, print_table, progress_bar, say
from evermap.errors import ConfigError, EvermapError

MapFile = Annotated[str, argument("The map, as `evermap slam --map FILE` writes it.", metavar="FILE")]
AsJson = Annotated[bool, option("--json", "Print as JSON.")]
_Ids = Annotated[list[str], argument("Ids of landmarks, or their names.", metavar="LANDMARK...")]
_Note = Annotated[str, option("A note for the log.")]


def revert(
    file: MapFile,
    revision: Annotated[int, argument("Revision to restore; 0 is the empty map.", metavar="N")],
    note: _Note = "",
    as_json: AsJson = False,
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


def verify(file: MapFile, as_json: AsJson = False) -> None:
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
        print_json(
            {
                "map": file,
                "sound": found.sound,
                "head": found.head,
                "intact": list(found.intact),
                "damaged": {str(number): reason for number, reason in found.damaged.items()},
                "lost": list(found.lost),
                "pruned": list(found.pruned),
                "problems": list(found.problems),
                "chunks": found.n_chunks,
                "bytes": found.n_bytes,
            }
        )
    if not found.sound:
        raise found.error(Path(file))
    if not as_json:
        earlier = f"; lost to earlier damage: {', '.join(map(str, found.lost))}" if found.lost else ""
        pruned = f"; the content of {ranges(found.pruned)} is pruned" if found.pruned else ""
        count = len(found.intact) + len(found.pruned)
        say(f"{file}: all {count} revisions are intact ({found.n_chunks} parts were checked){earlier}{pruned}")


def gc(
    maps: Maps = None,
    store: Store = None,
    keep: Annotated[int, option("Newest revisions to keep complete.", min=1, metavar="N")] = 10,
    dry_run: Annotated[bool, option("--dry-run", "Only list what would be deleted.")] = False,
    as_json: AsJson = False,
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
    from evermap.server.database import approved_of

    if not maps and store is None:  # nothing is deleted by default
        raise ConfigError("nothing to prune", field="MAP", hint="files of maps, or --store WHERE")
    told = []
    for where in sites_of(maps or [], store).values():
        with open_store(where) as opened:
            at = opened.where
            approved = approved_of(where if is_address(where) else at)
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


def reenter(
    maps: Maps = None,
    store: Store = None,
    out: Annotated[Path, option("Folder of the copies, to continue from.")] = Path("evermap-out/reentered"),
    adopt: Annotated[bool, option("--adopt", "Append them to the maps, each at once.")] = False,
    workers: Workers = None,
    cluster: Cluster = None,
    config: ConfigFile = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Enter all sessions of maps again, as with new settings.

    Each map is copied to --out and entered there; the maps stay as they are, and can be compared. With --adopt the new
    revisions are appended to the maps: a map has all of them or none, and `evermap map revert` goes back. What an
    attempt that was stopped has entered is not entered again.

    \b
    Examples:
      evermap map reenter maps/*.evermap --set living.returns=false --adopt
      evermap map reenter --store postgresql://evermap@db/fleet --cluster tcp://scheduler:8786 --out /shared/reentered
    """
    one_of(workers, cluster)
    chosen = configured(config, settings) if config or settings else None
    from evermap.runs.company import reenter_all

    sites = sites_of(maps or [], store, cluster)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot be made: {error.strerror}", path=out, field="out", hint="another folder") from None
    with progress_bar("entering sessions", speed=False) as progress:
        found = reenter_all(
            sites, out.absolute(), chosen, adopt=adopt, workers=workers, cluster=cluster, progress=progress
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

    def command(file: MapFile, landmarks: _Ids, note: _Note = "", as_json: AsJson = False) -> None:
        from evermap.maps.store import open_store
        from evermap.runs.sessions import edit_landmarks

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
