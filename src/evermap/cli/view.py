"""`evermap view`: look at a run, a living map or a drive in rerun, or write it for rerun or Foxglove."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

from evermap.cli.options import AsJson, argument, option
from evermap.cli.terminal import print_json, say, warn
from evermap.errors import ConfigError, InputError
from evermap.interrupts import watched


def view(
    path: Annotated[
        str,
        argument(
            "A living map, the folder of a run of slam, or the Zenoh endpoint of `evermap live`.",
            metavar="MAP|RUN|LIVE",
        ),
    ],
    save: Annotated[
        Path | None,
        option(
            "Save as .rrd for rerun or .mcap for Foxglove instead of opening a viewer.", metavar="FILE", default=False
        ),
    ] = None,
    as_json: AsJson = False,
    force: Annotated[bool, option("--force", "Replace a file that is there.")] = False,
) -> None:
    """Look at a map, a run or a live drive in the rerun viewer.

    Landmarks with their beliefs, the path and what changed, on a timeline.

    \b
    Examples:
      evermap view site.evermap
      evermap view out/monday
      evermap view site.evermap --save site.rrd
      evermap view out/monday --save monday.mcap
      evermap view tcp/localhost:7447
    """
    if re.match(r"(tcp|udp|tls|quic|ws)/|listen=", path) and not Path(path).exists():
        _look_on(path, save, force=force)
    else:
        _look_at(Path(path), save, as_json=as_json, force=force)


def _look_on(where: str, save: Path | None, *, force: bool) -> None:
    """Show a drive until it is stopped."""
    from evermap.live.ros import look_on
    from evermap.live.wires import Mailbox, Zenoh
    from evermap.runs.folder import check_output_file
    from evermap.viz.rerun_scene import LiveScene

    if save is None:
        _need_screen()
    elif save.suffix != ".rrd":
        raise ConfigError(f"cannot write a '{save.suffix}' file", path=save, field="save", hint="drive.rrd")
    else:
        check_output_file(save, ending=".rrd", force=force)
    mailbox = Mailbox(ours=True)
    zenoh, scene = Zenoh(where, mailbox), LiveScene(save)
    say("showing the drive of evermap live; Ctrl-C ends it")
    with watched(signal.SIGTERM) as watch:
        look_on(mailbox, scene, watch.stop_if_asked)
    scene.close()
    zenoh.close()


def _need_screen() -> None:
    from evermap.viz.rerun_scene import require_rerun

    require_rerun()
    if sys.platform.startswith("linux") and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        raise ConfigError("there is no screen to open a viewer on", field="view", hint="--save scene.rrd")


def _look_at(path: Path, save: Path | None, *, as_json: bool, force: bool) -> None:
    """Open the written file in the viewer."""
    from evermap.runs.folder import check_output_file
    from evermap.runs.view import write_view

    if not path.exists():
        raise InputError("no such map or run", path=path, hint="check the path")
    if save is not None:
        check_output_file(save, inputs=[path], ending=save.suffix, force=force)
        remarks = write_view(path, save)
        for remark in remarks:
            warn(remark)
        if as_json:
            print_json({"view": str(path), "out": str(save), "warnings": list(remarks)})
            return
        say(f"wrote {save}; open it with: {'rerun' if save.suffix == '.rrd' else 'Foxglove'}")
        return
    _need_screen()
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / f"{path.resolve().stem}.rrd"
        for remark in write_view(path, scene):
            warn(remark)
        subprocess.run([sys.executable, "-m", "rerun", str(scene)], check=False)  # noqa: S603  (a file we just made)
