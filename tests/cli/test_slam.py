"""`evermap slam` from the command line to the files, on the template that `--init` writes."""

from __future__ import annotations

import html
import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from evermap import run_slam
from evermap.cli.main import app
from evermap.cli.options import default_out
from evermap.cli.slam import HELP
from evermap.config import SlamConfig
from evermap.io import parse_shift, read_landmarks, read_recording, read_tum, write_native, write_template

# pictures have tests of their own, and take most of the time
QUICK = ["--set", "output.figures=false", "--set", "output.report=false", "--set", "output.rerun=false"]


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("input") / "template"
    result = run("init", "recording", folder)
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
        ("Looks.csv.gz", "looks"),
    ],
)
def test_default_out_is_one_plain_folder(name: str, folder: str) -> None:
    assert default_out(name) == Path("evermap-out") / folder


def test_the_first_result_argues_for_itself(template: Path, tmp_path: Path, done: tuple[Path, dict[str, Any]]) -> None:
    """Odometry that drifts is put right, and the cart that an older map has elsewhere is told."""
    metrics = done[1]["metrics"]
    assert 10.0 * metrics["pose_rmse_m"] < metrics["dead_reckoning_rmse_m"]
    result = run(
        "slam", template, "--out", tmp_path, "--prior-map", template / "survey.csv", "--json", "--force", *QUICK
    )
    assert result.exit_code == 0, result.stderr
    best = max(json.loads(result.stdout)["changes"], key=lambda change: change["probability"])
    assert best["landmarks"] == [4]
    assert best["probability"] > 0.8
    assert best["displacement_m"] == pytest.approx([0.3, 1.1], abs=0.05)


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
        result = run("slam", template, "--out", out, "--prior-map", f"{prior},sigma=0.001", "--json", *QUICK)
        assert result.exit_code == 0, result.stderr
        assert json.loads(result.stdout)["frames"]["map"].startswith("prior_map")
        landmarks = read_landmarks(out / "map.parquet")
        known = np.isin(landmarks.landmark_id, survey.landmark_id)
        expected = survey.position_m[np.searchsorted(survey.landmark_id, landmarks.landmark_id[known])]
        assert landmarks.position_m[known] == pytest.approx(expected, abs=0.004)
        positions.append(landmarks.position_m)
    np.testing.assert_allclose(*positions, atol=1e-9)


def test_the_covariances_of_a_prior_map_count(template: Path, tmp_path: Path) -> None:
    """A landmark whose own covariance is small stays where the file says, one with a large one goes where it is."""
    survey = read_recording(template).true_landmarks
    assert survey is not None
    wrong_m = 0.2
    written = {}
    for sigma_m in (1e-3, 3.0):
        path = tmp_path / f"map-{sigma_m}.csv"
        rows = [
            f"{i},{x + (wrong_m if row == 0 else 0.0)},{y},{(sigma_m if row == 0 else 1e-3) ** 2},0,{1e-6}"
            for row, (i, (x, y)) in enumerate(zip(survey.landmark_id, survey.position_m, strict=True))
        ]
        path.write_text("\n".join(["landmark_id,x_m,y_m,cov_xx_m2,cov_xy_m2,cov_yy_m2", *rows]), encoding="utf-8")
        out = tmp_path / "run"
        result = run("slam", template, "--out", out, "--prior-map", path, "--set", "method=nohyp", "--json", *QUICK)
        assert result.exit_code in {0, 3}, result.stderr  # a map that is wrong by 200 standard deviations is suspicious
        landmarks = read_landmarks(out / "map.parquet")
        row = int(np.searchsorted(landmarks.landmark_id, survey.landmark_id[0]))
        written[sigma_m] = landmarks.position_m[row, 0] - survey.position_m[0, 0]
    assert written[1e-3] == pytest.approx(wrong_m, abs=0.01)
    assert abs(written[3.0]) < 0.5 * wrong_m


