"""`evermap simulate`: recordings of worlds in which things come and go, with the whole truth beside them."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evermap.cli.moved import Moved
from evermap.cli.terminal import print_json, say
from evermap.errors import ConfigError, suggestion

if TYPE_CHECKING:
    from evermap_studies.sim import BuildingSimulation
    from evermap_studies.worlds.yard import YardConfig

BUILDING, STREET, YARD = WORLDS = ("building", "street", "yard")
OF_BUILDINGS = ("patrol_s", "change_rate", "wing_opens_day")
"""Options of buildings alone."""
OF_YARDS = ("moving",)
"""And of yards."""
FEATURES = {"doors": BUILDING, "clutter": BUILDING, "standing": YARD, "plane": YARD}
"""What `--with` adds, and to which world."""
STAYS_FILE = "stays_truth.csv"
BODIES_FILE = "bodies_truth.csv"
EVENTS_FILE = "changes_truth.jsonl"
LOOKS_FILE = "looks_truth.csv"


def simulate(
    context: typer.Context,
    world: Annotated[
        str, typer.Argument(metavar="WORLD", help="building, street or yard; a folder alone is for a building.")
    ],
    out: Annotated[
        Path | None,
        typer.Argument(
            metavar="[OUT]", help="Folder to write; one folder a session is made in it.", show_default="./WORLD"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same recordings.")] = 0,
    days: Annotated[int, typer.Option(min=1, help="Days that the patrols span.")] = 6,
    sessions_per_day: Annotated[int, typer.Option(min=1, help="Patrols a day.")] = 1,
    patrol_s: Annotated[
        list[float],
        typer.Option(
            help="Length of a patrol [s]; 165 is about one lap. Given several times: every patrol draws one of them,"
            " and a route of its own that sees a part of the building."
        ),
    ] = [165.0],  # noqa: B006
    change_rate: Annotated[float, typer.Option(min=0.0, help="How often things change; 0 is a static world.")] = 1.0,
    wing_opens_day: Annotated[
        int, typer.Option(min=0, help="The eastern wing is closed before this day, counted from 0; 0: no such wing.")
    ] = 0,
    moving: Annotated[
        int, typer.Option(min=0, max=6, help="Forklifts of a yard, of six, that drive while the robot is there.")
    ] = 4,
    with_: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            metavar="|".join(FEATURES),
            show_default=False,
            help="Buildings: doors to the rooms, shut now and then; clutter, many crates that stay for hours. Yards: "
            "standing, with nothing that moves; plane, seen as ranges and bearings on the floor. Repeatable.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print what was written as JSON.")] = False,
    force: Annotated[
        bool,
        typer.Option("--force", help="Write into OUT even if it is not empty; other files stay."),
    ] = False,
) -> None:
    """Record drives in a simulated building, street or yard.

    Every session is a folder in the native format with its true trajectory and landmarks. What changed and when is in
    changes_truth.jsonl; where each landmark stood in every session, and whether the robot really looked there, in
    looks_truth.csv.

    A street has cars and vans that park and leave, some of them in view, and cars that drive along, seen as boxes
    without identity in space; stays_truth.csv has who stood where, from when until when.

    A yard has forklifts that carry tags, seen in space: some drive and stop while the robot is there, the others are
    parked, elsewhere in each session; bodies_truth.csv has where each forklift was in each frame. In a plane yard the
    same drives are recordings in the plane.

    \b
    Example:
      evermap simulate building --days 3 --seed 1
      evermap slam building/day00_session00
      evermap simulate building out/hard --patrol-s 20 --patrol-s 60 --wing-opens-day 3 --with doors --with clutter
      evermap simulate street --days 3
      evermap simulate yard --moving 6
    """
    if world not in WORLDS and out is not None:
        raise ConfigError(f"no world '{world}'", field="world", hint=suggestion(world, WORLDS))
    where = out or Path(world)
    of_others = [*(OF_BUILDINGS if world in (STREET, YARD) else ()), *(OF_YARDS if world != YARD else ())]
    for name in of_others:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            whose = "buildings" if name in OF_BUILDINGS else "yards"
            raise ConfigError(f"is for {whose}", field=f"--{name.replace('_', '-')}", hint="leave it out")
    features = with_ or []
    for name in features:
        if name not in FEATURES:
            raise ConfigError(f"no feature '{name}'", field="--with", hint=suggestion(name, FEATURES))
        if FEATURES[name] != (world if world in WORLDS else BUILDING):
            raise ConfigError(f"'{name}' is for {FEATURES[name]}s", field="--with", hint="leave it out")
    doors, clutter, standing, plane = (name in features for name in FEATURES)
    if world in (STREET, YARD):
        if world == STREET:
            names = _write_street(where, days, sessions_per_day, seed, force=force)
        else:
            from evermap_studies.worlds.yard import YardConfig

            config = YardConfig(
                days=days, drives_per_day=sessions_per_day, moving=moving, parked=6 - moving, standing=standing,
                oriented=not plane,
            )  # fmt: skip
            names = _write_yard(where, config, seed, plane=plane, force=force)
        if as_json:
            print_json({"out": str(where), "sessions": names, "seed": seed})
        else:
            say(f"wrote {len(names)} sessions to {where}; next: evermap map enter {world}.map {where / names[0]}")
        return
    out = where
    from evermap.io import write_native
    from evermap.runs.folder import RunFolder
    from evermap_studies.sim import CLUTTER, DEFAULT_CLASSES, ROOM_DOORS, BuildingConfig, simulate_building

    folder = RunFolder(out, force=force, renew=False)
    of_building = BuildingConfig(
        days=days,
        sessions_per_day=sessions_per_day,
        patrol_s=max(patrol_s),
        change_rate=change_rate,
        classes=(*DEFAULT_CLASSES, CLUTTER) if clutter else DEFAULT_CLASSES,
        patrol_lengths_s=tuple(patrol_s) if len(patrol_s) > 1 else (),
        doors=ROOM_DOORS if doors else None,
        wing_opens_day=wing_opens_day,
    )
    building = simulate_building(of_building, seed=seed)
    names = session_names(building)
    with folder:
        for name, recording in zip(names, building.sessions, strict=True):
            write_native(recording, folder.path(name))
        _write_events(building, folder.path(EVENTS_FILE))
        _write_looks(building, names, folder.path(LOOKS_FILE))
    if as_json:
        print_json({"out": str(out), "sessions": names, "changes": len(building.events), "seed": seed})
    else:
        say(
            f"wrote {len(names)} sessions and {len(building.events)} changes to {out}; "
            f"next: evermap slam {out / names[0]}"
        )


simulate.moved = {  # type: ignore[attr-defined]
    f"--{name}": Moved(takes=False, key=name, write=lambda _: "", option="--with") for name in FEATURES
}


def _write_street(out: Path, days: int, drives_per_day: int, seed: int, *, force: bool) -> list[str]:
    """Write the drives along a street and who stood where; return their names."""
    from evermap.io import write_native
    from evermap.io.files import write_atomic
    from evermap.runs.folder import RunFolder
    from evermap_studies.worlds.parking import StreetConfig, simulate_street

    folder = RunFolder(out, force=force, renew=False)
    config = StreetConfig(days=days, drives_per_day=drives_per_day)
    street, drives = simulate_street(config, seed)
    names = [f"day{k // drives_per_day:02d}_session{k % drives_per_day:02d}" for k in range(len(drives))]
    lines = ["slot,class_id,x_m,y_m,yaw_rad,length_m,width_m,height_m,from_s,until_s\n"]
    for one in street.spells:
        numbers = [*street.slot[one.slot].tolist(), *one.size_m, one.from_s, one.until_s]
        lines.append(f"{one.slot},{street.class_names[one.class_id]},{','.join(map(repr, numbers))}\n")
    with folder:
        for name, recording in zip(names, drives, strict=True):
            write_native(recording, folder.path(name))
        write_atomic(folder.path(STAYS_FILE), "".join(lines))
    return names


def _write_yard(out: Path, config: YardConfig, seed: int, *, plane: bool, force: bool) -> list[str]:
    """Write the drives through a yard and where its forklifts were; return their names."""
    from evermap.io import write_native
    from evermap.io.files import write_atomic
    from evermap.runs.folder import RunFolder
    from evermap_studies.worlds.yard import flatten, simulate_yard

    folder = RunFolder(out, force=force, renew=False)
    drives, count = simulate_yard(config, seed), config.drives_per_day
    names = [f"day{k // count:02d}_session{k % count:02d}" for k in range(len(drives))]
    lines = ["session,object_id,stamp_s,x_m,y_m,yaw_rad,moves\n"]
    for name, drive in zip(names, drives, strict=True):
        stamps = drive.recording.frames.stamp_s.tolist()
        for one, (way, moves) in enumerate(zip(drive.body.tolist(), drive.moves.tolist(), strict=True)):
            rows = zip(stamps, way, moves, strict=True)
            lines += [f"{name},{one},{at!r},{x!r},{y!r},{yaw!r},{int(on)}\n" for at, (x, y, yaw), on in rows]
    with folder:
        for name, drive in zip(names, drives, strict=True):
            write_native(flatten(drive.recording) if plane else drive.recording, folder.path(name))
        write_atomic(folder.path(BODIES_FILE), "".join(lines))
    return names


def session_names(building: BuildingSimulation) -> list[str]:
    """'day00_session00' and so on, in order of time."""
    names, count = [], dict.fromkeys((truth.day for truth in building.truths), 0)
    for truth in building.truths:
        names.append(f"day{truth.day:02d}_session{count[truth.day]:02d}")
        count[truth.day] += 1
    return names


def _write_events(building: BuildingSimulation, path: Path) -> None:
    """One JSON object a line, in order of time."""
    from evermap.io.files import write_atomic

    write_atomic(path, "".join(json.dumps(asdict(event)) + "\n" for event in building.events))


def _write_looks(building: BuildingSimulation, names: list[str], path: Path) -> None:
    """One row for every session and every place at which a landmark ever stood."""
    from evermap.io.files import write_atomic
    from evermap_studies.sim import looked_at

    looks = looked_at(building)
    lines = ["session,landmark_id,x_m,y_m,present,looked_at,p_seen\n"]
    columns = [looks.landmark_id.tolist(), looks.position_m.tolist()]
    for k, name in enumerate(names):
        told = [part[k].tolist() for part in (looks.present, looks.looked_at, looks.p_seen)]
        lines += [
            f"{name},{landmark},{x!r},{y!r},{int(here)},{int(seen)},{p:.6f}\n"
            for landmark, (x, y), here, seen, p in zip(*columns, *told, strict=True)
        ]
    write_atomic(path, "".join(lines))
