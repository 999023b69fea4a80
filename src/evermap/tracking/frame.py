"""What the kernels are given and give back: a frame, the rules, and tables for what happens."""

from __future__ import annotations

from typing import NamedTuple

from evermap.types import FloatArray, IntArray


class Rules(NamedTuple):
    """When tracklets change their state; see `TrackerConfig`."""

    odds_confirm: float
    odds_dead: float
    warm_up: int
    lost_after: int
    max_missed: int
    class_speed_mps: FloatArray
    rest_for_s: float
    appearance_memory: float
    sigma_velocity_mps: float
    sigma_acceleration_mps2: float
    inverse_odds_new: float


class Frame(NamedTuple):
    """Detections of one frame.

    Attributes:
        stamp_s: when.
        position: (M, 3) in the world.
        noise: (M, 3, 3) covariances, or (1, 3, 3) for all.
        class_id: (M,) or `UNKNOWN`.
        appearance: (M, A) unit vectors, or zeros.
    """

    stamp_s: float
    position: FloatArray
    noise: FloatArray
    class_id: IntArray
    appearance: FloatArray


class EventTable(NamedTuple):
    """Room for what happens in a frame, one row each.

    Attributes:
        kind: (K,) an `EventKind`.
        row: (K,) the tracklet's row.
    """

    kind: IntArray
    row: IntArray


class SpellTable(NamedTuple):
    """Room for static spells that end in a frame, one row each.

    Attributes:
        track_id, class_id: (K,) whose.
        position: (K, 3) where.
        times: (K, 4) last seen elsewhere, first seen there, last seen there, first seen gone.
    """

    track_id: IntArray
    class_id: IntArray
    position: FloatArray
    times: FloatArray
