"""Measurements of tables at the poses and places of a problem: which are used, and to what each is tied."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.estimate.measurement import MeasurementFactors, Tied
from evermap.estimate.measurements import find_kinds
from evermap.estimate.tie import find_nearest, tie_measurements, without_frames
from evermap.geometry import se3
from evermap.types import UNKNOWN, FloatArray, Measurements

POSES_S = np.array([10.0, 11.0, 12.0, 14.0])
PLACES = np.array([3, 7, 9])


def table(kind: str, stamp_s: list[float], landmark_id: list[int] | None = None, **columns: list[float]):
    names = [UNKNOWN] * len(stamp_s) if landmark_id is None else landmark_id
    return Measurements(kind, np.array(stamp_s), {k: np.array(v) for k, v in columns.items()}, np.array(names))


def ahead(from_s: FloatArray, to_s: FloatArray) -> FloatArray:
    """A robot that drives a metre a second along its x axis."""
    motion = np.tile([0.0, 0.0, 0.0, *se3.NO_TURN], (len(from_s), 1))
    motion[:, 0] = to_s - from_s
    return motion


def tied_to(*tables: Measurements) -> tuple[tuple[Tied, ...], list[str]]:
    return tie_measurements(tables, POSES_S, ahead, PLACES)


def test_a_measurement_is_tied_to_the_last_pose_before_it_and_the_drive_since() -> None:
    fixes = table("gnss", [9.9, 10.0, 11.25, 13.5, 14.0, 14.1], x_m=[*range(6)], y_m=[0.0] * 6, z_m=[1.0] * 6)
    (found,), remarks = tied_to(fixes)
    assert remarks == ["2 rows of gnss beyond the poses, or of no landmark, not used"]
    np.testing.assert_array_equal(found.row, [0, 1, 2, 3])
    np.testing.assert_allclose(found.after[:, 0], [0.0, 0.25, 1.5, 0.0])
    np.testing.assert_array_equal(found.columns["x_m"], [1, 2, 3, 4])
    assert found.columns.keys() >= {"lever_x_m", "sigma_xy_m"} & {*found.kind.columns, *found.kind.optional}
    assert found.others.shape == (4, 0)
    assert tied_to(table("gnss", [5.0], x_m=[1.0], y_m=[1.0], z_m=[1.0]))[0] == ()


def test_a_measurement_of_two_instants_needs_both() -> None:
    zeros = {name: [0.0] * 4 for name in find_kinds()["closures"].columns if name != "to_stamp_s"}
    (found,), remarks = tied_to(
        table("closures", [10.5, 9.0, 10.0, 13.0], **(zeros | {"to_stamp_s": [12.5, 12.0, 15.0, 11.0]}))
    )
    assert remarks[0].startswith("2 rows of closures")
    np.testing.assert_array_equal(found.row, [0, 2])
    np.testing.assert_array_equal(found.other, [2, 1])
    np.testing.assert_allclose(found.after[:, 0], [0.5, 1.0])
    np.testing.assert_allclose(found.other_after[:, 0], [0.5, 0.0])
    turned = found.renumbered(np.array([5, 6, 7, 8]))
    np.testing.assert_array_equal([turned.row, turned.other], [[5, 7], [7, 6]])


def test_a_measurement_of_a_landmark_is_tied_to_its_place() -> None:
    ranges = table("ranges", [10.0, 10.0, 11.0, 12.0, 12.0], [9, 8, 3, 10, 7], range_m=[1.0, 2.0, 3.0, 4.0, 5.0])
    (found,), remarks = tied_to(ranges)
    assert remarks[0].startswith("2 rows of ranges")
    np.testing.assert_array_equal(found.other, [2, 0, 1])
    np.testing.assert_array_equal(found.columns["range_m"], [1.0, 3.0, 5.0])
    assert tie_measurements([ranges], POSES_S, ahead, PLACES[:0]) == ((), [remarks[0].replace("2", "5", 1)])
    # of places that are no variables none is kept, and the others are those of the variables
    view = None
    factors = MeasurementFactors.of(found, view, np.array([0, -1, 22]), 3.0, heavy=False)
    np.testing.assert_array_equal(factors.tied.columns["range_m"], [1.0, 3.0])
    np.testing.assert_array_equal(factors.other_variable, [[22], [0]])


@pytest.mark.parametrize(
    ("first", "end", "kept"), [(0, 4, [0, 1, 2]), (1, 4, [2]), (0, 3, [0]), (2, 4, []), (0, 2, [])]
)
def test_measurements_among_some_poses_are_those_that_tie_no_other(first: int, end: int, kept: list[int]) -> None:
    zeros = {name: [0.0] * 3 for name in find_kinds()["closures"].columns if name != "to_stamp_s"}
    (found,), _ = tied_to(table("closures", [10.0, 10.0, 11.0], **(zeros | {"to_stamp_s": [12.0, 14.0, 14.0]})))
    some = found.among(first, end)
    np.testing.assert_array_equal(some.row, found.row[kept] - first)
    np.testing.assert_array_equal(some.other, found.other[kept] - first)
    fixes, _ = tied_to(table("gnss", [10.0, 11.0, 14.0], x_m=[0.0] * 3, y_m=[0.0] * 3, z_m=[0.0] * 3))
    row = np.array([0, 1, 3])
    inside = row[(row >= first) & (row < end)] - first
    np.testing.assert_array_equal(fixes[0].among(first, end).row, inside)
    if first == 0:
        np.testing.assert_array_equal(fixes[0].until(end).row, inside)


def test_what_has_a_frame_of_its_own_is_left_out_where_there_is_another() -> None:
    tables = [table("gnss", [10.0], x_m=[0.0], y_m=[0.0], z_m=[0.0]), table("ranges", [10.0], [3], range_m=[1.0])]
    assert [one.kind for one in without_frames(tables)] == ["ranges"]


def test_the_nearest_stamp_is_found_also_beyond_the_ends() -> None:
    stamps, asked = np.array([0.0, 1.0, 3.0]), np.array([-5.0, 0.4, 0.5, 0.6, 2.0, 2.1, 9.0])
    assert find_nearest(stamps, asked).tolist() == [0, 0, 1, 1, 2, 2, 2]
