"""Views of the sensor: evidence from misses, and the time at which a place was last seen empty."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from evermap.errors import InputError
from evermap.types import FloatArray

if TYPE_CHECKING:
    from evermap.sensing.visibility import DetectionModel


SHADE = "shade"
"""End of the names of the columns of what views do not see."""


@dataclass(frozen=True, slots=True)
class View:
    """Field of view in a frame.

    Attributes:
        centre_m: (3,) where the sensor is, in the world.
        reach_m: beyond this distance nothing is detected.
        p_detect: for positions (N, 3) in the world, (N,) probabilities to detect an object there.
        sector_of: probability, heading, angle and angle beside it [rad] of a sector; of a ball an angle of 2 pi; None
            for any other view, which is not saved with a tracker.
        shade: (M, 5) what is hidden: within an angle around a bearing in the world [rad, rad], farther than a
            horizontal range [m], where the line of sight passes between two heights there [m, m].
    """

    centre_m: FloatArray
    reach_m: float
    p_detect: Callable[[FloatArray], FloatArray]
    sector_of: tuple[float, float, float, float] | None = None
    shade: FloatArray = field(default_factory=lambda: np.zeros((0, 5)))

    @classmethod
    def of(cls, model: DetectionModel, pose_world_sensor: FloatArray, reach_m: float) -> Self:
        """Return what a detection model in space says of a pose (4, 4), as far as `reach_m` from the sensor."""
        pose = np.asarray(pose_world_sensor, dtype=np.float64)
        return cls(pose[:3, 3], reach_m, lambda position_m: model.p_detect(pose[None], position_m)[0])

    @classmethod
    def ball(cls, centre_m: FloatArray, reach_m: float, p_detect: float) -> Self:
        """Return a view that sees everything up to `reach_m` equally well."""

        def within(position_m: FloatArray) -> FloatArray:
            return np.where(np.linalg.norm(position_m - centre_m, axis=1) <= reach_m, p_detect, 0.0)

        return cls(centre_m, reach_m, within, (p_detect, 0.0, 2.0 * np.pi, 0.0))

    @classmethod
    def sector(
        cls,
        centre_m: FloatArray,
        reach_m: float,
        p_detect: float,
        yaw_rad: float,
        fov_rad: float,
        beside_rad: float = 0.0,
    ) -> Self:
        """Return such a view of a sensor that looks along `yaw_rad` and sees the angle `fov_rad`, at any height.

        Over an angle of `beside_rad` on either side the probability falls to none, where heading or angle aren't known.
        """

        def within(position_m: FloatArray) -> FloatArray:
            off = position_m - centre_m
            turn = np.remainder(np.arctan2(off[:, 1], off[:, 0]) - yaw_rad + np.pi, 2.0 * np.pi) - np.pi
            beyond = np.abs(turn) - 0.5 * fov_rad
            share = np.where(beyond <= 0.0, 1.0, np.clip(1.0 - beyond / max(beside_rad, 1e-12), 0.0, 1.0))
            return np.where(np.linalg.norm(off, axis=1) <= reach_m, p_detect * share, 0.0)

        return cls(centre_m, reach_m, within, (p_detect, yaw_rad, fov_rad, beside_rad))

    def hide_behind(self, middle_m: FloatArray, box: FloatArray) -> Self:
        """Return the view without what is behind boxes with middles (M, 3) and lengths, widths, heights, yaws (M, 4).

        What is nearer than the far end of a box, or seen above it, is in view.
        """
        length, width, height, yaw = (column[:, None] for column in box.T)
        along, across = 0.5 * length * [-1.0, -1.0, 1.0, 1.0], 0.5 * width * [-1.0, 1.0, -1.0, 1.0]
        off = middle_m - self.centre_m
        x = off[:, :1] + along * np.cos(yaw) - across * np.sin(yaw)
        y = off[:, 1:2] + along * np.sin(yaw) + across * np.cos(yaw)
        bearing = np.arctan2(off[:, 1], off[:, 0])
        turn = np.remainder(np.arctan2(y, x) - bearing[:, None] + np.pi, 2.0 * np.pi) - np.pi
        low, high = turn.min(axis=1), turn.max(axis=1)
        far_m, z_m = np.hypot(x, y).max(axis=1), middle_m[:, 2]
        half_m = 0.5 * height[:, 0]
        columns = [bearing + 0.5 * (low + high), 0.5 * (high - low), far_m, z_m - half_m, z_m + half_m]
        shade = np.column_stack(columns)
        return self.hide(shade[high - low < np.pi])  # a sensor within a box sees what is around it

    def hide(self, shade: FloatArray) -> Self:
        """Return the view without what is hidden, as `shade` says."""
        if not len(shade):
            return self
        middle, half, far_m, low_m, high_m = shade.T

        def within(position_m: FloatArray) -> FloatArray:
            off = position_m - self.centre_m
            range_m = np.hypot(off[:, 0], off[:, 1])[:, None]
            bearing = np.arctan2(off[:, 1], off[:, 0])[:, None]
            aside = np.abs(np.remainder(bearing - middle + np.pi, 2.0 * np.pi) - np.pi)
            passes_m = self.centre_m[2] + off[:, 2:] * far_m / np.maximum(range_m, 1e-9)
            hidden = (range_m > far_m) & (aside < half) & (low_m < passes_m) & (passes_m < high_m)
            return np.where(hidden.any(axis=1), 0.0, self.p_detect(position_m))

        return replace(self, p_detect=within, shade=np.vstack([self.shade, shade]))

    def probability(self, position_m: FloatArray) -> FloatArray:
        """Return (N,) `p_detect`, or raise an InputError unless that is one probability a position."""
        if len(position_m) == 0:
            return np.empty(0)
        p = np.ascontiguousarray(self.p_detect(position_m), dtype=np.float64)
        if p.shape != (len(position_m),):
            raise InputError(f"shape {p.shape} instead of ({len(position_m)},)", field="p_detect")
        if not np.all((p >= 0.0) & (p <= 1.0)):
            row = int(np.flatnonzero(~((p >= 0.0) & (p <= 1.0)))[0])
            raise InputError(f"position {row}: {p[row]} is not a probability", field="p_detect")
        return p


class ViewMemory:
    """Views of the past: every one of the last frames, and of those before a few from time to time or place to place.

    Args:
        sure_nats: log odds of misses that make a place empty.
        n_recent: frames of which all views are kept.
        n_burst: of older views so many in a row are kept, enough together to tell that a place was empty ...
        every_s: ... whenever this time has passed ...
        every_m: ... or the sensor has moved so far.
    """

    def __init__(
        self, sure_nats: float, n_recent: int = 32, n_burst: int = 4, every_s: float = 60.0, every_m: float = 5.0
    ) -> None:
        self._recent: deque[tuple[float, View]] = deque()
        self._n_recent, self._sure_nats = n_recent, sure_nats
        self._n_burst, self._every_s, self._every_m = n_burst, every_s, every_m
        self._n_in_burst = n_burst
        self._kept: dict[tuple[int, int], list[tuple[float, View]]] = {}
        self._last: tuple[float, View] | None = None
        self._chunk_m = 0.0
        self._reach_m = 0.0

    def add(self, stamp_s: float, view: View) -> None:
        """Remember a view; stamps never decrease."""
        self._recent.append((stamp_s, view))
        self._chunk_m = self._chunk_m or max(view.reach_m, 1.0)
        self._reach_m = max(self._reach_m, view.reach_m)
        if len(self._recent) <= self._n_recent:
            return
        stamp, old = self._recent.popleft()
        if (
            self._last is None
            or stamp - self._last[0] >= self._every_s
            or np.linalg.norm(old.centre_m - self._last[1].centre_m) >= self._every_m
        ):
            self._last, self._n_in_burst = (stamp, old), 0
        if self._n_in_burst < self._n_burst:
            self._n_in_burst += 1
            self._kept.setdefault(self._chunk_of(old.centre_m), []).append((stamp, old))

    def last_empty_s(self, position_m: FloatArray, before_s: float) -> float:
        """Return the last stamp before `before_s` from which on an object at `position_m` (3,) would surely have been
        detected.

        Returns:
            -inf where the place had not been looked at well enough.
        """
        nats = 0.0
        for stamp, view in self._backwards(position_m):
            if stamp >= before_s:
                continue
            if np.linalg.norm(position_m - view.centre_m) > view.reach_m:
                continue
            p = float(view.probability(position_m[None])[0])
            nats -= np.log(max(1.0 - p, 1e-12))
            if nats >= self._sure_nats:
                return stamp
        return -np.inf

    def columns(self) -> dict[str, FloatArray]:
        """Return what `restore` takes: balls and sectors; without other views, a place is seen empty later."""
        kept = [entry for entries in self._kept.values() for entry in entries]
        rows, shades = dict[str, list[list[float]]](), dict[str, FloatArray]()
        for name, views in (("recent", self._recent), ("kept", kept), ("last", [self._last] if self._last else [])):
            saved = [(stamp, view, view.sector_of) for stamp, view in views if view.sector_of is not None]
            rows[name] = [[stamp, *view.centre_m.tolist(), view.reach_m, *sector] for stamp, view, sector in saved]
            of = [np.column_stack([np.full(len(view.shade), k), view.shade]) for k, (_, view, _) in enumerate(saved)]
            shades[f"{name}_{SHADE}"] = np.vstack([np.zeros((0, 6)), *of])
        numbers = np.array([self._n_in_burst, self._chunk_m, self._reach_m], dtype=np.float64)
        columns = {name: np.array(of, dtype=np.float64).reshape(-1, 9) for name, of in rows.items()}
        return columns | shades | {"numbers": numbers}

    def restore(self, columns: Mapping[str, FloatArray]) -> None:
        """Take over the views that `columns` gave."""
        n_in_burst, self._chunk_m, self._reach_m = columns["numbers"].tolist()
        self._n_in_burst = int(n_in_burst)
        self._recent.extend(_views_of(columns, "recent"))
        for stamp, view in _views_of(columns, "kept"):
            self._kept.setdefault(self._chunk_of(view.centre_m), []).append((stamp, view))
        self._last = next(iter(_views_of(columns, "last")), None)

    def _backwards(self, position_m: FloatArray) -> list[tuple[float, View]]:
        """Views that may show a place, the last first."""
        x, y = self._chunk_of(position_m)
        n = int(np.ceil(self._reach_m / self._chunk_m)) if self._chunk_m else 0
        kept = [
            entry
            for i in range(x - n, x + n + 1)
            for j in range(y - n, y + n + 1)
            for entry in self._kept.get((i, j), ())
        ]
        return [*reversed(self._recent), *sorted(kept, key=lambda entry: -entry[0])]

    def _chunk_of(self, position_m: FloatArray) -> tuple[int, int]:
        chunk = self._chunk_m or 1.0
        return int(np.floor(position_m[0] / chunk)), int(np.floor(position_m[1] / chunk))


def _views_of(columns: Mapping[str, FloatArray], name: str) -> list[tuple[float, View]]:
    """Stamps and views of the rows of `ViewMemory.columns` of a name; older states have no shades."""
    shade = columns.get(f"{name}_{SHADE}", np.zeros((0, 6)))
    found = []
    for k, (stamp_s, x, y, z, reach_m, p_detect, *angles) in enumerate(columns[name].tolist()):
        around = np.array([x, y, z]), reach_m, p_detect
        view = View.ball(*around) if angles[1] == 2.0 * np.pi else View.sector(*around, *angles)
        found.append((stamp_s, view.hide(shade[shade[:, 0] == k, 1:])))
    return found
