"""`evermap track` reads the recording that `evermap slam` takes, and finds what stands there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from evermap.cli.main import app
from evermap.config import TrackConfig
from evermap.errors import DataError
from evermap.tracking.detections import read_input
from evermap.tracking.run import run_track


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive along a street."""
    folder = tmp_path_factory.mktemp("street") / "street"
    made = CliRunner().invoke(app, ["simulate", "street", str(folder), "--days", "1", "--seed", "1"])
    assert made.exit_code == 0, made.output
    return folder / "day00_session00"


def test_a_recording_is_tracked_and_what_stands_is_at_rest(street: Path) -> None:
    table = read_input(street)
    assert table.class_names == ("Car", "Van")
    assert len(table.stamp_s) == len((street / "frames.csv").read_text().splitlines()) - 1
    result = run_track(table, TrackConfig(range_m=45.0))
    assert len(result.spells) >= 10
    away = np.linalg.norm(result.spells.position_m[:, None, :2] - table.position_m[None, :, :2], axis=2)
    assert (np.count_nonzero(away < 1.0, axis=1) >= 5).all()


def test_scores_leave_out_and_a_recording_without_boxes_is_refused(street: Path, tmp_path: Path) -> None:
    assert len(read_input(street, min_score=7.0)) < len(read_input(street))
    made = CliRunner().invoke(app, ["simulate", "yard", str(tmp_path / "yard"), "--seed", "1"])
    assert made.exit_code == 0, made.output
    with pytest.raises(DataError, match="without boxes"):
        read_input(next(path for path in (tmp_path / "yard").iterdir() if path.is_dir()))
