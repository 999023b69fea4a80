"""The one alignment, by what is static in both, and the error of trajectories after it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from evermap_score import Episodes, ScoreError, episodes_from_rows, score, write_episodes
from evermap_score.matching import align, apply_alignment, choose_instants
from evermap_score.trajectory import read_tum

from .worlds import looks_at, table, world_of

TRUTH = table(
    ("a", None, None, 0, 0), ("b", None, None, 6, 0), ("c", None, None, 0, 4),
    ("m", None, 15, 3, 3), ("m", 15, None, 5, 3), ("v", None, 15, 8, 8),
)  # fmt: skip


def turn(episodes: Episodes, angle: float = 0.4, shift: tuple[float, float] = (2.0, -1.0)) -> Episodes:
    cos, sin = math.cos(angle), math.sin(angle)
    return episodes.move(np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]]), np.array([*shift, 0.0]))


def test_another_frame_is_found_by_static_landmarks_alone() -> None:
    estimate = turn(TRUTH)
    # m moved elsewhere, v is somewhere else: neither is static, so neither bends the alignment
    estimate.position_m[4, :2] += 0.7
    estimate.position_m[5, :2] += 3.0
    alignment = align(world_of(TRUTH, estimate), estimate)
    assert alignment.n_static == 3
    assert alignment.rms_m == pytest.approx(0.0, abs=1e-12)
    assert apply_alignment(estimate, alignment).position_m[:4, :2] == pytest.approx(TRUTH.position_m[:4, :2])


def test_a_static_landmark_at_a_wrong_place_does_not_bend_the_frame() -> None:
    truth = table(*((str(n), None, None, 3.0 * (n % 4), 2.5 * (n // 4)) for n in range(12)))
    estimate = turn(truth)
    estimate.position_m[0, :2] += 2.0
    alignment = align(world_of(truth, estimate), estimate)
    off_m = np.linalg.norm((apply_alignment(estimate, alignment).position_m - truth.position_m)[1:, :2], axis=1)
    # Huber's influence of one of twelve is that of .1 m, here .1 m / 12 in the mean; least squares would be .2 m off
    assert off_m.max() < 0.03
    assert alignment.rms_m == pytest.approx(2.0 * math.sqrt(2.0 / 12), rel=0.02)


def test_a_covariance_turns_with_the_frame() -> None:
    estimate = turn(table(("a", None, None, 0, 0), cov_xx_m2=0.04, cov_xy_m2=0.0, cov_yy_m2=0.01), math.pi / 2)
    assert estimate.covariance_m2[0, :2, :2] == pytest.approx(np.diag([0.01, 0.04]))


@pytest.mark.parametrize("keep", [["a"], ["m", "v"]])
def test_too_few_static_landmarks_are_no_alignment(keep: list[str]) -> None:
    estimate = turn(TRUTH[np.isin(TRUTH.landmark_id, keep)])
    assert align(world_of(TRUTH, estimate), estimate).n_static == 0


def test_without_identities_frames_are_the_same() -> None:
    estimate = turn(table(("x", None, None, 0, 0), ("y", None, None, 6, 0), ("z", None, None, 0, 4)))
    assert align(world_of(TRUTH, estimate), estimate).n_static == 0


def test_in_space_three_landmarks_in_one_line_are_no_alignment() -> None:
    def line(bend: float) -> Episodes:
        return episodes_from_rows(
            {"landmark_id": n, "t_from_s": None, "t_to_s": None, "x_m": n, "y_m": bend * (n == 1), "z_m": 0.0}
            for n in range(3)
        )

    for bend, n_static in ((0.0, 0), (1.0, 3)):
        assert align(world_of(line(bend), line(bend)), line(bend)).n_static == n_static


def test_a_mirror_image_is_not_a_rotation() -> None:
    mirrored = table(("a", None, None, 0, 0), ("b", None, None, -6, 0), ("c", None, None, 0, 4))
    alignment = align(world_of(TRUTH, mirrored), mirrored)
    assert np.linalg.det(alignment.rotation) == pytest.approx(1.0)
    assert alignment.rms_m > 0.5


def write_tum(path: Path, points: list[tuple[float, float, float]]) -> None:
    path.write_text("# stamp x y z\n" + "".join(f"{t} {x} {y} 0 0 0 0 1\n" for t, x, y in points), encoding="utf-8")


def test_error_of_a_trajectory_after_the_alignment_of_the_map(tmp_path: Path) -> None:
    write_episodes(TRUTH, tmp_path / "truth.csv")
    write_episodes(turn(TRUTH), tmp_path / "ours.csv")
    write_tum(tmp_path / "truth.tum", [(t, t, 0.0) for t in range(5)])
    # .3 m beside the path, in the other frame, at half the stamps only, and not at the last one
    cos, sin = math.cos(0.4), math.sin(0.4)
    there = [(t, cos * t - sin * 0.3 + 2, sin * t + cos * 0.3 - 1) for t in (0.0, 2.0, 3.0)]
    write_tum(tmp_path / "ours.tum", there)
    found = score(tmp_path / "truth.csv", tmp_path / "ours.csv", draws=0)
    assert found["localisation/ate"].value == pytest.approx(0.3)
    assert math.isnan(score(tmp_path / "truth.csv", TRUTH, draws=0)["localisation/ate"].value)


def test_a_trajectory_that_is_wrong_is_named_by_its_line(tmp_path: Path) -> None:
    path = tmp_path / "bad.tum"
    for text, message in (
        ("0 0 0 0 0 0 0 1\n1 2 3\n", "bad.tum:2: not 'stamp"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "bad.tum:2: stamps must increase"),
    ):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(ScoreError, match=message):
            read_tum(path)
    with pytest.raises(ScoreError, match="cannot be read"):
        read_tum(tmp_path / "none.tum")


def test_instants() -> None:
    # bounds 15 and 25, and from 25 on nothing: 14, 20; after the last change, 26
    truth = table(("a", None, 15, 0, 0), ("b", 15, 25, 0, 0))
    assert choose_instants(truth, [], None)[0].tolist() == [14.0, 20.0, 26.0]
    # the first and the last are beyond what estimates state, too
    late = table(("a", 3, 29, 0, 0))
    assert choose_instants(truth, [late], None)[0].tolist() == [2.0, 20.0, 30.0]
    # before 15 there is nothing
    assert choose_instants(table(("b", 15, 25, 0, 0)), [], None)[0].tolist() == [20.0, 26.0]
    ends, are_sessions = choose_instants(truth, [], looks_at([5.0, 50.0], {"a": [1.0]}))
    assert ends.tolist() == [5.0, 50.0]
    assert are_sessions
