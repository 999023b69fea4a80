"""evermap keeps landmark maps true while the world changes.

    import evermap as em

    recording = em.read_recording("MRCLAM_Dataset6.zip", robot=1)
    result = em.run_slam(recording)
    print(result.landmarks.position_m)

The names below are loaded when they are first used, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module

__version__ = "0.1.0"

TYPE_CHECKING = False  # as in typing, which takes longer to load than all of this
if TYPE_CHECKING:
    from typing import Any

    from evermap.config import Config, PersistConfig, load_config
    from evermap.errors import EvermapError
    from evermap.existence.one_stay import PersistenceFilter
    from evermap.io import read_recording, write_native
    from evermap.live.engine import Engine
    from evermap.live.spool import recover
    from evermap.maps.diff import diff
    from evermap.maps.living import LivingMap
    from evermap.maps.sessions.session import Session
    from evermap.maps.store import open_store
    from evermap.maps.why import why
    from evermap.pipeline import run_localization, run_session, run_slam, run_together
    from evermap.runs.folder import write_run
    from evermap.runs.persist.run import run_persist
    from evermap.runs.persist.table import read_looks
    from evermap.runs.sessions import Entered, enter_session
    from evermap.slam.check import check_recording
    from evermap.slam.localize import Localizer
    from evermap.survival.text import parse_prior
    from evermap.tracking.detections import read_detections
    from evermap.tracking.run import run_track
    from evermap.tracking.tracker import Tracker
    from evermap.types import Detections, Frames, Landmarks, Odometry, Recording, Sensor, SlamResult, Trajectory

_HOME = {
    "evermap.config": ("Config", "PersistConfig", "load_config"),
    "evermap.errors": ("EvermapError",),
    "evermap.existence.one_stay": ("PersistenceFilter",),
    "evermap.io": ("read_recording", "write_native"),
    "evermap.live.engine": ("Engine",),
    "evermap.live.spool": ("recover",),
    "evermap.maps.diff": ("diff",),
    "evermap.maps.living": ("LivingMap",),
    "evermap.maps.sessions.session": ("Session",),
    "evermap.maps.store": ("open_store",),
    "evermap.maps.why": ("why",),
    "evermap.pipeline": ("run_localization", "run_session", "run_slam", "run_together"),
    "evermap.runs.folder": ("write_run",),
    "evermap.runs.persist.run": ("run_persist",),
    "evermap.runs.persist.table": ("read_looks",),
    "evermap.runs.sessions": ("Entered", "enter_session"),
    "evermap.tracking.detections": ("read_detections",),
    "evermap.tracking.run": ("run_track",),
    "evermap.slam.check": ("check_recording",),
    "evermap.slam.localize": ("Localizer",),
    "evermap.survival.text": ("parse_prior",),
    "evermap.tracking.tracker": ("Tracker",),
    "evermap.types": (
        "Detections", "Frames", "Landmarks", "Odometry", "Recording", "Sensor", "SlamResult", "Trajectory",
    ),
}  # fmt: skip
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "Config",
    "Detections",
    "Engine",
    "Entered",
    "EvermapError",
    "Frames",
    "Landmarks",
    "LivingMap",
    "Localizer",
    "Odometry",
    "PersistConfig",
    "PersistenceFilter",
    "Recording",
    "Sensor",
    "Session",
    "SlamResult",
    "Tracker",
    "Trajectory",
    "__version__",
    "check_recording",
    "diff",
    "enter_session",
    "load_config",
    "open_store",
    "parse_prior",
    "read_detections",
    "read_looks",
    "read_recording",
    "recover",
    "run_localization",
    "run_persist",
    "run_session",
    "run_slam",
    "run_together",
    "run_track",
    "why",
    "write_native",
    "write_run",
]


def __getattr__(name: str) -> Any:
    """A public name, from the module that defines it."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'evermap' has no attribute '{name}'")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
