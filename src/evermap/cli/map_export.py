"""`evermap map export`: landmarks and lifetimes of a living map as files of other tools; `map nav2`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from evermap.cli.options import AtRevision, MapFile, ResultAsJson, option
from evermap.cli.terminal import print_json, say
from evermap.errors import ConfigError

if TYPE_CHECKING:
    from evermap.maps.living import LivingMap
    from evermap.types import Landmarks, Up

    Writer = Callable[[LivingMap, Landmarks], dict[str, Any]]
    """Writes a file; returns facts for the summary."""

_ExportOut = Annotated[
    Path | None,
    option("Where to write the landmarks: .parquet, .geojson or .csv.", metavar="FILE", default=False),
]
_ExportFormat = Annotated[
    str | None,
    option(
        "--format",
        "Format of the landmarks in --out.",
        metavar="csv|columns|parquet|geojson|wpilib|wpilib-2027|wpilib-csv|tagslam|fiducials|rtabmap",
        default="by the ending of --out",
    ),
]
_ExportLifetimes = Annotated[
    Path | None, option("Where to write the lifetimes by class.", metavar="FILE.json", default=False)
]
_PLeast = Annotated[float, option("Leave out landmarks with a smaller P(exists).", min=0.0, max=1.0)]
_PLeastOfNav2 = Annotated[
    float | None,
    option(
        "Leave out landmarks with a smaller P(exists).",
        min=0.0,
        max=1.0,
        default="0.5; 0 for the speed mask and the route graph",
    ),
]
_SpeedMask = Annotated[bool, option("--speed-mask", "Write --out FILE.yaml as the mask of Nav2's speed filter.")]
_RouteGraph = Annotated[
    Path | None,
    option("Write this route graph of Nav2 to --out, without blocked edges.", metavar="IN.geojson", default=False),
]
_MapAge = Annotated[str, option("With --speed-mask: age of the map when it is used.")]
_CellM = Annotated[float, option("Edge of a cell of the grid [m].", min=1e-3, max=1e3)]
_RadiusM = Annotated[
    float | None,
    option(
        "Radius around a landmark in the grid, clearance of an edge [m].",
        min=0.0,
        max=1e3,
        default="0.25; 1 for the speed mask; 0.5 for the route graph",
    ),
]
_UpDirection = Annotated[
    str | None,
    option(
        "Of a map in space of which it is not known: the direction of up in its frame.",
        metavar="X,Y,Z",
        default="as known",
    ),
]
NAV2 = """\
Write a file of Nav2.

Landmarks as obstacles of a grid, where to drive slowly, or which ways are open.

\b
Examples:
  evermap map nav2 site.evermap --out keepout.yaml --p-least 0.1
  evermap map nav2 site.evermap --out speed.yaml --speed-mask --ahead 12h
  evermap map nav2 site.evermap --out open.geojson --route-graph graph.geojson
  evermap map nav2 rig.evermap --out keepout.yaml --up 0,-1,0
