"""Objects show themselves: one short line, a small table, a data frame, a figure."""

from __future__ import annotations

import dataclasses
import sys
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest

import evermap
from evermap import types
from evermap.errors import MissingExtraError
from evermap.existence.sites import Evidence
from evermap.maps.living import LivingMap
from evermap.maps.sessions.session import Session
from evermap.metrics.landmarks import evaluate_landmarks
from evermap.metrics.summary import compare_with_truth
from evermap.metrics.trajectory import evaluate_trajectory
from evermap.runs.sessions import Entered
from evermap.show import LONGEST, Shown, ShownTable
from evermap.slam.check import Check
from evermap.slam.mistakes import Finding
from evermap.survival import Exponential, PiecewiseConstantHazard, StepLifetime, Weibull
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.hazard_regression import HazardDraws
from evermap.survival.nonparametric import kaplan_meier, npmle
from evermap.survival.parametric_fit import fit
from evermap.types import (
    Alternative,
    ChangeKind,
    Detections,
    Frames,
    Innovations,
    Landmarks,
    MapChange,
    Measurements,
    Misses,
    Odometry,
    Recording,
    RobotSightings,
    SlamResult,
    SpatialDetections,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
    Trajectory,
    Up,
)

N = 1500
RNG = np.random.default_rng(0)
STAMPS = np.arange(N) * 0.1
IDS = np.arange(N)
WHOLE = np.zeros(N, dtype=np.int64)


def trajectory(noise: float = 0.0) -> Trajectory:
    poses = np.column_stack([np.cos(STAMPS), np.sin(STAMPS), np.zeros(N)]) + noise * RNG.normal(size=(N, 3))
    return Trajectory(STAMPS, poses, np.tile(0.01 * np.eye(3), (N, 1, 1)))