def test_shift_moves_landmarks_of_the_prior_map(
    template: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the estimator is given, and that the words of what it found close the output."""
    import evermap.cli.warmup  # which keeps the `run_slam` that it finds
    import evermap.pipeline

    survey = read_recording(template).true_landmarks
    assert survey is not None
    first, second = survey.landmark_id[:2].tolist()
    whole, given = evermap.pipeline.run_slam, []

    def found(recording: Any, config: Any, **options: Any) -> Any:
        given.append((config, options["prior_map"]))
        result = whole(recording, config, **options)
        change = parse_shift(f"{first}:1,-0.5").undone(result.trajectory.stamp_s[0])
        return replace(result, changes=(replace(change, probability=0.99),))

    monkeypatch.setattr("evermap.pipeline.run_slam", found)
    shifts = ["--shift", f"{first}:1,-0.5", "--shift", f"{second}:0.25"]
    result = run(
        "slam", template, "--out", tmp_path / "run", "--prior-map", "truth", *shifts, "--set", "method=nohyp", *QUICK
    )
    assert result.exit_code == 0, result.stderr
    ((config, prior),) = given
    assert (config.slam.method, config.slam.unknown_ids) == ("nohyp", False)
    moved = prior.position_m - survey.position_m
    assert moved[:2] == pytest.approx(np.array([[1.0, -0.5], [0.25, 0.0]]))
    assert not moved[2:].any()
    words = f"landmark {first} moved by (-1.00, +0.50) m before the session, probability 99 %"
    assert result.stdout.splitlines()[-2] == words


def test_shortcuts_are_settings() -> None:
    shown = run("slam", "--set", "method=viterbi", "--unknown-ids", "--show-config")
    settings = tomllib.loads(shown.stdout)["slam"]
    assert (settings["method"], settings["unknown_ids"]) == ("viterbi", True)
    plain = tomllib.loads(run("slam", "--show-config").stdout)["slam"]
    assert (plain["method"], plain["unknown_ids"]) == (SlamConfig().method, False)
    choices = get_args(SlamConfig.model_fields["method"].annotation)
    assert [name for name in choices if name != SlamConfig().method and name not in HELP] == []


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--prior-map", "truth", "--shift", "one:1.0"], "'one' is not a landmark id"),
        (["--prior-map", "truth", "--shift", "987654:1.0"], "no landmark 987654 in the prior map"),
        (["--prior-map", "truth,sigma=-1"], "'--prior-map': '-1' is no standard deviation [m] (try: truth,sigma=0.1)"),
        (["--prior-map", "truth,sigma=wide"], "'wide' is no standard deviation [m]"),
        (["--set", "method=guess"], "field 'slam.method': input should be 'nohyp'"),
    ],
)
def test_wrong_shifts_and_methods_are_one_line(
    options: list[str], problem: str, template: Path, tmp_path: Path
) -> None:
    result = run("slam", template, "--out", tmp_path / "run", *options)
    assert result.exit_code == 2
    assert problem in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "run").exists()


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


def test_a_condensed_session_gives_the_map_of_the_recording(template: Path, tmp_path: Path) -> None:
    file = tmp_path / "session.zip"
    result = run("convert", template, file, "--format", "session")
    assert result.exit_code == 0, result.stderr
    assert f"wrote the session for a map to {file}" in result.stderr
    assert read_recording(file).truth is None
    maps = []
    for name, recording in (("whole", template), ("condensed", file)):
        result = run("map", "enter", tmp_path / f"{name}.evermap", recording, "--out", tmp_path / name, *QUICK)
        assert result.exit_code == 0, result.stderr
        maps.append(read_landmarks(tmp_path / name / "map.parquet"))
    np.testing.assert_array_equal(maps[0].landmark_id, maps[1].landmark_id)
    np.testing.assert_allclose(maps[0].position_m, maps[1].position_m, atol=0.01)
    np.testing.assert_allclose(maps[0].p_exists, maps[1].p_exists, atol=0.01)
    for recording, said in ((template, "is there already"), (file, "is the input of this command")):
        before = file.read_bytes()
        result = run("convert", recording, file, "--format", "session", *(["--force"] if recording == file else []))
        assert result.exit_code == 2
        assert said in result.stderr
        assert file.read_bytes() == before


def test_robots_of_one_time_are_solved_together(template: Path, tmp_path: Path) -> None:
    """Two robots that drove and saw the same: both in the first one's frame, and as it is alone."""
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        write_native(read_recording(template), folder)
    result = run("together", first, second, "--out", tmp_path / "out", *QUICK)
    assert result.exit_code == 0, result.stderr
    outs = [tmp_path / "out" / name for name in ("template-1", "template-2")]
    maps = [read_landmarks(out / "map.parquet") for out in outs]
    np.testing.assert_allclose(maps[0].position_m, maps[1].position_m)
    paths = [read_tum(out / "trajectory.tum").pose_world_robot for out in outs]
    np.testing.assert_allclose(paths[0], paths[1], atol=0.02)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "'INPUT...': there is one robot"),
        (["--prior-map", "truth"], "--prior-map"),
        (["--robot", "1"], "--robot"),
        (["--set", "living.search=gate"], "not read without a map"),
    ],
)
def test_what_is_for_one_robot_is_refused(template: Path, options: list[str], said: str) -> None:
    result = run("together", template, *options)
    assert result.exit_code == 2
    assert said in result.stderr


