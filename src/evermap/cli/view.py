"""`evermap view`: look at a run or a living map in rerun, or write it for rerun or Foxglove."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from evermap.cli.options import AsJson
from evermap.cli.terminal import print_json, say, warn
from evermap.errors import ConfigError, InputError


def view(
    path: Annotated[Path, typer.Argument(metavar="MAP|RUN", help="A living map, or the folder of a run of slam.")],
    save: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write what would be shown, as .rrd for rerun or .mcap for Foxglove, and open nothing.",
            show_default=False,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Look at a map or a run in the rerun viewer.

    Landmarks with their beliefs, the path and what changed, on a timeline.

    \b
    Examples:
      evermap view site.evermap
      evermap view out/monday
      evermap view site.evermap --save site.rrd
      evermap view out/monday --save monday.mcap
    """
    from evermap.runs.folder import check_output_file
    from evermap.runs.view import write_view

    if not path.exists():
        raise InputError("no such map or run", path=path, hint="check the path")
    if save is not None:
        check_output_file(save, inputs=[path], ending=save.suffix)
        remarks = write_view(path, save)
        for remark in remarks:
            warn(remark)
        if as_json:
            print_json({"view": str(path), "out": str(save), "warnings": list(remarks)})
            return
        say(f"wrote {save}; open it with: {'rerun' if save.suffix == '.rrd' else 'Foxglove'}")
        return
    from evermap.viz.rerun_scene import require_rerun

    require_rerun()
    if sys.platform.startswith("linux") and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        raise ConfigError("there is no screen to open a viewer on", field="view", hint="--save scene.rrd")
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / f"{path.resolve().stem}.rrd"
        for remark in write_view(path, scene):
            warn(remark)
        subprocess.run([sys.executable, "-m", "rerun", str(scene)], check=False)