LANDMARKS = dataclasses.replace(
    Landmarks.at(IDS, RNG.normal(size=(N, 2)), sigma_m=0.1, class_id=WHOLE, class_names=("door",)),
    names={1: "the red door"},
    n_hits=np.full(N, 20),
)
NAMED = MapChange(tuple(range(N)), ChangeKind.MOVED, float("nan"), 1.0, (1.0, 0.0), 0.0, 0.9, names=("a" * 500,) * N)
FEW = dataclasses.replace(NAMED, landmark_ids=(1, 2), names=())
RECORDING = Recording(
    name="a <hall>" + 500 * "x",
    odometry=Odometry(STAMPS, STAMPS, STAMPS, STAMPS),
    frames=Frames(STAMPS),
    detections=Detections(IDS, IDS % 9 - 1, STAMPS, STAMPS, WHOLE, STAMPS, STAMPS, WHOLE),
    truth=trajectory(),
    true_landmarks=LANDMARKS,
    robot_sightings=RobotSightings(STAMPS, IDS, STAMPS, STAMPS),
    warnings=("a warning",) * N,
    measurements=(Measurements("floor", STAMPS, {"z_m": STAMPS}, IDS),),
)
RESULT = SlamResult(
    trajectory=trajectory(0.1),
    online=trajectory(0.2),
    landmarks=LANDMARKS,
    parameters=(),
    innovations=Innovations(STAMPS, IDS, IDS, STAMPS, np.ones(N)),
    misses=Misses(WHOLE, IDS, np.full(N, 0.5)),
    step_s=STAMPS,
    dead_reckoning=trajectory(0.3),
    changes=(FEW,) * 2,
    alternatives=(Alternative((NAMED,), 0.1, LANDMARKS),),
)
POSES = np.tile([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0], (N, 1))
SPATIAL = SpatialRecording(
    name="a hall",
    odometry=SpatialOdometry(STAMPS, POSES, np.full((N, 6), np.nan)),
    frames=Frames(STAMPS),
    detections=SpatialDetections(
        frame=IDS,
        sensor=WHOLE,
        landmark_id=IDS % 9 - 1,
        position_sensor_m=POSES[:, :3],
        rotation=POSES[:, 3:],
        covariance_sensor_m2=np.tile(np.eye(3), (N, 1, 1)),
        sigma_rad=STAMPS,
        corner_px=np.zeros((N, 4, 2)),
        tag_size_m=STAMPS,
        size_m=POSES[:, :3],
        class_id=WHOLE,
        score=STAMPS,
        source_line=WHOLE,
    ),
    sensors=(SpatialSensor(),),
)
LIFETIMES = CensoredLifetimes.of(STAMPS[:200], np.where(IDS[:200] % 3 > 0, STAMPS[:200] + 2.0, np.inf))
EXACT = CensoredLifetimes.of(STAMPS[1:200], STAMPS[1:200])
EDGES = tuple(STAMPS.tolist())
SESSION = Session(
    LivingMap(),
    True,
    RECORDING,
    RESULT,
    (NAMED,) * N,
    Evidence(IDS, STAMPS, WHOLE, WHOLE, STAMPS, STAMPS, STAMPS),
    ("a reason",) * N,
)
OBJECTS: dict[str, Any] = {
    type(one).__name__: one
    for one in (
        RECORDING,
        RESULT,
        LANDMARKS,
        NAMED,
        RECORDING.odometry,
        SPATIAL,
        SPATIAL.odometry,
        SPATIAL.detections,
        SPATIAL.sensors[0],
        RECORDING.frames,
        RECORDING.detections,
        RECORDING.truth,
        RECORDING.robot_sightings,
        RECORDING.measurements[0],
        RESULT.innovations,
        RESULT.misses,
        RESULT.alternatives[0],
        LIFETIMES,
        kaplan_meier(EXACT),
        npmle(LIFETIMES),
        fit("exponential", LIFETIMES),
        HazardDraws(STAMPS, np.ones((100, N))),
        evaluate_trajectory(RESULT.trajectory, trajectory()),
        evaluate_landmarks(LANDMARKS, LANDMARKS, np.zeros(3)),
        compare_with_truth(RECORDING, RESULT),
        PiecewiseConstantHazard(EDGES, (1.0,) * N),
        SESSION,
        Entered(SESSION, LivingMap(), LivingMap(), (NAMED,) * N, ("monday",) * N, 3, {"a": bytes(N)}, (0.0, 1.0)),
        Check("a", "b", {"frames": {"rows": N}}, (Finding("clock", "late " * N),) * N, ("a warning",) * N),
        Up(np.array([0.0, 0.0, 1.0]), 0.02, "imu"),
        StepLifetime.at_points(EDGES[1:], (1.0 / (N - 1),) * (N - 1)),
    )
}
TABLES = [name for name, one in OBJECTS.items() if isinstance(one, ShownTable)]
PICTURES = [name for name, one in OBJECTS.items() if hasattr(one, "plot")]


@pytest.mark.parametrize("name", OBJECTS)
def test_text_is_one_short_line_with_the_name(name: str) -> None:
    text = repr(OBJECTS[name])
    assert text.startswith(f"{name}(")
    assert len(text) < 1000
    assert "\n" not in text
    assert "array(" not in text
    assert LONGEST < 1000


def test_text_says_what_matters() -> None:
    assert repr(RECORDING.frames) == "Frames(rows=1500, from_s=0.0, to_s=149.9, complete=True, clock='recording')"
    assert repr(RECORDING.detections) == "Detections(rows=1500, landmarks=8, range_m=(0.0, 149.9))"
    for part in ("landmarks=1500", "changes=2", "alternatives=1", "length_m=", "interrupted=False"):
        assert part in repr(RESULT)
    assert repr(Frames([])) == "Frames(rows=0, complete=True, clock='recording')"
    assert repr(Weibull(2.5, 0.1 + 0.2)) == "Weibull(scale_s=2.5, shape=0.30000000000000004)"


@pytest.mark.parametrize("name", OBJECTS)
def test_html_is_a_small_table(name: str) -> None:
    html = OBJECTS[name]._repr_html_()
    assert len(html) < 3000
    opened: list[str] = []

    class Tags(HTMLParser):
        def handle_starttag(self, tag: str, attrs: Any) -> None:
            opened.append(tag)

        def handle_endtag(self, tag: str) -> None:
            assert opened.pop() == tag

    Tags().feed(html)
    assert not opened
    assert "<hall>" not in html


