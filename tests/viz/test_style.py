"""Colours, markers and themes of all figures."""

from __future__ import annotations

import io
import itertools
import re
from typing import Any

import numpy as np
import pytest

from evermap.types import FloatArray
from evermap.viz.page import STYLE
from evermap.viz.style import (
    ALERT,
    CLASS_COLOURS,
    CLASS_MARKERS,
    ESTIMATE,
    INK,
    NO_CLASS,
    PAPER,
    ROLES,
    class_looks,
    house_style,
    inline_svg,
    new_figure,
    save_svg,
    settle,
)

# Machado, Oliveira and Fernandes (2009), severity 1: protanopia, deuteranopia, tritanopia, in linear RGB
DEFICIENCIES = {
    "none": np.eye(3),
    "protan": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deutan": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]]
    ),
    "tritan": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]]
    ),
}
JUST_NOTICEABLE = 2.3
"""CIELAB distance (Mahy et al. 1994)."""


def cielab(colour: str, deficiency: str) -> FloatArray:
    """L*, a*, b* of sRGB under D65, as a reader with a deficiency of colour vision sees it."""
    value = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    seen = np.clip(DEFICIENCIES[deficiency] @ linear, 0.0, 1.0)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = np.cbrt(np.maximum(to_xyz @ seen / [0.9505, 1.0, 1.089], 1e-6))
    return np.array([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)])


@pytest.mark.parametrize("deficiency", DEFICIENCIES)
def test_classes_and_alerts_are_distinguished_by_colour_blind_readers(deficiency: str) -> None:
    colours = {*CLASS_COLOURS, NO_CLASS.colour, ALERT}
    for theme in (colours, {ROLES[colour][1] for colour in colours}):
        for one, other in itertools.combinations(sorted(theme), 2):
            distance = np.linalg.norm(cielab(one, deficiency) - cielab(other, deficiency))
            assert distance > 2.0 * JUST_NOTICEABLE, (one, other)
    for one, other in itertools.combinations(sorted(colours), 2):
        assert np.linalg.norm(cielab(one, deficiency) - cielab(other, deficiency)) > 6.0 * JUST_NOTICEABLE, (one, other)


def test_the_order_of_names_decides_the_looks_and_each_is_different() -> None:
    names = [f"class {k:02}" for k in range(len(CLASS_COLOURS) * len(CLASS_MARKERS))]
    looks = class_looks(names)
    assert class_looks(reversed(names)) == looks
    assert len(set(looks.values())) == len(names) + 1
    assert looks[""] == NO_CLASS
    neighbours = [looks[name] for name in names[: len(CLASS_COLOURS)]]
    assert len({look.colour for look in neighbours}) == len({look.marker for look in neighbours}) == len(neighbours)


def themed() -> str:
    with house_style():
        figure = new_figure(3.0, 2.0)
        axes: Any = figure.add_subplot()
        axes.plot([0.0, 1.0], [0.0, 1.0], color=ESTIMATE)
        axes.set_title("a title")
        settle(figure)
    buffer = io.BytesIO()
    save_svg(figure, buffer)
    return buffer.getvalue().decode()


def test_files_follow_the_theme_of_the_reader_and_print_without_it() -> None:
    text = themed()
    sheet = re.search(r"<style>(.*?)</style>", text, re.DOTALL)
    assert sheet is not None
    assert "@media (prefers-color-scheme:dark)" in sheet[1]
    for light, (_, dark) in ROLES.items():
        rule = f'[style*="fill: {light}"]{{fill:{"currentColor" if light == INK else dark} !important}}'
        assert rule in sheet[1], light
    drawing = text.replace(sheet[0], "")
    assert f"stroke: {ESTIMATE}" in drawing
    assert f"fill: {INK}" in drawing
    assert f"fill: {PAPER}" in drawing
    assert "var(" not in drawing


def test_the_page_has_a_variable_a_role_in_both_themes() -> None:
    light, dark = STYLE.split("prefers-color-scheme:dark", 1)
    for colour, (role, in_the_dark) in ROLES.items():
        assert f"--{role}:{colour}" in light
        assert f"--{role}:{in_the_dark}" in dark


def test_a_figure_is_drawn_again_where_it_was_changed() -> None:
    with house_style():
        figure = new_figure(2.0, 1.5)
        axes = figure.subplots()
        (line,) = axes.plot([0.0, 1.0], [0.0, 1.0])
    first = inline_svg(figure, "one")
    assert inline_svg(figure, "one") == first
    line.set_ydata([0.0, 0.5])
    second = inline_svg(figure, "one")
    assert second != first
    axes.set_title("changed")
    assert inline_svg(figure, "one") != second
