"""`evermap slam` from the command line to the files, on the template that `--init` writes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.cli.slam import default_out
from evermap.io import read_landmarks, read_recording, read_tum, write_native

# pictures have tests of their own, and take most of the time
QUICK = ["--set", "output.figures=false", "--set", "output.report=false", "--set", "output.rerun=false"]


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("input") / "template"
    result = run("slam", "--init", folder)
    assert (result.exit_code, result.stdout) == (0, "")
    assert f"evermap slam {folder}" in result.stderr
    return folder


@pytest.fixture(scope="module")
def done(template: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Folder and summary of one run."""
    out = tmp_path_factory.mktemp("output") / "run"
    result = run("slam", template, "--out", out, "--json", *QUICK)
    assert result.exit_code == 0, result.stderr
    return out, json.loads(result.stdout)


def test_json_is_all_that_is_printed_and_is_what_is_written(done: tuple[Path, dict[str, Any]]) -> None:
    out, printed = done
    assert printed == json.loads((out / "summary.json").read_text(encoding="utf-8"))


def test_stable_keys(done: tuple[Path, dict[str, Any]]) -> None:
    _, summary = done
    assert "schema_version" in summary
    for section, keys in {
        "metrics": ("pose_rmse_m", "heading_rmse_deg", "landmark_rmse_m"),
        "timing": ("real_time_factor", "step_p99_ms"),
    }.items():
        for key in keys:
            assert key in summary[section]
    assert summary["config"]["slam"]["sensor_model"] == "calibrated"
    assert summary["seeds"] == {"slam": 0}
    assert summary["interrupted"] is False


def test_written_files_agree_with_the_recording(done: tuple[Path, dict[str, Any]], template: Path) -> None:
    out, _ = done
    recording = read_recording(template)
    landmarks = read_landmarks(out / "map.parquet")
    assert set(landmarks.landmark_id) <= set(recording.detections.landmark_id)
    trajectory = read_tum(out / "trajectory.tum")
    assert trajectory.stamp_s[0] >= recording.odometry.stamp_s[0] - 1e-6
    assert np.isin(recording.frames.stamp_s[recording.detections.frame], trajectory.stamp_s).all()


def test_table_without_json(template: Path, tmp_path: Path) -> None:
    result = run("slam", template, "--out", tmp_path / "run", *QUICK)
    assert result.exit_code == 0
    assert "position error, RMSE" in result.stdout
    assert str(tmp_path / "run" / "summary.json") in result.stdout
    assert "{" not in result.stdout


def test_out_defaults_to_the_name_of_the_recording(
    template: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run("slam", template, *QUICK).exit_code == 0
    out = default_out(read_recording(template).name)
    assert (tmp_path / out / "summary.json").is_file()
    assert run("slam", template, *QUICK).exit_code == 0, "an older run is replaced without asking"


@pytest.mark.parametrize(
    ("name", "folder"),
    [
        ("MRCLAM_Dataset6 robot 1", "mrclam_dataset6-robot-1"),
        ("../../etc", "etc"),
        ("Halle 3 / früh", "halle-3-fr-h"),
        ("...", "run"),
    ],
)
def test_default_out_is_one_plain_folder(name: str, folder: str) -> None:
    assert default_out(name) == Path("evermap-out") / folder


def test_prior_map_puts_the_run_into_its_frame(template: Path, tmp_path: Path) -> None:
    survey = read_recording(template).true_landmarks
    assert survey is not None
    (tmp_path / "map.csv").write_text(
        "landmark_id,x_m,y_m\n"
        + "".join(f"{i},{x},{y}\n" for i, (x, y) in zip(survey.landmark_id, survey.position_m, strict=True)),
        encoding="utf-8",
    )
    positions = []
    for prior in ("truth", str(tmp_path / "map.csv")):
        out = tmp_path / "run"
        result = run("slam", template, "--out", out, "--prior-map", prior, "--prior-sigma", "0.001", "--json", *QUICK)
        assert result.exit_code == 0, result.stderr
        assert json.loads(result.stdout)["frames"]["map"].startswith("prior_map")
        landmarks = read_landmarks(out / "map.parquet")
        known = np.isin(landmarks.landmark_id, survey.landmark_id)
        expected = survey.position_m[np.searchsorted(survey.landmark_id, landmarks.landmark_id[known])]
        assert landmarks.position_m[known] == pytest.approx(expected, abs=0.004)
        positions.append(landmarks.position_m)
    np.testing.assert_allclose(*positions, atol=1e-9)


def test_prior_map_of_a_recording_without_survey_is_the_users_mistake(template: Path, tmp_path: Path) -> None:
    recording = replace(read_recording(template), true_landmarks=None)
    write_native(recording, tmp_path / "bare")
    result = run("slam", tmp_path / "bare", "--out", tmp_path / "run", "--prior-map", "truth")
    assert result.exit_code == 2
    assert "--prior-map" in result.stderr
    assert not (tmp_path / "run").exists()


def test_interrupted_run_is_written_and_says_so(
    template: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import evermap.pipeline

    whole = evermap.pipeline.run_slam

    def stopped(*arguments: Any, **options: Any) -> Any:
        return replace(whole(*arguments, **options), interrupted=True)

    monkeypatch.setattr("evermap.pipeline.run_slam", stopped)
    result = run("slam", template, "--out", tmp_path / "run", "--json", *QUICK)
    assert result.exit_code == 130
    assert f"is in {tmp_path / 'run'}" in result.stderr
    assert json.loads(result.stdout)["interrupted"] is True
    assert (tmp_path / "run" / "map.parquet").is_file()
