"""Simple ways to predict presence, written here for comparison: means, the last look, and a sum of harmonics."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from evermap.existence.protocol import Instants, Looks
from evermap.existence.rhythm import BIN_S, BINS, BINS_OF_DAY, WEEK_S, bin_of_week
from evermap.types import FloatArray

_WORKDAYS = 5
_HARMONICS = 168
"""Candidates: a week down to an hour, or an hour and three quarters down to half a minute."""


class Smoothing(NamedTuple):
    """Of the periodic mean.

    Attributes:
        smooth_s: standard deviation of the Gaussian that it is smoothed with.
        weeks: how many weeks the mean over workdays, or over weekends, counts as.
    """

    smooth_s: float
    weeks: float


class Harmonics(NamedTuple):
    """Of the spectral model.

    Attributes:
        harmonics: how many are kept, the strongest first.
        margin: least distance of a probability from 0 and 1.
    """

    harmonics: int
    margin: float


PERIODIC_OPTIONS = tuple(
    Smoothing(60.0 * minutes, weeks)
    for minutes, weeks in product((5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0), (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 64.0))
)
SPECTRAL_OPTIONS = tuple(
    Harmonics(harmonics, margin)
    for harmonics, margin in product(
        (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 168), (0.001, 0.003, 0.01, 0.03, 0.1)
    )
)


def unbiased(looks: Looks) -> FloatArray:
    """(M,) numbers whose mean is the share of presence, detector errors taken out."""
    return np.asarray((looks.detected - looks.p_false) / (1.0 - looks.p_miss - looks.p_false), dtype=np.float64)


def long_term_mean(looks: Looks) -> float:
    """Share of presence among the looks."""
    return float(np.clip(unbiased(looks).mean(), 0.0, 1.0))


def last_look(before: float, _: Any) -> Callable[[Looks, Instants], FloatArray]:
    """What the last look said; `before` the first one, what the last look of the training said."""

    def believe(looks: Looks, instants: Instants) -> FloatArray:
        belief = np.empty(len(instants.stamp_s))
        for feature in range(looks.n_features):
            rows = slice(int(instants.first[feature]), int(instants.first[feature + 1]))
            one = looks.of(feature)
            said = np.append(before, one.detected)
            belief[rows] = said[np.searchsorted(one.stamp_s, instants.stamp_s[rows], side="right")]
        return belief

    return believe


class WeekCounts(NamedTuple):
    """(1008,) weeks' worth of looks in each ten minutes of the week, and of presence among them."""

    known: FloatArray
    present: FloatArray


def week_counts(looks: Looks) -> WeekCounts:
    """Count looks by the time of the week."""
    gap_s = float(np.median(np.diff(looks.stamp_s)))
    bins, share = bin_of_week(looks.stamp_s), gap_s / BIN_S
    present = np.bincount(bins, weights=unbiased(looks), minlength=BINS)
    return WeekCounts(
        np.asarray(np.bincount(bins, minlength=BINS) * share, dtype=np.float64),
        np.asarray(present * share, dtype=np.float64),
    )


def periodic(counts: WeekCounts, option: Smoothing) -> Callable[[Looks, Instants], FloatArray]:
    """Mean at this time of the week, smoothed, drawn towards the mean of all workdays, or of the weekend."""
    distance_s = BIN_S * np.minimum(np.arange(BINS), BINS - np.arange(BINS))
    kernel = np.exp(-0.5 * (distance_s / option.smooth_s) ** 2)
    transfer = np.fft.rfft(kernel / kernel.sum())
    known, present = (np.fft.irfft(np.fft.rfft(one) * transfer, BINS).reshape(7, BINS_OF_DAY) for one in counts)
    alike = np.empty_like(known)
    for days in (slice(0, _WORKDAYS), slice(_WORKDAYS, 7)):
        alike[days] = present[days].sum(0) / np.maximum(known[days].sum(0), 1e-12)
    curve = np.clip((present + option.weeks * alike) / (known + option.weeks), 0.0, 1.0).reshape(-1)
    return lambda _, instants: curve[bin_of_week(instants.stamp_s)]


class Spectrum(NamedTuple):
    """Mean, angular frequencies [rad/s] and complex amplitudes, the strongest first."""

    mean: float
    frequency: FloatArray
    amplitude: Any


def spectrum(looks: Looks) -> Spectrum:
    """Correlate the looks with harmonics of the week, or of the whole recording where it is shorter than two.

    FreMEn (Krajnik et al., IEEE T-RO 2017) in its form for looks at any times: amplitudes are plain means.
    """
    time_s, value = looks.stamp_s, unbiased(looks)
    span_s = float(np.ptp(time_s))
    frequency = 2.0 * np.pi * np.arange(1, _HARMONICS + 1) / (WEEK_S if span_s >= 2.0 * WEEK_S else span_s)
    rest = value - value.mean()
    amplitude = np.array([np.mean(rest * np.exp(-1j * one * time_s)) for one in frequency])
    order = np.argsort(-np.abs(amplitude), kind="stable")
    return Spectrum(float(value.mean()), np.asarray(frequency[order], dtype=np.float64), amplitude[order])


def spectral(found: Spectrum, option: Harmonics) -> Callable[[Looks, Instants], FloatArray]:
    """The mean and the strongest harmonics, kept within the margin."""

    def believe(_: Looks, instants: Instants) -> FloatArray:
        belief = np.full(len(instants.stamp_s), found.mean)
        strongest = slice(0, option.harmonics)
        for frequency, amplitude in zip(found.frequency[strongest], found.amplitude[strongest], strict=True):
            belief += 2.0 * np.real(amplitude * np.exp(1j * frequency * instants.stamp_s))
        return np.asarray(np.clip(belief, option.margin, 1.0 - option.margin), dtype=np.float64)

    return believe
