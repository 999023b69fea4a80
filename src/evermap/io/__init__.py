"""Readers and writers: recordings, maps and trajectories in files. `docs/formats.md` describes every format."""

from __future__ import annotations

from evermap.io.files import Reader
from evermap.io.landmarks import read_landmarks, read_prior_map, write_map_geojson, write_map_parquet
from evermap.io.mrclam import read_mrclam
from evermap.io.native import read_native
from evermap.io.native_write import write_native
from evermap.io.registry import READERS, list_robots, read_planar, read_recording, reader_for
from evermap.io.shifts import Shift, parse_shift, shifted
from evermap.io.template import write_template
from evermap.io.tum import read_tum, write_tum

__all__ = [
    "READERS",
    "Reader",
    "Shift",
    "list_robots",
    "parse_shift",
    "read_landmarks",
    "read_mrclam",
    "read_native",
    "read_planar",
    "read_prior_map",
    "read_recording",
    "read_tum",
    "reader_for",
    "shifted",
    "write_map_geojson",
    "write_map_parquet",
    "write_native",
    "write_template",
    "write_tum",
]
