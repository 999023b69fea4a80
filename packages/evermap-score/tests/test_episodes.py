"""The table of episodes: a round trip, and one line for every mistake."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evermap_score import ScoreError, read_episodes, read_looks, write_episodes
from evermap_score.episodes import COLUMNS, episodes_from_rows, rows_of

FULL = {
    "landmark_id": "door 3", "class_id": "door", "t_from_s": 1.5, "t_to_s": 2.25, "x_m": 1.0, "y_m": -2.0, "z_m": 0.1,
    "qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "length_m": 1.0, "width_m": 2.0, "height_m": 3.0,
    "cov_xx_m2": 0.1, "cov_xy_m2": 0.01, "cov_xz_m2": 0.02, "cov_yy_m2": 0.2, "cov_yz_m2": 0.03, "cov_zz_m2": 0.3,
    "p": 0.7, "n_looks": 3.0, "robot_time_s": 9.0,
}  # fmt: skip
PLAIN = {"landmark_id": 7, "t_from_s": None, "t_to_s": "", "x_m": "1e3", "y_m": 0}


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_a_table_is_the_same_after_a_round_trip(ending: str, tmp_path: Path) -> None:
    assert set(FULL) == set(COLUMNS)
    table = episodes_from_rows([FULL, FULL | {"t_to_s": None, "p": None}])
    write_episodes(table, tmp_path / f"table.{ending}")
    read = read_episodes(tmp_path / f"table.{ending}")
    assert rows_of(read) == rows_of(table)
    assert rows_of(read)[0] == FULL
    assert read.covariance_m2[0].tolist() == [[0.1, 0.01, 0.02], [0.01, 0.2, 0.03], [0.02, 0.03, 0.3]]
    assert read.p.tolist() == [0.7, 1.0]
    assert read.in_space


def test_what_is_missing_is_unknown_and_open() -> None:
    table = episodes_from_rows([PLAIN])
    assert table.landmark_id.tolist() == ["7"]
    assert (table.t_from_s[0], table.t_to_s[0], table.p[0]) == (-np.inf, np.inf, 1.0)
    assert not table.in_space
    assert table.is_present(0.0).all()


def test_the_end_is_excluded() -> None:
    table = episodes_from_rows([PLAIN | {"t_from_s": 1, "t_to_s": 2}])
    assert [bool(table.is_present(stamp_s)[0]) for stamp_s in (0.9, 1.0, 1.9, 2.0)] == [False, True, True, False]


def test_at_one_instant_a_landmark_is_at_its_most_probable_place() -> None:
    rows = [PLAIN | {"x_m": n, "p": p} for n, p in enumerate((0.2, 0.7, 0.6))] + [PLAIN | {"landmark_id": 8, "p": 0.3}]
    table = episodes_from_rows(rows)
    assert table.state_at(0.0).position_m[:, 0].tolist() == [1.0, 1000.0]
    assert table.state_at(0.0, 0.5).landmark_id.tolist() == ["7"]


def test_maps_by_robot_time() -> None:
    table = episodes_from_rows([PLAIN | {"robot_time_s": 10}, PLAIN | {"robot_time_s": 20, "x_m": 5}])
    assert table.robot_times_s().tolist() == [10.0, 20.0]
    assert len(table.select_map(9.0)) == 0
    assert table.select_map(19.0).position_m[:, 0].tolist() == [1000.0]
    assert table.latest().position_m[:, 0].tolist() == [5.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("landmark_id,x_m,y_m\na,0,0\n", "bad.csv: no column t_from_s, t_to_s"),
        ("landmark_id,t_from_s,t_to_s,x_m,y_m\na,,,0,0\nb,,,zero,0\n", "bad.csv:3: x_m is not a number: 'zero'"),
        ("landmark_id,t_from_s,t_to_s,x_m,y_m\na,,,,0\n", "bad.csv:2: x_m and y_m must be finite"),
        ("landmark_id,t_from_s,t_to_s,x_m,y_m\na,2,2,0,0\n", "bad.csv:2: t_to_s must be after t_from_s"),
        ("landmark_id,t_from_s,t_to_s,x_m,y_m,p\na,,,0,0,1.1\n", "bad.csv:2: p must be between 0 and 1"),
        ("landmark_id,t_from_s,t_to_s,x_m,y_m\n,,,0,0\n", "bad.csv:2: no landmark_id"),
    ],
)
def test_a_mistake_is_named_by_file_line_and_column(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "bad.csv").write_text(text, encoding="utf-8")
    with pytest.raises(ScoreError) as error:
        read_episodes(tmp_path / "bad.csv")
    assert message in str(error.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "bad.parquet").write_bytes(b"PAR0")
    (tmp_path / "bad.csv").write_bytes(b"\xff\xfe\x00")
    for name in ("bad.parquet", "bad.csv", "none.csv", "none.parquet"):
        with pytest.raises(ScoreError, match=name):
            read_episodes(tmp_path / name)


def test_looks(tmp_path: Path) -> None:
    path = tmp_path / "looks.csv"
    path.write_text("stamp_s,landmark_id,session_id\n1,a,mon\n2,a,mon\n3,a,tue\n3,b,tue\n", encoding="utf-8")
    looks = read_looks(path)
    assert looks.session_ends_s().tolist() == [2.0, 3.0]
    # after the first instant, until the last one
    assert [looks.count("a", *span) for span in ((0, 9), (1, 3), (1, 2.9), (3, 9))] == [3, 2, 1, 0]
