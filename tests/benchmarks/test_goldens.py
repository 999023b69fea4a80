"""Goldens are compared as they say: what is worse, by how much it may move, what is missing; and repeat exactly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from evermap.cli.bench import load_benchmarks
from evermap.errors import InputError
from evermap.metrics.summary import compare_with_truth
from evermap.pipeline import run_slam
from evermap.types import ChangeKind, Landmarks, MapChange
from evermap_studies.worlds.lasers import LaserWorld, simulate_laser


@pytest.fixture(scope="module")
def goldens() -> ModuleType:
    load_benchmarks()
    from benchmarks.goldens import figures

    return figures


@pytest.fixture(scope="module")
def program() -> ModuleType:
    load_benchmarks()
    from benchmarks.goldens import __main__ as found

    return found


def made(goldens: ModuleType, values: dict[str, float | None], **states: tuple[str, str]) -> Any:
    """Figures of parts that are done, but for those with another state."""
    figures = {name: goldens.Figure.of(name, value) for name, value in values.items()}
    parts = {name.partition("/")[0]: {"state": "done", "line": "", "cpu_s": 0.0} for name in values}
    parts |= {name: {"state": state, "line": line, "cpu_s": 0.0} for name, (state, line) in states.items()}
    return goldens.Figures(figures, parts, {"commit": "made"})


@pytest.mark.parametrize(
    ("name", "before", "after", "verdict"),
    [
        ("a/position_m", 0.100, 0.1029, "same"),
        ("a/position_m", 0.100, 0.1031, "worse"),
        ("a/position_m", 0.100, 0.0969, "better"),
        ("a/position_m", 0.001, 0.0014, "same"),  # within the floor of half a millimetre
        ("a/position_m", 0.001, 0.0016, "worse"),
        ("a/recall/share", 0.90, 0.88, "worse"),
        ("a/recall/share", 0.90, 0.92, "better"),
        ("a/false", 0.0, 1.0, "worse"),
        ("a/false", 2.0, 1.0, "better"),
        ("a/right", 3.0, 2.0, "worse"),
        ("a/sigma_range_m/level", 0.020, 0.021, "changed"),
        ("a/sigma_range_m/level", 0.020, 0.019, "changed"),
        ("a/sigma_range_m/level", 0.020, 0.0204, "same"),
        ("a/delay/level", -0.2, -0.21, "changed"),
        ("a/poses/nees", 20.0, 5.0, "better"),  # both too sure of themselves
        ("a/poses/nees", 0.9, 1.1, "same"),  # as far from 1, the other way
        ("a/poses/nees", 1.1, 1.3, "worse"),
        ("a/poses/nees", 1.0, 0.5, "worse"),
        ("a/poses/nees", 1.0, 0.0, "worse"),
        ("a/poses/mapped_nees", 0.1, 0.9, "same"),  # in a true map: only too much says anything
        ("a/poses/mapped_nees", 0.1, 1.2, "worse"),
        ("a/poses/mapped_nees", 1.2, 0.1, "better"),
        ("a/cpu_s", 10.0, 12.0, "same"),
        ("a/cpu_s", 10.0, 13.0, "worse"),
        ("a/cpu_s", 0.2, 0.45, "same"),
        ("a/off_m", None, 0.1, "better"),
        ("a/off_m", 0.1, None, "worse"),
        ("a/off_m", 0.1, float("nan"), "worse"),
        ("a/off_m", None, None, "same"),
    ],
)
def test_a_figure_is_judged_by_its_kind(
    goldens: ModuleType, name: str, before: float | None, after: float | None, verdict: str
) -> None:
    assert goldens.judge(goldens.Figure.of(name, before), goldens.Figure.of(name, after)) == verdict


def test_a_figure_of_no_kind_is_an_error(goldens: ModuleType) -> None:
    with pytest.raises(KeyError):
        goldens.Figure.of("a/wrong", 1.0)


def verdicts(rows: list[Any]) -> dict[str, str]:
    return {row.name: row.verdict for row in rows}


def test_missing_and_new_figures(goldens: ModuleType) -> None:
    before = made(goldens, {"a/position_m": 0.1, "a/cpu_s": 1.0})
    after = made(goldens, {"a/position_m": 0.1, "a/false": 0.0})
    rows = goldens.compare(before, after)
    assert verdicts(rows) == {"a/position_m": "same", "a/cpu_s": "missing", "a/false": "new"}


def test_parts_that_fail_or_are_absent(goldens: ModuleType) -> None:
    values = {"a/false": 0.0, "b/false": 0.0, "c/false": 0.0, "d/false": 0.0}
    before = made(goldens, values, e=("failed", "DataError: x"), f=("failed", "DataError: x"))
    after = made(
        goldens,
        {"c/false": 0.0, "e/false": 1.0},
        a=("absent", "no file"),
        b=("failed", "ValueError: y"),
        f=("failed", "DataError: z"),
    )
    rows = goldens.compare(before, after)
    # a is absent and d was not asked for: neither is compared
    assert verdicts([row for row in rows if row.name != "e/false"]) == {
        "b": "worse",
        "c/false": "same",
        "e": "better",
        "f": "same",
    }
    text = goldens.as_text(before, after, rows)
    assert "fails: ValueError: y" in text
    assert "not compared: a, d" in text
    assert "c/false" not in text


def test_exit_code_and_files(
    goldens: ModuleType, program: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is written is read again; a comparison fails if anything is worse, and only then."""
    files = [tmp_path / f"{name}.json" for name in ("before", "worse", "better")]
    for path, value in zip(files, (0.10, 0.12, 0.08), strict=True):
        made(goldens, {"a/position_m": value, "a/off_m": None}).write(path)
    assert goldens.Figures.read(files[0]) == made(goldens, {"a/position_m": 0.10, "a/off_m": None})
    assert program.main(["--compare", *map(str, files[:2])]) == 1
    assert "worse    a/position_m" in capsys.readouterr().out
    assert program.main(["--compare", str(files[0]), str(files[2])]) == 0
    assert "+0" not in (told := capsys.readouterr().out)
    assert "better   a/position_m" in told
    files[0].write_text("{}", encoding="utf-8")
    with pytest.raises(InputError, match="is no file of goldens"):
        goldens.Figures.read(files[0])


