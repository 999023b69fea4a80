"""Faults come at the rates and in the sizes that are asked for, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import binomtest, kstest, poisson

from evermap.errors import ConfigError
from evermap.types import Recording
from evermap_studies.sim import BuildingConfig, SimulatedSensor, simulate_building
from evermap_studies.worlds.faults import (
    FAULTLESS,
    NOTHING,
    STRANGER,
    FaultConfig,
    StreamFaults,
    arrivals,
    faulty_stream,
    with_faults,
)

STAMP_S = 100.0 + 0.1 * np.arange(20_000)


@cache
def patrol() -> Recording:
    config = BuildingConfig(days=1, patrol_s=60.0, sensor=SimulatedSensor(rate_hz=5.0))
    return simulate_building(config, seed=4).sessions[0]


def same(one: Recording, other: Recording) -> None:
    for part in ("odometry", "frames", "detections"):
        mine, yours = getattr(one, part), getattr(other, part)
        for name in mine.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(mine, name), getattr(yours, name), err_msg=f"{part}.{name}")


def test_without_faults_nothing_changes() -> None:
    same(with_faults(patrol(), FAULTLESS, seed=1), patrol())


def test_one_seed_gives_the_same_faults_and_another_one_others() -> None:
    same(with_faults(patrol(), seed=3), with_faults(patrol(), seed=3))
    assert not np.array_equal(
        with_faults(patrol(), seed=3).odometry.stamp_s, with_faults(patrol(), seed=4).odometry.stamp_s
    )


@pytest.mark.parametrize("name", ["p_dropped", "p_twice", "p_late", "p_misstamped", "p_stamp_garbled"])
def test_messages_are_hit_as_often_as_asked_for(name: str) -> None:
    faults = replace(NOTHING, late_s=2.0, **{name: 0.03})
    row, stamp = arrivals(STAMP_S, faults, np.random.default_rng(0))
    count = np.bincount(row, minlength=len(STAMP_S))
    back = np.append(np.diff(row) < 0, False)  # the next to arrive is the late one
    hits = {
        "p_dropped": np.sum(count == 0),
        "p_twice": np.sum(count == 2),
        # one that is later than 0.1 s arrives after its successor
        "p_late": np.sum(back) / 0.95,
        "p_misstamped": np.sum(stamp > STAMP_S[row]),
        "p_stamp_garbled": np.sum(~(stamp == STAMP_S[row])),
    }[name]
    assert binomtest(round(float(hits)), len(STAMP_S), 0.03).pvalue > 1e-3
    assert name == "p_dropped" or np.all(count >= 1)


def test_a_late_message_has_its_stamp_and_a_misstamped_one_its_place() -> None:
    row, stamp = arrivals(STAMP_S, replace(NOTHING, p_late=0.1, late_s=2.0), np.random.default_rng(1))
    np.testing.assert_array_equal(stamp, STAMP_S[row])
    newest = np.maximum.accumulate(stamp)
    assert 1.8 < np.max(newest - stamp) <= 2.0
    row, stamp = arrivals(STAMP_S, replace(NOTHING, p_misstamped=0.1, late_s=2.0), np.random.default_rng(1))
    assert np.all(np.diff(stamp) >= 0.0)
    delay = (stamp - STAMP_S[row])[stamp > STAMP_S[row]]
    assert kstest(delay, "uniform", (0.0, 2.0)).pvalue > 1e-3


def test_outages_take_their_share_of_the_time() -> None:
    stamp_s = np.arange(0.0, 400 * 3600.0, 10.0)
    row, _ = arrivals(stamp_s, replace(NOTHING, outages_per_h=6.0, outage_s=30.0), np.random.default_rng(2))
    lost = 1.0 - len(row) / len(stamp_s)
    assert lost == pytest.approx(1.0 - np.exp(-6.0 * 30.0 / 3600.0), rel=0.1)  # overlaps of a Poisson process


def test_clocks_are_set_as_often_and_as_far_as_asked_for() -> None:
    stamp_s = np.arange(0.0, 200 * 3600.0, 10.0)
    _, stamp = arrivals(stamp_s, replace(NOTHING, jumps_per_h=3.0, jump_s=60.0), np.random.default_rng(3))
    step = np.diff(stamp - stamp_s)
    step = step[np.abs(step) > 1e-6]
    assert poisson.sf(len(step), 600.0) > 1e-3 < poisson.cdf(len(step), 600.0)
    assert kstest(step, "uniform", (-60.0, 120.0)).pvalue > 1e-3


def test_a_clock_of_the_whole_robot_moves_both_streams_at_one_instant() -> None:
    config = replace(FAULTLESS, clock_jumps_per_h=60.0, clock_jump_s=60.0)
    faulty = with_faults(patrol(), config, seed=5)
    for part in ("odometry", "frames"):
        wrong = getattr(faulty, part).stamp_s - getattr(patrol(), part).stamp_s
        first = int(np.argmax(wrong != 0.0))
        at = getattr(patrol(), part).stamp_s[first]
        if part == "odometry":
            began, by = at, wrong[first]
    assert by != 0.0
    assert at == pytest.approx(began, abs=0.25)
    assert wrong[first] == pytest.approx(by)


def test_a_frozen_sensor_repeats_its_last_frame() -> None:
    frozen = with_faults(patrol(), replace(FAULTLESS, freezes_per_h=600.0, freeze_s=2.0), seed=6)
    np.testing.assert_array_equal(frozen.frames.stamp_s, patrol().frames.stamp_s)
    shown = [frozen.detections.range_m[frozen.detections.frame == k].tolist() for k in range(len(frozen.frames))]
    was = [patrol().detections.range_m[patrol().detections.frame == k].tolist() for k in range(len(frozen.frames))]
    hung = 0
    for k in range(1, len(shown)):
        assert shown[k] in (was[k], shown[k - 1])
        hung += shown[k] != was[k]
    assert hung > 20


def test_readings_and_identities_are_garbled_as_often_as_asked_for() -> None:
    count = len(patrol().detections)
    clean = patrol().detections
    garbled = with_faults(patrol(), replace(FAULTLESS, p_impossible=0.1), seed=7).detections
    assert binomtest(int(np.sum(garbled.range_m != clean.range_m)), count, 0.1).pvalue > 1e-3
    np.testing.assert_array_equal(garbled.landmark_id, clean.landmark_id)
    renamed = with_faults(patrol(), replace(FAULTLESS, p_wrong_identity=0.2), seed=7).detections
    assert binomtest(int(np.sum(renamed.landmark_id >= STRANGER)), count, 0.04).pvalue > 1e-3
    np.testing.assert_array_equal(renamed.range_m, clean.range_m)
    shuffled = with_faults(patrol(), replace(FAULTLESS, p_shuffled=1.0), seed=7).detections
    assert np.any(shuffled.landmark_id != clean.landmark_id)
    for frame in np.unique(clean.frame):
        rows = clean.frame == frame
        assert sorted(shuffled.landmark_id[rows]) == sorted(clean.landmark_id[rows])


def test_spikes_and_garbage_of_the_odometry() -> None:
    odometry = patrol().odometry
    spiked = with_faults(patrol(), replace(FAULTLESS, p_spike=0.05, spike_mps=30.0), seed=8).odometry
    for name in ("forward_mps", "angular_radps"):
        hit = getattr(spiked, name) != getattr(odometry, name)
        assert binomtest(int(hit.sum()), len(odometry), 0.05).pvalue > 1e-3
        assert 15.0 < np.abs(getattr(spiked, name)[hit]).max() <= 30.0
    wild = with_faults(patrol(), replace(FAULTLESS, p_odometry_impossible=0.05), seed=8).odometry
    assert binomtest(int(np.sum(~(np.abs(wild.forward_mps) < 1e3))), len(odometry), 0.05).pvalue > 1e-3


def test_a_part_may_be_missing_altogether() -> None:
    missing = set()
    for seed in range(20):
        faulty = with_faults(patrol(), replace(FAULTLESS, p_empty=1.0), seed)
        empty = {part for part in ("odometry", "frames", "detections") if not len(getattr(faulty, part))}
        missing.add(frozenset(empty))
    assert missing == {frozenset({"odometry"}), frozenset({"frames", "detections"}), frozenset({"detections"})}


def test_a_stream_of_anything() -> None:
    messages = [(float(stamp), f"message {k}") for k, stamp in enumerate(STAMP_S[:500])]
    assert list(faulty_stream(messages, NOTHING, 0)) == messages
    faulty = list(faulty_stream(messages, replace(NOTHING, p_dropped=0.2, p_late=0.2, late_s=1.0), 1))
    assert set(faulty) < set(messages)
    assert faulty != sorted(faulty)
    assert list(faulty_stream([], StreamFaults(), 0)) == []


@pytest.mark.parametrize(
    ("config", "field"),
    [
        (FaultConfig(p_empty=1.5), "p_empty"),
        (FaultConfig(freeze_s=float("nan")), "freeze_s"),
        (FaultConfig(frames=StreamFaults(p_late=-0.1)), "frames.p_late"),
        (FaultConfig(odometry=StreamFaults(outage_s=float("inf"))), "odometry.outage_s"),
    ],
)
def test_impossible_rates_are_refused(config: FaultConfig, field: str) -> None:
    with pytest.raises(ConfigError, match=field):
        with_faults(patrol(), config)