"""


def export(
    file: MapFile,
    out: _ExportOut = None,
    format_name: _ExportFormat = None,
    lifetimes: _ExportLifetimes = None,
    revision: AtRevision = None,
    p_least: _PLeast = 0.5,
    up: _UpDirection = None,
    as_json: ResultAsJson = False,
    force: Annotated[bool, option("--force", "Replace files that are there.")] = False,
) -> None:
    """Write existing landmarks, or learned lifetimes, to a file.

    For other tools, for `evermap slam --prior-map`, and for `--prior` of another map.

    \b
    Examples:
      evermap map export site.evermap --out map.geojson
      evermap map export site.evermap --out field.json --format wpilib
      evermap map export site.evermap --lifetimes lifetimes.json
    """
    from evermap.io.map_formats import format_called, write_map

    if out is None and lifetimes is None:
        raise ConfigError("nothing to write", field="--out", hint="--out map.geojson, or --lifetimes lifetimes.json")
    write: Writer | None = None
    if out is not None:
        kind = format_called(format_name, out)

        def write(_: LivingMap, landmarks: Landmarks) -> dict[str, Any]:
            write_map(landmarks, out, kind)
            return {"format": kind.name}

    _write_files(file, out, write, lifetimes, revision=revision, p_least=p_least, up=up, as_json=as_json, force=force)


def nav2(
    file: MapFile,
    out: Annotated[Path, option("The file to write: .yaml of a grid, .geojson of a route graph.", metavar="FILE")],
    speed_mask: _SpeedMask = False,
    route_graph: _RouteGraph = None,
    revision: AtRevision = None,
    p_least: _PLeastOfNav2 = None,
    ahead: _MapAge = "1d",
    cell_m: _CellM = 0.05,
    radius_m: _RadiusM = None,
    up: _UpDirection = None,
    as_json: ResultAsJson = False,
    lifetimes: Annotated[Path | None, option("Lifetimes by class.", hidden=True)] = None,
) -> None:
    """Write a file of Nav2."""
    from evermap.io.files import is_marked
    from evermap.runs.folder import check_output_file
    from evermap.survival.durations import parse_duration_s

    ahead_s = parse_duration_s(ahead) if speed_mask else None
    if p_least is None:
        p_least = 0.0 if speed_mask or route_graph is not None else 0.5
    write = _nav2_writer(out, cell_m, radius_m, ahead_s, route_graph)
    if route_graph is None:  # a grid has an image beside its YAML
        check_output_file(out.with_suffix(".pgm"), inputs=[file], ours=lambda _: is_marked(out))
    _write_files(
        file,
        out,
        write,
        lifetimes,
        revision=revision,
        p_least=p_least,
        up=up,
        as_json=as_json,
        inputs=[route_graph],
    )


def _write_files(
    file: str,
    out: Path | None,
    write: Writer | None,
    lifetimes: Path | None,
    *,
    revision: int | None,
    p_least: float,
    up: str | None,
    as_json: bool,
    inputs: Sequence[Path | None] = (),
    force: bool | None = None,
) -> None:
    """Write landmarks by their writer, and lifetimes; and say so."""
    from evermap.existence.models import is_model_file, save_lifetimes
    from evermap.io.landmarks import up_dict
    from evermap.maps.learning import lifetimes_by_class
    from evermap.maps.store import open_store
    from evermap.runs.folder import check_output_file

    read = [file, *inputs]
    if out is not None:
        check_output_file(out, inputs=read, force=force)
    if lifetimes is not None:
        check_output_file(lifetimes, inputs=read, ending=".json", force=force, ours=is_model_file)
    with open_store(file) as store:
        number = store.head() if revision is None else revision
        living = store.load(number)
    if up is not None:
        living = replace(living, up=_find_stated_up(up, living))
    landmarks = living.landmarks(p_least=p_least)
    written = {} if write is None else write(living, landmarks)
    told = {"out": None if out is None else str(out), "landmarks": len(landmarks), **written}
    learned = {} if lifetimes is None else lifetimes_by_class(living)
    if lifetimes is not None:
        save_lifetimes(learned, lifetimes)
    if as_json:
        said = {"lifetimes": None if lifetimes is None else str(lifetimes), "classes": list(learned)}
        print_json({"map": file, "revision": number, **told, "up": up_dict(landmarks.up), **said})
        return
    if out is not None:
        closed = f"; {len(told['closed'])} of {told['edges']} edges are closed" if "edges" in told else ""
        say(f"wrote {len(landmarks)} landmarks of revision {number} to {out}{closed}")
    if lifetimes is not None:
        use = f"evermap map enter MAP INPUT --prior {lifetimes}"
        say(f"wrote lifetimes of {len(learned)} classes to {lifetimes}; use it with: {use}")


def _nav2_writer(
    out: Path, cell_m: float, radius_m: float | None, ahead_s: float | None, route_graph: Path | None
) -> Writer:
    """Return the writer of such a file of Nav2, which returns facts for the summary.

    Raises:
        ConfigError: it is not written to such a file.
    """
    ending = out.suffix.lower()
    if ahead_s is not None:
        if ending != ".yaml" or route_graph is not None:
            raise ConfigError("is an image with its YAML", path=out, field="--speed-mask", hint="--out speed.yaml")
        return partial(_write_speed_mask, out, cell_m, 1.0 if radius_m is None else radius_m, ahead_s)
    if route_graph is not None:
        if ending not in (".geojson", ".json"):
            raise ConfigError("is written as GeoJSON", path=out, field="--route-graph", hint="--out open.geojson")
        return partial(_write_route_graph, out, route_graph, 0.5 if radius_m is None else radius_m)
    if ending != ".yaml":
        raise ConfigError("is an image with its YAML", path=out, field="--out", hint="--out keepout.yaml")
    return partial(_write_grid, out, cell_m, 0.25 if radius_m is None else radius_m)


def _find_stated_up(text: str, living: LivingMap) -> Up:
    """Return the direction of up that a user states for a map in space.

    Raises:
        ConfigError: it is none, or the map is in the plane.
    """
    import numpy as np

    from evermap.geometry.upright import STATED_RAD
    from evermap.types import Up

    if living.dim == 2:
        raise ConfigError("the map is in the plane, where up is z", field="--up", hint="leave it out")
    try:
        direction = np.array([float(part) for part in text.split(",")])
    except ValueError:
        direction = np.zeros(0)
    length = float(np.linalg.norm(direction))
    if direction.shape != (3,) or not 0.0 < length < math.inf:
        raise ConfigError(f"'{text}' is no direction", field="--up", hint="three numbers, as 0,0,1")
    return Up(direction / length, STATED_RAD, "stated")


def _write_grid(out: Path, cell_m: float, radius_m: float, _: LivingMap, landmarks: Landmarks) -> dict[str, Any]:
    """Write the mask of a keepout filter."""
    from evermap.io.nav2 import write_grid

    write_grid(landmarks, out, cell_m=cell_m, radius_m=radius_m)
    return {}


def _write_speed_mask(
    out: Path, cell_m: float, radius_m: float, ahead_s: float, living: LivingMap, landmarks: Landmarks
) -> dict[str, Any]:
    """Write where to drive slowly, since the map may be wrong by then."""
    import numpy as np

    from evermap.io.nav2 import write_speed_mask

    then = living.landmarks(at=living.stamp_s + ahead_s) if len(landmarks) else landmarks
    p_then = then.p_exists[np.isin(then.landmark_id, landmarks.landmark_id)]
    p_wrong = np.where(landmarks.p_exists >= 0.5, 1.0 - p_then, p_then)
    write_speed_mask(landmarks, p_wrong, out, cell_m=cell_m, radius_m=radius_m)
    return {
        "ahead_s": ahead_s,
        "p_wrong": dict(zip(map(str, landmarks.landmark_id.tolist()), p_wrong.tolist(), strict=True)),
    }


def _write_route_graph(
    out: Path, graph: Path, clearance_m: float, _: LivingMap, landmarks: Landmarks
) -> dict[str, Any]:
    """Write a route graph; return its closed and its uncertain edges."""
    from evermap.io.nav2 import write_route_graph

    edges = write_route_graph(landmarks, graph, out, clearance_m=clearance_m)
    doubtful = {str(edge.number): edge.p_blocked for edge in edges if edge.p_blocked and not edge.closed}
    return {"edges": len(edges), "closed": [edge.number for edge in edges if edge.closed], "doubtful": doubtful}