def test_every_type_with_columns_shows_itself() -> None:
    home = f"{types.__name__}."
    found = [c for c in vars(types).values() if dataclasses.is_dataclass(c) and c.__module__.startswith(home)]
    arrays = {c.__name__ for c in found if any("Array" in str(item.type) for item in dataclasses.fields(c))}
    assert {c.__name__ for c in found if issubclass(c, Shown)} >= arrays
    assert arrays <= OBJECTS.keys()
    assert {"SlamResult", "Landmarks", "Odometry"} <= arrays


@pytest.mark.parametrize("name", TABLES)
def test_data_frames_have_a_row_an_item_and_no_column_of_arrays(name: str) -> None:
    pytest.importorskip("pandas")
    table = OBJECTS[name].to_pandas()
    first = next(v for v in vars_of(OBJECTS[name]) if isinstance(v, np.ndarray))
    assert len(table) == len(first)
    assert all(np.isscalar(value) for value in table.iloc[0])


def vars_of(one: Any) -> list[Any]:
    return [getattr(one, item.name) for item in dataclasses.fields(one)]


def test_columns_of_a_map_and_of_a_path() -> None:
    pytest.importorskip("pandas")
    table = LANDMARKS.to_pandas()
    np.testing.assert_array_equal(table[["x_m", "y_m"]], LANDMARKS.position_m)
    np.testing.assert_array_equal(table["cov_xy_m2"], LANDMARKS.covariance_m2[:, 0, 1])
    assert table["name"][1] == "the red door"
    assert set(table["class"]) == {"door"}
    tags = Landmarks.in_space(IDS, POSES[:, :3], rotation=POSES[:, 3:], size_m=POSES[:, :3])
    assert {"z_m", "cov_xz_m2", "qw", "rotation_cov_xx", "rotation_cov_zz", "size_z_m"} <= set(tags.to_pandas())
    assert "z_m=(3.0, 3.0)" in repr(tags)
    path = RESULT.trajectory.to_pandas()
    np.testing.assert_array_equal(path[["x_m", "y_m", "theta_rad"]], RESULT.trajectory.pose_world_robot)
    np.testing.assert_array_equal(path["cov_tt"], RESULT.trajectory.covariance[:, 2, 2])
    errors = OBJECTS["PoseErrors"].to_pandas()
    np.testing.assert_array_equal(errors["truth_y_m"], OBJECTS["PoseErrors"].truth[:, 1])
    places = evaluate_landmarks(dataclasses.replace(tags, n_hits=IDS), tags, np.array([0, 0, 0, 0, 0, 0, 1.0]))
    assert places is not None
    assert {"truth_z_m", "error_m", "orientation_error_rad"} <= set(places.to_pandas())


def test_without_pandas_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match="pip install pandas"):
        LANDMARKS.to_pandas()


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_are_figures(name: str) -> None:
    from matplotlib.figure import Figure

    figure = OBJECTS[name].plot()
    assert isinstance(figure, Figure)
    figure.draw_without_rendering()
    assert figure.axes


def test_pictures_of_the_empty_and_of_the_whole() -> None:
    assert Landmarks.at([], np.zeros((0, 2))).plot().axes
    assert Landmarks.at([7], [[1.0, 2.0]]).plot().axes[0].texts[0].get_text() == "7"
    assert RESULT.plot(RECORDING).axes
    assert Exponential(1.0).plot(until_s=3.0).axes


def test_public_names_of_what_a_user_needs() -> None:
    assert evermap.parse_prior("exponential:rate=1/s") == Exponential(1.0)
    assert evermap.PersistenceFilter("exponential:rate=1/s").predict(0.0) == 1.0
    assert evermap.Localizer.__name__ == "Localizer"
    assert evermap.Tracker.__name__ == "Tracker"