@pytest.mark.parametrize(
    ("in_space", "options", "words"),
    [
        (False, ["--set", "slam.space.delay_sigma_s=1"], ["slam.space.delay_sigma_s", "in the plane"]),
        (False, ["--set", "track.rest_for_s=1"], ["track.rest_for_s", "in the plane"]),
        (False, ["--set", "living.search=gate"], ["living.search", "without a map"]),
        (False, ["--set", "slam.association.p_new=0.3"], ["slam.association.p_new", "without --unknown-ids"]),
        (False, ["--set", "persist.rows_at_once=3"], ["persist.rows_at_once", "by this command"]),
        (True, ["--set", "slam.calibration.fix.range_slope=0"], ["slam.calibration.fix.range_slope", "in space"]),
        (True, ["--set", "outlier_log_odds=9"], ["slam.outlier_log_odds", "in space"]),
        (True, ["--set", "method=nn"], ["slam.method", "in space"]),
        (True, ["--set", "sensor_model=plain"], ["slam.sensor_model", "in space"]),
        (True, ["--set", "track.rest_for_s=1"], ["track.rest_for_s", "without boxes"]),
        (True, ["--set", "sensor.sigma_bearing_rad=1"], ["sensor.sigma_bearing_rad", "in space", "sigma_px"]),
    ],
)
def test_a_setting_that_would_change_nothing_is_refused(
    in_space: bool, options: list[str], words: list[str], tmp_path: Path
) -> None:
    folder = write_template(tmp_path / "template", in_space=in_space)
    result = run("slam", folder, "--out", tmp_path / "out", *options)
    assert result.exit_code == 2
    assert len(result.stderr.strip().splitlines()) == 1
    assert [word for word in words if word not in result.stderr] == []
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("in_space", [False, True])
def test_a_file_of_settings_may_hold_sections_of_other_recordings(in_space: bool, tmp_path: Path) -> None:
    folder = write_template(tmp_path / "template", in_space=in_space)
    settings = tmp_path / "all.toml"
    settings.write_text("[slam.space]\nsigma_px = 1.0\n[slam.calibration]\nsigma_askew_rad = 0.04\n", encoding="utf-8")
    result = run("slam", folder, "--out", tmp_path / "out", "--config", settings, *QUICK)
    assert result.exit_code == 0, result.stderr


@pytest.mark.parametrize(
    ("column", "in_space"),
    [
        ("absent", True),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in (("empty", False), ("empty", True), ("absent", False))),
    ],
)
def test_a_recording_without_identities(column: str, in_space: bool, tmp_path: Path) -> None:
    """`check` and `slam` tell the option, and with it both accept the recording."""
    folder = write_template(tmp_path / "template", in_space=in_space)
    rows = (folder / "detections.csv").read_text("utf-8").splitlines()
    head = next(row for row in rows if not row.startswith("#")).split(",")
    at = head.index("landmark_id")
    texts = []
    for row in rows:
        cells = row.split(",")
        if not row.startswith("#"):
            cells[at : at + 1] = [] if column == "absent" else [head[at] if cells == head else ""]
        texts.append(",".join(cells))
    (folder / "detections.csv").write_text("\n".join(texts), encoding="utf-8")
    checked, refused = run("check", folder), run("slam", folder, "--out", tmp_path / "out")
    assert (checked.exit_code, refused.exit_code) == (2, 2)
    for result in (checked, refused):
        [line] = result.stderr.strip().splitlines()
        assert "--unknown-ids associates detections without a landmark_id" in line
    done = (
        run("check", folder, "--unknown-ids"),
        run("slam", folder, "--unknown-ids", "--out", tmp_path / "out", *QUICK),
    )
    assert [result.exit_code for result in done] == [0, 0], [result.stderr for result in done]
    assert "no problems found" in done[0].stderr


