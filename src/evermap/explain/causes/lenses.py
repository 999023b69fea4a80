"""What may be wrong with the calibration of cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from evermap.explain.causes.suspect import RARE_P, USUAL_P, Inputs, Suspect, say_always
from evermap.geometry.square import with_square_poses
from evermap.types import SpatialSensor

FOCAL, DISTORTION = 0.1, 0.2
"""Standard deviations of the logarithm of a focal length, and of k1."""
CENTRE_PX, COEFFICIENT = 30.0, 0.05
"""Standard deviations of the centre of an image, and of a coefficient of distortion that is stated."""
RESOLUTIONS = 0.5, 2.0, 2.0 / 3.0, 1.5
"""Sizes of images, over those that a camera was calibrated for, that are met: binned by two, or 720 rows for 1080."""


def suspect_lens(row: list[int], sensors: Sequence[SpatialSensor]) -> Iterable[Suspect]:
    """Return what may be wrong with the calibration that some cameras share."""
    sensor = sensors[row[0]]
    assert sensor.intrinsics is not None
    fx, fy, cx, cy = sensor.intrinsics
    name = sensor.name if len(row) == 1 else ", ".join(sensors[one].name for one in row)

    def lens(code: str, words: str, fix: str, p: float, **changed: Any) -> Suspect:
        undo = partial(_change_lens, rows=row, how=lambda _, __: changed)
        return Suspect(code, name, p, undo, say_always(f"{name}: {words}"), say_always(fix), pairs=False)

    yield Suspect(
        "focal-length", name, USUAL_P, partial(_change_lens, rows=row, how=_zoom),
        lambda s: f"{name}: the focal length is {fx * math.exp(s):.4g} px, not {fx:.4g} px",
        lambda s: f"[camera.{name}] intrinsics = [{fx * math.exp(s):.5g}, {fy * math.exp(s):.5g}, {cx:g}, {cy:g}]",
        FOCAL, lambda s: fx * math.exp(s), pairs=False,
    )  # fmt: skip
    for factor in RESOLUTIONS:
        listed = ", ".join(f"{factor * each:g}" for each in sensor.intrinsics)
        yield Suspect(
            "resolution", name, USUAL_P, partial(_change_resolution, rows=row, factor=factor),
            say_always(f"{name}: corners are of images {factor:.3g} times as large as those of the calibration"),
            say_always(f"[camera.{name}] intrinsics = [{listed}]"),
        )  # fmt: skip
    for place, key in ((2, "cx"), (3, "cy")):
        stated = sensor.intrinsics[place]
        yield Suspect(
            "intrinsics", f"{name} {key}", RARE_P,
            partial(_change_lens, rows=row, how=partial(_with_number_off, field="intrinsics", place=place)),
            lambda s, key=key, stated=stated: f"{name}: {key} is {stated + s:.4g} px, not {stated:.4g} px",  # type: ignore[misc]
            lambda s, key=key, stated=stated: f"[camera.{name}] intrinsics: {key} = {stated + s:.5g}",  # type: ignore[misc]
            CENTRE_PX, pairs=False,
        )  # fmt: skip
    if abs(fx - fy) > 1e-3 * fx or abs(cx - cy) > 1e-3 * cx:
        for words, swapped in (
            ("fx and fy seem to be swapped", (fy, fx, cx, cy)), ("cx and cy seem to be swapped", (fx, fy, cy, cx)),
            ("fx, fy and cx, cy seem to be swapped", (fy, fx, cy, cx)),
            ("intrinsics seem to be stated as fx, cx, fy, cy", (fx, cx, fy, cy)),
        ):  # fmt: skip
            listed = ", ".join(f"{each:g}" for each in swapped)
            yield lens("intrinsics", words, f"[camera.{name}] intrinsics = [{listed}]", USUAL_P, intrinsics=swapped)
    if not any(sensor.distortion):
        yield Suspect(
            "distortion", name, USUAL_P, partial(_change_lens, rows=row, how=_bend),
            lambda s: f"{name}: the lens distorts, but no distortion is stated: k1 is about {s:.3g}",
            lambda s: f'[camera.{name}] model = "radtan", distortion = [{s:.3g}, {s * s:.3g}, 0, 0], or calibrate',
            DISTORTION, pairs=False,
        )  # fmt: skip
        return
    yield lens(
        "distortion", "the sign of k1 seems wrong", f"[camera.{name}] distortion = [{-sensor.distortion[0]:g}, ...]",
        RARE_P, distortion=(-sensor.distortion[0], *sensor.distortion[1:]),
    )  # fmt: skip
    yield lens(
        "distortion", "corners seem to be undistorted already", f'[camera.{name}] model = "pinhole"', USUAL_P,
        distortion=(), distortion_model="pinhole",
    )  # fmt: skip
    for place in range(2):
        key, stated = f"k{place + 1}", sensor.distortion[place]
        yield Suspect(
            "distortion", f"{name} {key}", RARE_P,
            partial(_change_lens, rows=row, how=partial(_with_number_off, field="distortion", place=place)),
            lambda s, key=key, stated=stated: f"{name}: {key} is about {stated + s:.3g}, not {stated:.3g}",  # type: ignore[misc]
            lambda s, key=key, stated=stated: f"[camera.{name}] distortion: {key} = {stated + s:.3g}",  # type: ignore[misc]
            COEFFICIENT, pairs=False,
        )  # fmt: skip
    if len(sensor.distortion) >= 4:
        other = "equidistant" if sensor.distortion_model == "radtan" else "radtan"
        yield lens(
            "lens", f"the lens seems to be of the model '{other}'", f'[camera.{name}] model = "{other}"', USUAL_P,
            distortion=sensor.distortion[:4], distortion_model=other,
        )  # fmt: skip


def _change_resolution(inputs: Inputs, _: float, rows: Sequence[int], factor: float) -> Inputs:
    """Return the same with the calibration of some cameras for images of another size, and the poses of their tags."""
    recording: Any = inputs.recording
    seen, sensors = recording.detections, list(recording.sensors)
    for row in rows:
        size = sensors[row].resolution_px
        sensors[row] = replace(
            sensors[row],
            intrinsics=tuple(factor * each for each in sensors[row].intrinsics),
            resolution_px=None if size is None else (round(factor * size[0]), round(factor * size[1])),
        )
    seen = with_square_poses(seen, sensors, np.isin(seen.sensor, rows) & np.isfinite(seen.corner_px[:, 0, 0]))
    return replace(inputs, recording=replace(recording, detections=seen, sensors=tuple(sensors)))


def _zoom(sensor: SpatialSensor, state: float) -> dict[str, Any]:
    assert sensor.intrinsics is not None
    fx, fy, cx, cy = sensor.intrinsics
    return {"intrinsics": (fx * math.exp(state), fy * math.exp(state), cx, cy)}


def _with_number_off(sensor: SpatialSensor, state: float, field: str, place: int) -> dict[str, Any]:
    """Return intrinsics or distortion with one number another than stated."""
    numbers = list(getattr(sensor, field))
    numbers[place] += state
    return {field: tuple(numbers)}


def _bend(_: SpatialSensor, state: float) -> dict[str, Any]:
    """Return the distortion of a lens with this k1: of those that bend lines much, k2 is about its square."""
    return {"distortion": (state, state**2, 0.0, 0.0), "distortion_model": "radtan"}


def _change_lens(
    inputs: Inputs, state: float, rows: Iterable[int], how: Callable[[Any, float], dict[str, Any]]
) -> Inputs:
    recording: Any = inputs.recording
    sensors = list(recording.sensors)
    for row in rows:
        sensors[row] = replace(sensors[row], **how(sensors[row], state))
    return replace(inputs, recording=replace(recording, sensors=tuple(sensors)))
