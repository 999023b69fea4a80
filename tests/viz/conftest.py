import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "metrics"))


@pytest.fixture(scope="session")
def run():
    from synthetic_run import make_run

    return make_run()


@pytest.fixture(scope="session")
def evaluation(run):
    from evermap.metrics.summary import compare_with_truth

    return compare_with_truth(*run)


@pytest.fixture(scope="session")
def figures(run, evaluation):
    from evermap.viz.run_figures import draw_figures

    return draw_figures(*run, evaluation, real_time_factor=123.4)