@pytest.mark.parametrize("in_map", [False, True])
def test_contradicted_identities_are_told_once(in_map: bool, tmp_path: Path) -> None:
    recording = read_recording(write_template(tmp_path / "template"))
    wrong = recording.detections.landmark_id.copy()
    wrong[::10] = 1 + wrong[::10] % 6
    given = replace(recording, detections=replace(recording.detections, landmark_id=wrong))
    folder = write_native(given, tmp_path / "wrong")
    verb = ["map", "enter", tmp_path / "site.evermap"] if in_map else ["slam"]
    result = run(*verb, folder, "--out", tmp_path / "out", *QUICK)
    assert result.exit_code == 0, result.stderr
    assert result.stderr.count("whose landmark_id contradicts the frames around") == 1


def test_errors_that_hardly_show_are_not_told(tmp_path: Path) -> None:
    """Of the template without some of its ranges: no angle is off, whatever a factor of two in favour of one says."""
    recording = read_recording(write_template(tmp_path / "template"))
    assert recording.dim == 2
    for seed in range(5):
        kept = np.random.default_rng(seed).random(len(recording.detections)) > 0.02
        assert not run_slam(replace(recording, detections=recording.detections[kept])).undecided


def test_errors_that_only_show_together_are_told_with_both_readings(tmp_path: Path) -> None:
    """On the terminal, in the summary and in the report; a data sheet decides."""
    recording = read_recording(write_template(tmp_path / "template"))
    assert recording.dim == 2
    turned = replace(recording.detections, bearing_rad=recording.detections.bearing_rad + 0.06)
    slow = replace(recording.odometry, forward_mps=recording.odometry.forward_mps / 1.14)
    folder, out = tmp_path / "off", tmp_path / "out"
    write_native(replace(recording, detections=turned, odometry=slow), folder)
    result = run("slam", folder, "--out", out, "--set", "output.figures=false")
    assert result.exit_code == 0, result.stderr
    told = [line for line in result.stdout.splitlines() if line.startswith("either ")]
    angle, scale = sorted(told)
    assert re.match(r"either bearing_bias_rad = 0\.0[567]\d* or odometry_askew_rad = 0\.0[567]", angle)
    assert "state [sensor] sigma_angle_rad or [odometry] sigma_askew_rad in sensor.toml" in angle
    assert re.match(r"either odometry_forward_scale = 1\.(0[5-9]|1)\d* or range_slope = 0\.(0[5-9]|1)", scale)
    assert "state [sensor] sigma_scale or [odometry] sigma_odometer_scale in sensor.toml" in scale
    summary = json.loads((out / "summary.json").read_text("utf-8"))
    assert sorted(pair["text"] for pair in summary["undecided"]) == [angle, scale]
    by_name = {one["name"]: one for one in summary["parameters"]}
    sensor, robot = by_name["bearing_bias_rad"], by_name["odometry_askew_rad"]
    assert (sensor["value"], sensor["p_needed"]) == (0.0, None)
    assert sensor["alone"] == robot["value"] == robot["alone"]
    assert (sensor["shown_with"], robot["shown_with"]) == ("odometry_askew_rad", "bearing_bias_rad")
    assert robot["p_needed"] > 0.9
    page = html.unescape((out / "report.html").read_text("utf-8"))
    for line in told:
        assert f"Either{line.removeprefix('either')}" in page
    assert "rad without odometry_askew_rad" in page
    (folder / "sensor.toml").write_text(
        (folder / "sensor.toml").read_text("utf-8") + "[sensor]\nsigma_angle_rad = 0.1\n"
        "[odometry]\nsigma_askew_rad = 0.0\nsigma_odometer_scale = 0.05\n"
    )
    run("slam", folder, "--out", out, *QUICK)
    summary = json.loads((out / "summary.json").read_text("utf-8"))
    by_name = {one["name"]: one for one in summary["parameters"]}
    assert by_name["bearing_bias_rad"]["value"] == pytest.approx(0.06, abs=0.015)
    assert abs(by_name["odometry_askew_rad"]["value"]) < 1e-4
