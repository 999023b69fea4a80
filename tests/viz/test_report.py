"""The report is complete, self-contained and cannot be broken by what it shows."""

import dataclasses
import re
from collections import Counter
from html.parser import HTMLParser

import numpy as np
import pytest

from evermap.metrics.summary import compare_with_truth, metrics_dict
from evermap.runs.summary import RunInfo, summary_dict, timing_dict
from evermap.viz.report import ReportSection, render_report

VOID = {"meta", "link", "br", "img", "hr", "input"}


class Checker(HTMLParser):
    """Collects tags, attributes and text; fails on tags that do not nest."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.attributes, self.text = [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def check(page):
    checker = Checker()
    checker.feed(page)
    checker.close()
    assert checker.open == []
    return checker


def page_of(recording, result, figures=(), sections=()):
    evaluation = compare_with_truth(recording, result)
    info = RunInfo(command="evermap slam 'x & y'", seeds={"slam": 3})
    summary = summary_dict(
        recording,
        result,
        metrics_dict(evaluation),
        config={"slam": {"robust": True}},
        info=info,
        timing=timing_dict(recording, result, info),
    )
    summary["outputs"] = ["report.html", "summary.json"]
    return render_report(recording, result, evaluation, summary, figures, sections), summary


@pytest.fixture(scope="module")
def report(run, figures):
    return page_of(*run, figures)


def test_the_headline_numbers_are_those_of_the_summary(report):
    page, summary = report
    metrics, text = summary["metrics"], " ".join("".join(check(page).text).split())
    for number in (
        f"{metrics['pose_rmse_m']:.3f} m RMSE",
        f"{metrics['heading_rmse_deg']:.2f} ° RMSE",
        f"{metrics['landmark_rmse_m']:.3f} m RMSE",
        f"{metrics['nis_mean']:.2f} mean NIS",
        f"{summary['timing']['real_time_factor']:.0f} × real time",
        "0.2100 ± 0.0040 s",
        "0.00 ± 0.30 s",
        "0.01900 ± 0.00040 m",
        "5 sightings of other robots",
        "3 detections of unknown barcodes dropped",
        "12 detections treated as outliers",
        f"R({metrics['alignment']['pose_truth_estimate']['theta_rad']:.4f} rad)",
        "the robot's first pose",
        '"robust": true',
        summary["versions"]["gtsam"],
    ):
        assert number in text, number


def test_nothing_is_loaded_from_outside_and_nothing_runs(report):
    page, _ = report
    checker = check(page)
    assert "http:" not in page
    assert "https:" not in page
    assert not {"script", "link", "iframe", "object", "embed", "base"} & set(checker.tags)
    for tag, name, value in checker.attributes:
        assert not name.startswith("on"), f"{tag} {name}"
        if name in {"src", "href", "xlink:href", "srcset"}:
            assert value.startswith(("#", "data:image/png;base64,")), value[:60]
    assert all(target.startswith("#") for target in re.findall(r"url\(([^)]*)\)", page))
    assert "@import" not in page
    policy = next(v for t, n, v in checker.attributes if t == "meta" and n == "content" and "default-src" in v)
    assert "default-src 'none'" in policy


def test_references_inside_the_page_resolve_and_ids_are_unique(report):
    page, _ = report
    attributes = check(page).attributes
    ids = Counter(value for _, name, value in attributes if name == "id")
    assert [name for name, count in ids.items() if count > 1] == []
    wanted = {value[1:] for _, name, value in attributes if name == "href"} | set(re.findall(r"url\(#([^)]*)\)", page))
    assert wanted <= set(ids)


def test_hostile_names_stay_text(run):
    recording, result = run
    bad = "<script>alert(1)</script>&\"'"
    hostile = dataclasses.replace(recording, name=bad, source=bad, warnings=(bad,))
    parameter = dataclasses.replace(result.parameters[0], name=bad, meaning=bad, unit="<s>")
    page, _ = page_of(hostile, dataclasses.replace(result, parameters=(parameter,)))
    assert "script" not in check(page).tags
    assert bad in "".join(check(page).text)


def test_sections_of_the_caller_come_first_with_their_pictures(run, figures):
    section = ReportSection("What a changing world does", "<p>It <em>hurts</em>.</p>", (figures[0],))
    page, _ = page_of(*run, figures[1:], [section])
    check(page)
    assert page.index("What a changing world does") < page.index("<h2>Accuracy")
    assert "<em>hurts</em>" in page
    assert page.index('<figure id="map"') < page.index("<h2>Accuracy")


def test_runs_without_truth_claim_no_errors(run):
    recording, result = run
    page, _ = page_of(dataclasses.replace(recording, truth=None, true_landmarks=None), result)
    text = "".join(check(page).text)
    assert "Position error" not in text
    assert "Landmark error" not in text
    assert "None" not in text
    assert "nan" not in text


def test_interrupted_runs_say_so(run):
    recording, result = run
    page, _ = page_of(recording, dataclasses.replace(result, interrupted=True, step_s=result.step_s[:50]))
    assert "Stopped before the end" in page
    assert "Stopped before the end" not in page_of(recording, result)[0]


def test_runs_worse_than_odometry_are_not_praised(run):
    recording, result = run
    bad = dataclasses.replace(result, dead_reckoning=result.trajectory)
    page, _ = page_of(recording, bad)
    assert "off: no worse." in page
    still = dataclasses.replace(result, step_s=np.zeros(0))
    assert "× real time" not in page_of(recording, still)[0]


def test_what_changed_is_told_in_words_and_numbers(run):
    from synthetic_run import with_changes

    recording, result = run
    page, _ = page_of(recording, with_changes(result))
    text = " ".join("".join(check(page).text).split())
    assert "landmarks 3, 6, 9 moved by (-1.00, 0.00) m before the session, probability 97 %" in text
    assert "or: landmarks 12, 15, 18" in text
    assert "alternative_1.geojson" in text
    assert page.index("What changed") < page.index("<h2>Accuracy")
    assert "nan" not in text
    assert "What changed" not in page_of(recording, result)[0]
