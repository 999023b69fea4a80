"""What may be wrong with a given map."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial

import numpy as np

from evermap.explain.causes.mounts import turn_within
from evermap.explain.causes.suspect import RARE_P, UNIT_P, USUAL_P, Inputs, Suspect, say_always
from evermap.geometry import se3
from evermap.geometry.square import CORNERS as SQUARE
from evermap.geometry.symmetry import Symmetry
from evermap.slam import mistakes
from evermap.slam.check import is_clockwise
from evermap.types import AnyRecording, FloatArray, Landmarks, is_in_space

MAP_SCALE = 0.1
"""Standard deviation of the logarithm of a map's scale."""


def suspect_map(given: Landmarks, recording: AnyRecording) -> Iterable[Suspect]:
    """Yield what may be wrong with a map that was given with a recording."""
    yield Suspect(
        "map-scale", "map", USUAL_P, _stretch_map,
        lambda s: f"true distances are {math.exp(s):.4g} times those of the given map: another scale",
        lambda s: f"--prior-map: lengths x {math.exp(s):.5g}", MAP_SCALE, math.exp, of_map=True, pairs=False,
    )  # fmt: skip
    yield Suspect(
        "map-mirrored", "map", USUAL_P, lambda inputs, _: _mirror_map(inputs),
        say_always("the given map is mirrored: y to the right, x and y exchanged, or z downwards"),
        say_always("--prior-map: the sign of y"), of_map=True, pairs=False,
    )  # fmt: skip
    if given.rotation is not None and np.isfinite(given.rotation).any():
        yield from _suspect_map_axes(recording)
    for unit, factor in (
        ("millimetres", 1e-3), ("centimetres", 1e-2), ("feet", 0.3048), ("inches", 0.0254),
    ):  # fmt: skip
        yield Suspect(
            "map-unit", "map", UNIT_P, partial(_stretch_map_by, factor=factor),
            say_always(f"the given map seems to be in {unit}, not in metres"),
            say_always(f"--prior-map: lengths x {factor:g}"), of_map=True, pairs=False,
        )  # fmt: skip
    yield Suspect(
        "map-site", "map", RARE_P, lambda inputs, _: replace(inputs, prior_map=None, left_out=inputs.n_common),
        say_always("the given map is not one of what was seen: another site, or another edition"),
        say_always("--prior-map: leave it out, or give the map of this site"), of_map=True, pairs=False,
    )  # fmt: skip


def _suspect_map_axes(recording: AnyRecording) -> Iterable[Suspect]:
    """Return what may be wrong with the orientations of tags in a map: other axes, or another order of numbers.

    A tag whose corners are listed from another one on is turned about its normal; one whose corners are listed
    clockwise is turned over. Where corners were read, these are what is wrong.
    """
    corners = is_in_space(recording) and bool(np.isfinite(recording.detections.corner_px[:, 0, 0]).any())
    clockwise = is_in_space(recording) and corners and bool(is_clockwise(recording).any())
    for quaternion in _AXES_TURNED:
        listed = ", ".join(f"{each:g}" for each in np.round(quaternion, 6) + 0.0)
        undo = partial(_turn_map, how=partial(turn_within, by=se3.turn(quaternion)))
        normal, over = (not np.abs(part).max() > 1e-9 for part in (quaternion[:2], quaternion[2:]))
        if corners and (over if clockwise else normal):
            which = "clockwise, as by OpenCV's ArUco, or from another one on" if clockwise else "from another one on"
            yield Suspect(
                "corner-order", "tags", USUAL_P, undo,
                say_always(
                    f"corners of tags are listed {which}: counter-clockwise from the lower left is expected (u0_px); "
                    f"or tags have other axes than in the given map: x, y, z are its {_name_axes(quaternion)}"
                ),
                say_always(f"detections.csv: corners in the order {_name_order(quaternion)}"), of_map=True, pairs=False,
            )  # fmt: skip
            continue
        yield Suspect(
            "map-axes", "map", USUAL_P if normal else RARE_P, undo,
            say_always(f"tags have other axes than in the given map: x, y, z are its {_name_axes(quaternion)}"),
            say_always(f"--prior-map: each orientation times the quaternion x, y, z, w = {listed}"),
            of_map=True, pairs=False,
        )  # fmt: skip
    for convention, words in (
        ("w first", "are in the order w, x, y, z"), ("inverse", "are those of the world in the tags' frames"),
    ):  # fmt: skip
        yield Suspect(
            "map-axes", "map", USUAL_P, partial(_turn_map, how=mistakes.CONVENTIONS[convention]),
            say_always(f"orientations of the given map {words}"), say_always("--prior-map: qx, qy, qz, qw"),
            of_map=True, pairs=False,
        )  # fmt: skip


def _name_axes(quaternion: FloatArray) -> str:
    """Return axes after a rotation in those before it, as 'y, -x, z'."""
    turned = np.round(se3.transform(se3.turn(quaternion), np.eye(3)), 6)
    return ", ".join(("-" if axis.sum() < 0.0 else "") + "xyz"[int(np.abs(axis).argmax())] for axis in turned)


def _name_order(quaternion: FloatArray) -> str:
    """Return in which order to list corners of a tag that is turned by a quaternion, as '3, 2, 1, 0'."""
    back = se3.transform(se3.inverse(se3.turn(quaternion)), SQUARE)
    return ", ".join(str(int(np.argmin(np.linalg.norm(SQUARE - each, axis=1)))) for each in back)


_AXES_TURNED = sorted(
    (each for each in Symmetry.generate_group(("90:x", "90:z")).turns if abs(each[3]) < 1.0 - 1e-9),
    key=lambda each: bool(each[:2].any()),
)
"""Quaternions of the 23 rotations that bring axes to axes, those about the normal of a tag first."""


def _turn_map(inputs: Inputs, _: float, how: Callable[[FloatArray], FloatArray]) -> Inputs:
    """Return the same with other orientations of the map's landmarks."""
    given = inputs.prior_map
    assert given is not None
    assert given.rotation is not None
    return replace(inputs, prior_map=replace(given, rotation=how(se3.turn(given.rotation))[:, 3:]))


def _stretch_map_by(inputs: Inputs, _: float, factor: float) -> Inputs:
    """Return the same with the map in another unit; how well it is known was not read from it, but stated in metres."""
    stretched = _stretch_map(inputs, math.log(factor))
    assert inputs.prior_map is not None
    assert stretched.prior_map is not None
    return replace(stretched, prior_map=replace(stretched.prior_map, covariance_m2=inputs.prior_map.covariance_m2))


def _stretch_map(inputs: Inputs, state: float) -> Inputs:
    given, factor = inputs.prior_map, math.exp(state)
    assert given is not None
    dim = given.position_m.shape[1]
    other = replace(given, position_m=given.position_m * factor, covariance_m2=given.covariance_m2 * factor**2)
    return replace(inputs, prior_map=other, stretched_place=inputs.stretched_place + dim * state)


def _mirror_map(inputs: Inputs) -> Inputs:
    """Return the same with the map mirrored; it knows no orientations then, of which there are several mirrors."""
    given = inputs.prior_map
    assert given is not None
    sign = np.ones(given.position_m.shape[1])
    sign[1] = -1.0
    other = replace(
        given,
        position_m=given.position_m * sign,
        covariance_m2=given.covariance_m2 * sign[:, None] * sign,
        rotation=None,
        rotation_covariance=None,
    )
    return replace(inputs, prior_map=other)