def test_one_part_that_fails_leaves_the_others(
    goldens: ModuleType, program: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its error is noted, and a run that is resumed does only it again."""
    from benchmarks.goldens.scores import MissingDataError

    runs = {"good": 0, "bad": 0, "away": 0}

    def part(name: str, error: Exception | None) -> Any:
        def run(_: Path) -> Any:
            runs[name] += 1
            yield "false", 0.0
            if error is not None:
                raise error

        return run

    errors = {"bad": ValueError("no such thing\nat all"), "good": None, "away": MissingDataError("x is not here")}
    monkeypatch.setattr(program, "warm_up", lambda: None)
    monkeypatch.setattr(program, "all_parts", lambda: {name: part(name, error) for name, error in errors.items()})
    out = tmp_path / "found.json"
    assert program.main(["--out", str(out)]) == 1
    found = goldens.Figures.read(out)
    assert {name: each["state"] for name, each in found.parts.items()} == {
        "bad": "failed", "good": "done", "away": "absent",
    }  # fmt: skip
    assert found.parts["bad"]["line"] == "ValueError: no such thing"
    assert "good/false" in found.figures
    errors["bad"] = None
    assert program.main(["--out", str(out), "--resume"]) == 0
    assert runs == {"good": 1, "bad": 2, "away": 2}
    assert program.main(["--out", str(out), "--only", "good"]) == 0
    assert goldens.Figures.read(out).parts.keys() == {"good"}


def test_the_same_commit_gives_the_same_figures(
    goldens: ModuleType, program: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """But for costs. The parts are those that need no recording and take least."""
    monkeypatch.setattr(program, "warm_up", lambda: None)
    found = [
        program.compute(tmp_path / f"{run}.json", tmp_path / "no-data", ["template", "objects"]) for run in range(2)
    ]
    first, second = ({name: one for name, one in each.figures.items() if one.group != "cost"} for each in found)
    assert first == second
    assert first["template/position_m"].value < 0.2
    assert found[0].parts["objects"]["state"] == "absent"
    assert "is not here" in found[0].parts["objects"]["line"]


def test_nees_is_that_of_the_frame_that_covariances_hold_in(program: ModuleType) -> None:
    """In a map as all stands, without what is told as changed; else from the pose that holds the frame."""
    from benchmarks.goldens.scores import typical_nees

    recording = simulate_laser(LaserWorld(duration_s=120.0), 0)
    key, random = recording.true_landmarks, np.random.default_rng(0)
    assert key is not None
    known = Landmarks.at(key.landmark_id, key.position_m, sigma_m=0.05, frame="prior_map")
    known = replace(known, position_m=known.position_m + 0.05 * random.normal(size=known.position_m.shape))
    in_map, alone = run_slam(recording, prior_map=known), run_slam(recording)

    def nees(result: Any, *, in_map: bool = True) -> tuple[float, float]:
        found = typical_nees(recording, result, rate_hz=2.0, in_map=in_map)
        assert None not in found
        return found

    assert 0.1 < min(nees(in_map)) <= max(nees(in_map)) < 3.0
    compared = compare_with_truth(recording, alone, rate_hz=2.0)
    assert compared.poses is not None
    assert compared.poses.anchored_nees is not None
    chi2_median = 1.386  # of two degrees of freedom
    assert nees(alone, in_map=False)[0] == pytest.approx(
        np.median(compared.poses.anchored_nees) / chi2_median, rel=1e-3
    )
    # all of the estimate elsewhere: an alignment would hide it
    path = replace(in_map.trajectory, pose_world_robot=in_map.trajectory.pose_world_robot + [1.0, 0.0, 0.0])
    assert nees(replace(in_map, trajectory=path))[0] > 10.0
    # most landmarks elsewhere, as the run tells
    places = in_map.landmarks
    some = places.landmark_id[: 2 * len(places) // 3]
    position = places.position_m + np.where(np.isin(places.landmark_id, some), 1.0, 0.0)[:, None]
    elsewhere = replace(in_map, landmarks=replace(places, position_m=position))
    assert nees(elsewhere)[1] > 10.0
    told = MapChange(tuple(some.tolist()), ChangeKind.MOVED, np.nan, np.nan, (1.0, 1.0), 0.0, 1.0)
    assert nees(replace(elsewhere, changes=(told,)))[1] < 3.0
