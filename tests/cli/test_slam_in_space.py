"""What `evermap slam` prints of a run in space."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "metrics"))


@pytest.mark.parametrize("spatial", [True, False])
def test_the_errors_of_a_run_are_printed_in_space_as_in_the_plane(
    spatial: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from synthetic_run import make_run, make_spatial_run, with_spatial_changes

    from evermap.cli.recordings import RunRequest, write_results
    from evermap.config import Config

    recording, result = make_spatial_run() if spatial else make_run()
    config = Config.model_validate({"output": {"figures": False, "report": False}})
    if spatial:
        result = with_spatial_changes(result)
    asked = RunRequest(config, [], [], as_json=False, force=False)
    write_results(tmp_path / "run", recording, result, asked, 1.0)
    printed = capsys.readouterr().out
    assert ("heading error, RMSE" in printed) is not spatial
    assert ("orientation error, RMSE" in printed) is spatial
    assert ("landmark orientation, RMSE" in printed) is spatial
    assert "landmark error, median" in printed
    assert ("landmark 5 moved by (+0.20, +0.10, +0.90) m before the session" in printed) is spatial
