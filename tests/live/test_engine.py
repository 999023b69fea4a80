"""The live engine against the recordings' own entry points: the same maps, the same poses, whatever the order."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import wait
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from feeding import AT_THE_END, SESSIONS, assert_equal, engine, entered, fed, map_of_two, messages, online, send, stored
from threadpoolctl import threadpool_info, threadpool_limits

import evermap as em
from evermap.config import Config, SlamConfig
from evermap.errors import ConfigError, InputError
from evermap.live.judge import Judge
from evermap.live.spool import Spool
from evermap.maps.living import LivingMap
from evermap.maps.store import open_store
from evermap.maps.store.measured import RECORDING, unpack_recording
from evermap.runs.sessions import Entered, enter_session
from evermap.slam.localize import Localizer
from evermap.types import ChangeKind, Clock, Landmarks, Sensor


@pytest.fixture(scope="module")
def two_sessions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of two sessions, as recordings enter."""
    path = tmp_path_factory.mktemp("map") / "site.evermap"
    path.write_bytes(map_of_two())
    return path


def copied(path: Path, to: Path) -> Path:
    there = to / path.name
    there.write_bytes(path.read_bytes())
    return there


def test_a_recording_fed_live_gives_the_map_and_the_poses_of_its_replay_bit_by_bit(tmp_path: Path) -> None:
    """The online poses of a place that nobody knows differ by rounding: landmarks are numbered as they come. Their ids
    are as read: a vote would have to wait for the seconds after.
    """
    as_read = AT_THE_END.model_copy(update={"slam": SlamConfig(vote_ids=False, online=True)})
    for number, recording in enumerate(SESSIONS[:2]):
        before = stored(tmp_path / "replay.evermap") if number else LivingMap()
        with engine(tmp_path / "live.evermap", recording) as live:
            steps = list(fed(live, recording))
            made = live.save()
        assert made is not None
        if number:  # mapping uses landmarks that the map lacks, too
            steps = list(fed(engine(before, recording, mapping=False), recording))
        assert_equal(stored(tmp_path / "live.evermap"), entered(tmp_path / "replay.evermap", recording))
        if number:
            replayed, off = em.run_localization(recording, before, AT_THE_END).online, 1e-12
        else:
            replayed, off = em.run_session(recording, None, as_read).slam.online, 1e-6
        ours = online(steps)
        both, mine, theirs = np.intersect1d(ours.stamp_s, replayed.stamp_s, return_indices=True)
        assert len(both) >= len(replayed) - 2  # the last frames are processed by `save`
        np.testing.assert_allclose(ours.pose_world_robot[mine], replayed.pose_world_robot[theirs], rtol=0, atol=off)
        np.testing.assert_allclose(ours.covariance[mine], replayed.covariance[theirs], rtol=1e-5, atol=off)
        assert steps[-1].frame == ("prior_map" if number else "first_pose")
    with open_store(tmp_path / "live.evermap") as store:
        assert [revision.provenance.recording for revision in store.log()] == [one.name for one in SESSIONS[:2]]


def test_out_of_order_within_the_window_is_in_order(tmp_path: Path, two_sessions: Path) -> None:
    recording = SESSIONS[2]
    step_s = 0.08 * np.random.default_rng(0).random(len(messages(recording)))
    late = sorted(zip(step_s, messages(recording), strict=True), key=lambda pair: pair[0] + pair[1][0])
    found = []
    for name, order in (("in", messages(recording)), ("out", [message for _, message in late])):
        path = copied(two_sessions, tmp_path / name) if (tmp_path / name).mkdir() is None else two_sessions
        with engine(path, recording) as live:
            steps = list(fed(live, recording, order))
            assert live.late == 0
        found.append((online(steps), stored(path)))
    (one, map_one), (other, map_other) = found
    assert_equal(map_one, map_other)
    both, mine, theirs = np.intersect1d(one.stamp_s, other.stamp_s, return_indices=True)
    assert len(both) > 0.9 * len(recording.frames)
    np.testing.assert_array_equal(one.pose_world_robot[mine], other.pose_world_robot[theirs])


def test_two_threads_feed_while_a_third_steps(tmp_path: Path, two_sessions: Path) -> None:
    recording, path = SESSIONS[2], copied(two_sessions, tmp_path)
    live = engine(path, recording, Config(live={"revision_s": 0.0, "reorder_s": 1e3}), beside=True)
    streams = [[one for one in messages(recording) if one[1] == kind] for kind in ("odometry", "frame")]
    done = threading.Event()

    def feed(stream: list) -> None:
        for message in stream:
            send(live, recording, message)

    def step() -> None:
        while not done.is_set():
            live.step()
            time.sleep(0.001)

    feeders = [threading.Thread(target=feed, args=(stream,)) for stream in streams]
    stepper = threading.Thread(target=step)
    for thread in (stepper, *feeders):
        thread.start()
    for thread in feeders:
        thread.join()
    done.set()
    stepper.join()
    live.save()
    live.close()
    replay = copied(two_sessions, tmp_path / "replay") if (tmp_path / "replay").mkdir() is None else path
    assert_equal(stored(path), entered(replay, recording))


def test_revisions_within_a_session_are_the_sessions_of_its_parts(tmp_path: Path) -> None:
    """The map changes while the robot drives, which goes on in it; what waits is bounded by what a part holds."""
    recording = SESSIONS[0]
    config = Config(live={"revision_s": 15.0})
    with engine(tmp_path / "live.evermap", recording, config) as live:
        steps, waiting = [], []
        for now in fed(live, recording):
            steps.append(now)
            waiting.append(live.n_bytes)
    assert {one.frame for one in steps} == {"first_pose", "prior_map"}
    assert steps[-1].revision >= 2
    assert not steps[-1].lost
    assert max(waiting[len(waiting) // 2 :]) < 1.3 * max(waiting[: len(waiting) // 2])
    with open_store(tmp_path / "live.evermap") as store:
        kept = sorted((item.revision, item) for item in store.attachments() if item.name == RECORDING)
        parts = [unpack_recording(store.attached(item)) for _, item in kept]
    assert sum(len(part.detections) for part in parts) == len(recording.detections)
    for part in parts:
        last = entered(tmp_path / "parts.evermap", part, config)
    assert_equal(stored(tmp_path / "live.evermap"), last)
    assert recording.truth is not None
    pose = online([one for one in steps if one.frame == "prior_map"])
    at = np.searchsorted(recording.truth.stamp_s, pose.stamp_s).clip(0, len(recording.truth.stamp_s) - 1)
    first = recording.truth.pose_world_robot[np.searchsorted(recording.truth.stamp_s, recording.frames.stamp_s[0])]
    turned = np.array([[np.cos(first[2]), np.sin(first[2])], [-np.sin(first[2]), np.cos(first[2])]])
    true = (recording.truth.pose_world_robot[at, :2] - first[:2]) @ turned.T
    assert np.median(np.hypot(*(pose.pose_world_robot[:, :2] - true).T)) < 0.5


@pytest.mark.slow
def test_a_revision_is_entered_by_a_process_beside_the_steps(tmp_path: Path) -> None:
    recording, path = SESSIONS[0], tmp_path / "site.evermap"
    with engine(path, recording, Config(live={"revision_s": 20.0}), beside=True) as live:
        order = messages(recording)
        at = next(k for k, one in enumerate(order) if one[0] > recording.frames.stamp_s[0] + 25.0)
        steps = list(fed(live, recording, order[:at]))
        assert steps[-1].frame == "first_pose"
        until_s = time.monotonic() + 120.0
        while (now := live.step()).frame == "first_pose":
            assert time.monotonic() < until_s
            time.sleep(0.05)
        assert now.revision == 1
        assert np.hypot(*(now.pose_world_robot - steps[-1].pose_world_robot)[:2]) < 0.5
        steps += list(fed(live, recording, order[at:]))
    assert np.mean([one.lost for one in steps[-50:]]) < 0.2
    with open_store(path) as store:
        assert store.head() >= 1
    assert not list(path.with_name("site.evermap.live").glob("*.readings"))


def test_mapping_and_localising_are_switched_without_a_restart(tmp_path: Path, two_sessions: Path) -> None:
    recording, path = SESSIONS[2], copied(two_sessions, tmp_path)
    half = len(messages(recording)) // 2
    with engine(path, recording, mapping=False) as live:
        steps = list(fed(live, recording, messages(recording)[:half]))
        assert live.n_bytes > 0
        live.mapping = True
        steps += list(fed(live, recording, messages(recording)[half:]))
    assert not any(one.lost for one in steps[len(steps) // 2 :])
    with open_store(path) as store:
        assert store.head() == 3
        kept = {item.revision: item for item in store.attachments() if item.name == RECORDING}
        part = unpack_recording(store.attached(kept[3]))
    assert part.frames.stamp_s[0] > recording.frames.stamp_s[len(recording.frames) // 3]
    assert part.odometry.stamp_s[0] < part.frames.stamp_s[0]


MARKS = np.array([[3.0, 0.0], [3.0, 2.0], [4.0, -2.0], [2.5, 1.0]])


def standing(seconds: float, seen: Callable[[float], list[int] | None]) -> tuple[em.Engine, list]:
    """A robot that stands before four landmarks of its map; `seen` says which, None for no frame."""
    marks = replace(Landmarks.at(np.arange(4), MARKS, sigma_m=0.02), clock=Clock.RECORDING)
    living, sensor = LivingMap.begun(marks), Sensor(range_max_m=8.0)
    live = em.Engine(living, sensor, mapping=False, clock=Clock.RECORDING, beside=False)
    steps = []
    for stamp_s in np.arange(0.0, seconds, 0.1):
        live.odometry(stamp_s, 0.0)
        if (rows := seen(stamp_s)) is not None:
            live.detections(stamp_s, rows, np.hypot(*MARKS[rows].T), np.arctan2(MARKS[rows, 1], MARKS[rows, 0]))
        steps.append(live.step())
    return live, steps


def test_what_is_missed_is_doubted_and_told_while_the_robot_stands_there() -> None:
    live, steps = standing(90.0, lambda stamp_s: [0, 1, 2, 3] if stamp_s < 20.0 else [0, 1, 2])
    (change,) = [change for now in steps for change in now.changes]
    assert (change.kind, change.landmark_ids) == (ChangeKind.VANISHED, (3,))
    assert 20.0 <= change.stamp_to_s < 25.0
    early, late = (steps[k].in_view for k in (190, -1))
    assert late.p_exists[late.landmark_id == 3] < 0.1
    assert (early.p_exists > 0.9).all()
    assert (late.p_exists[late.landmark_id != 3] > 0.9).all()
    assert live.landmarks().p_exists[3] < 0.1
    assert live.landmarks(within=(2.0, -1.0, 3.5, 3.0)).landmark_id.tolist() == [0, 1, 3]


def test_a_frame_without_detections_is_a_look() -> None:
    """All are seen for a while; then there are frames without any, or no frames."""
    empty, none = (
        standing(60.0, lambda stamp_s, then=then: [0, 1, 2, 3] if stamp_s < 20.0 else then)[0].landmarks().p_exists
        for then in ([], None)
    )
    assert (empty < none).all()
    assert (none > 0.9).all()


CHILD = """
import sys, time
sys.path[:0] = [{here!r}]
from feeding import SESSIONS, engine, messages, send
from evermap.config import Config
live = engine({path!r}, SESSIONS[2], Config(live={{"revision_s": 0.0, "checkpoint_s": 0.2}}), beside=True)
for message in messages(SESSIONS[2]):
    send(live, SESSIONS[2], message)
    if message[1] == "frame":
        live.step()
        time.sleep(0.01)
        print(message[0], flush=True)
time.sleep(60)
"""


def test_what_was_driven_before_a_kill_is_in_the_map_of_the_next_engine(tmp_path: Path, two_sessions: Path) -> None:
    """All but what came since the last checkpoint: a fifth of a second here, and some for the disk."""
    path, recording = copied(two_sessions, tmp_path), SESSIONS[2]
    code = CHILD.format(here=str(Path(__file__).parent), path=str(path))
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    for _ in range(150):
        last_s = float(child.stdout.readline())
    with pytest.raises(ConfigError, match="another process feeds this map"):
        engine(path, recording)
    child.send_signal(signal.SIGKILL)
    child.wait()
    with open_store(path) as store:
        assert store.head() == 2
    live = engine(path, SESSIONS[3])
    assert any("recovered" in warning for warning in live.step().warnings)
    live.close()
    with open_store(path) as store:
        assert store.head() == 3
        kept = {item.revision: item for item in store.attachments() if item.name == RECORDING}
        part = unpack_recording(store.attached(kept[3]))
    frames = len(part.frames)
    np.testing.assert_array_equal(part.frames.stamp_s, recording.frames.stamp_s[:frames])
    seen = recording.detections.frame < frames
    np.testing.assert_array_equal(part.detections.range_m, recording.detections.range_m[seen])
    assert part.frames.stamp_s[-1] > last_s - 12.0  # of the recording, which is fed twenty times as fast
    assert em.recover(path) == ()


def test_a_part_that_a_crash_cut_off_is_left_out(tmp_path: Path, two_sessions: Path) -> None:
    path, recording = copied(two_sessions, tmp_path), SESSIONS[2]
    live = engine(path, recording, Config(live={"checkpoint_s": 1e-9, "revision_s": 0.0}))
    for _ in fed(live, recording):
        pass
    live.close()
    (left,) = path.with_name("site.evermap.live").glob("*.readings")
    left.write_bytes(left.read_bytes()[:-1000])
    (brought,) = em.recover(path)
    assert brought.revision == 3
    assert brought.entered is not None
    assert 0.8 * len(recording.frames) < len(brought.entered.session.recording.frames) <= len(recording.frames)


def test_a_session_that_is_of_another_place_is_set_aside(tmp_path: Path, two_sessions: Path) -> None:
    path, recording = copied(two_sessions, tmp_path), SESSIONS[2]
    ids = recording.detections.landmark_id
    strange = replace(
        recording, detections=replace(recording.detections, landmark_id=np.where(ids >= 0, ids + 900, ids))
    )
    with engine(path, strange) as live:
        for _ in fed(live, strange):
            pass
        assert live.save() is None
        assert "set aside" in live.step().warnings[0]
    (aside,) = path.with_name("site.evermap.live").glob("aside-*")
    assert len(em.read_recording(aside).frames) == len(recording.frames)
    with open_store(path) as store:
        assert store.head() == 2


def test_a_session_that_meets_a_bug_stops_none_behind_it(
    tmp_path: Path, two_sessions: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = copied(two_sessions, tmp_path)
    for recording in SESSIONS[2:4]:
        spool = Spool(path)
        spool.write(recording)
        spool.close()
    entered = iter([np.linalg.LinAlgError("Singular matrix")])

    def enter(*given: Any) -> Entered:
        if (bug := next(entered, None)) is not None:
            raise bug
        return enter_session(*given)

    monkeypatch.setattr("evermap.live.spool.enter_session", enter)
    aside, brought = em.recover(path)
    assert "a bug in evermap: LinAlgError: Singular matrix; its readings are in " in aside.problem
    (kept,) = path.with_name("site.evermap.live").glob("aside-*")
    assert len(em.read_recording(kept).frames) == len(SESSIONS[2].frames)
    assert brought.revision == 3
    assert em.recover(path) == ()


def test_frames_that_are_left_out_change_no_pose_of_the_others(tmp_path: Path) -> None:
    """What a relinearisation takes is done in their time. Only poses that were told before it had ended differ."""
    config = Config(live={"readings_hz": 3.0, "revision_s": 0.0}, slam=SlamConfig(vote_ids=False, online=True))
    with engine(tmp_path / "site.evermap", SESSIONS[0], config) as live:
        steps = list(fed(live, SESSIONS[0]))
        made = live.save()
    assert made is not None
    kept = made.session.recording
    assert len(kept.frames) < 0.7 * len(SESSIONS[0].frames)
    ours, replayed = online(steps), em.run_session(kept, None, config).slam.online
    both, mine, theirs = np.intersect1d(ours.stamp_s, replayed.stamp_s, return_indices=True)
    assert len(both) > 50
    apart = np.abs(ours.pose_world_robot[mine] - replayed.pose_world_robot[theirs]).max(axis=1)
    assert np.mean(apart > 1e-6) < 0.1


def test_more_readings_than_the_map_needs_are_thinned(tmp_path: Path, two_sessions: Path) -> None:
    path, recording = copied(two_sessions, tmp_path), SESSIONS[2]
    with engine(path, recording, Config(live={"readings_hz": 5.0, "revision_s": 0.0})) as live:
        steps = list(fed(live, recording))
        made = live.save()
    assert made is not None
    kept = made.session.recording
    assert len(kept.detections) < 0.5 * len(recording.detections)
    assert len(online(steps)) > 0.9 * len(recording.frames)  # poses are told of all


@pytest.mark.parametrize(
    ("say", "told"),
    [
        (lambda live: live.odometry(float("nan"), 1.0), "stamp_s': nan where a finite number"),
        (lambda live: live.odometry(1.0, float("inf")), "forward_mps': inf where a finite number"),
        (lambda live: live.odometry(1e12, 1.0), "not in milli- or nanoseconds"),
        (lambda live: live.odometry("soon", 1.0), "'soon' is not a number"),
        (lambda live: live.detections(1.0, [1], [float("nan")], [0.0]), "range_m': row 0: nan"),
        (lambda live: live.detections(1.0, [1], [2.0], [float("nan")]), "bearing_rad': a range without a bearing"),
        (lambda live: live.detections(1.0, [1], [-1.0], [0.0]), "greater than zero"),
        (lambda live: live.detections(1.0, [1, 2], [1.0], [0.0, 0.0]), "1 values for 2 detections"),
        (lambda live: live.detections(1.0, [1.5], [1.0], [0.0]), "1.5 is not an identity"),
        (lambda live: live.detections(1.0, [-2], [1.0], [0.0]), "-2 is not an identity"),
        (lambda live: setattr(live, "mapping", True), "a map in memory cannot be changed"),
        (lambda live: live.save(), "a map in memory cannot be changed"),
    ],
)
def test_mistakes_are_one_line(say, told: str) -> None:
    live = em.Engine(LivingMap(), Sensor(range_max_m=8.0), mapping=False)
    with pytest.raises(InputError) as caught:
        say(live)
    line = caught.value.one_line()
    assert told in line
    assert "try: " in line
    assert "\n" not in line


def test_mistakes_of_the_beginning_are_one_line(tmp_path: Path) -> None:
    for sensor, told in (("no.toml", "No such file"), (3, "a Sensor is needed")):
        with pytest.raises(InputError, match=told):
            em.Engine(LivingMap(), sensor, mapping=False)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="a map in memory cannot be changed"):
        em.Engine(LivingMap(), Sensor(range_max_m=8.0))
    with pytest.raises(ConfigError, match="is not below"):
        em.Engine(LivingMap(), Sensor(5.0, 1.0), mapping=False)
    with pytest.raises(ConfigError, match="unknown_ids"):
        em.Engine(tmp_path / "m.evermap", Sensor(range_max_m=8.0), Config(slam={"unknown_ids": True}))
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"cannot be written: .*\(try: mapping=False\)"):
        em.Engine(tmp_path / "file" / "m.evermap", Sensor(range_max_m=8.0))
    with pytest.raises(InputError, match="a map in space"):
        em.Engine(LivingMap.in_space(), Sensor(range_max_m=8.0), mapping=False)
    there = LivingMap.begun(Landmarks.at([0], [[1.0, 0.0]], sigma_m=0.1))
    with pytest.raises(
        InputError, match=r"stamps are on the clock 'unix', those of the map on 'recording' \(try: .*clock='recording'"
    ):
        em.Engine(there, Sensor(range_max_m=8.0), mapping=False)
    with pytest.raises(InputError):
        em.Engine(tmp_path / "none.evermap", Sensor(range_max_m=8.0), mapping=False)


def test_a_stamp_that_runs_backwards_beyond_the_window_is_refused_and_counted() -> None:
    live, _ = standing(30.0, lambda _: [0, 1, 2])
    with pytest.raises(InputError, match=r"odometry of 3.000 s came too late.*\(try: one clock"):
        live.odometry(3.0, 1.0)
    with pytest.raises(InputError, match=r"detections of 3\.000 s came too late"):
        live.detections(3.0)
    assert live.late == 2
    assert not live.step().lost


def test_a_clock_that_hiccups_is_not_followed_and_one_that_is_set_is() -> None:
    live, _ = standing(30.0, lambda _: [0, 1, 2])
    live.odometry(86_400.0, 0.0)
    assert live.step().stamp_s == pytest.approx(29.9)
    for k in range(20):
        live.odometry(30.0 + 0.1 * k, 0.0)
        live.detections(30.0 + 0.1 * k, [0, 1], np.hypot(*MARKS[:2].T), np.arctan2(MARKS[:2, 1], MARKS[:2, 0]))
        now = live.step()
    assert now.stamp_s == pytest.approx(31.9)
    assert not now.lost
    for k in range(20):  # both streams: the robot slept
        live.odometry(5000.0 + 0.1 * k, 0.0)
        live.detections(5000.0 + 0.1 * k, [0, 1, 2], np.hypot(*MARKS[:3].T), np.arctan2(MARKS[:3, 1], MARKS[:3, 0]))
        now = live.step()
    assert now.stamp_s == pytest.approx(5001.9)
    assert not now.lost


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_whatever_comes_in_is_taken_or_refused_in_one_line(tmp_path: Path, two_sessions: Path, seed: int) -> None:
    """Late, twice, never, of no time, no numbers: the drive goes on, and enters the map."""
    rng, recording, path = np.random.default_rng(seed), SESSIONS[2], copied(two_sessions, tmp_path)
    order = sorted(messages(recording), key=lambda one: one[0] + rng.choice([0.0, 0.05, 0.5], p=[0.9, 0.08, 0.02]))
    lines = []
    with engine(path, recording) as live:
        for message in order:
            wrong = rng.random()
            if wrong < 0.02:
                continue
            try:
                if wrong < 0.04:
                    live.odometry(message[0], rng.choice([np.nan, np.inf, 1e9]))
                elif wrong < 0.05:
                    live.odometry(message[0] + rng.choice([-1e4, 1e5]), 0.1)
                elif wrong < 0.06:
                    live.detections(message[0] + rng.choice([-1e4, 1e5, np.nan]), [3], [1.0], [0.0])
                elif wrong < 0.07:
                    live.detections(message[0], [-5, 1], [1.0, 2.0], [0.0, 9.0])
                send(live, recording, message)
                if wrong > 0.97:
                    send(live, recording, message)
            except InputError as error:
                lines.append(error.one_line())
            now = live.step()
        made = live.save()
    assert len(lines) > 10
    assert not any("\n" in line for line in lines)
    assert not now.lost
    assert made is not None
    assert len(made.session.recording.frames) > 0.8 * len(recording.frames)


def test_what_was_driven_before_an_error_in_the_block_is_entered_by_the_next(
    tmp_path: Path, two_sessions: Path
) -> None:
    path, recording = copied(two_sessions, tmp_path), SESSIONS[2]

    def drive() -> None:
        with engine(path, recording) as live:
            raise ZeroDivisionError(len(list(fed(live, recording))))

    with pytest.raises(ZeroDivisionError):
        drive()
    with open_store(path) as store:
        assert store.head() == 2
    assert [brought.revision for brought in em.recover(path)] == [3]


WARM = """
import gc, sys
sys.path[:0] = [{here!r}]
from feeding import SESSIONS, engine, fed
from numba.core.dispatcher import Dispatcher
def compiled():
    kernels = [one for one in gc.get_objects() if isinstance(one, Dispatcher)]
    return {{(str(one.py_func), str(kind)) for one in kernels for kind in one.signatures}}
live = engine({path!r}, SESSIONS[{number}])
live.warm_up()
before = compiled()
assert len(list(fed(live, SESSIONS[{number}]))) > 100
live.close()
print(sorted(compiled() - before))
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 2])
def test_after_warm_up_no_step_waits_for_a_kernel(tmp_path: Path, two_sessions: Path, number: int) -> None:
    path = copied(two_sessions, tmp_path) if number else tmp_path / "new.evermap"
    code = WARM.format(here=str(Path(__file__).parent), path=str(path), number=number)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_blas_has_one_thread_within_steps_and_jobs_and_the_users_number_between(
    tmp_path: Path, two_sessions: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two: the machine may have one only, of which this would show nothing."""

    def threads() -> set[int]:
        return {one["num_threads"] for one in threadpool_info() if one["internal_api"] == "openblas"}

    within: dict[str, set[int]] = {"step": set(), "judge": set()}

    def spy(kind: type, name: str) -> None:
        real = getattr(kind, name)

        def spied(*given: Any) -> Any:
            found = real(*given)
            within[name].update(threads())
            return found

        monkeypatch.setattr(kind, name, spied)

    spy(Localizer, "step")
    spy(Judge, "judge")
    recording = SESSIONS[2]
    with threadpool_limits(limits=2, user_api="blas"):
        live = engine(copied(two_sessions, tmp_path), recording, mapping=False, beside=True)
        jobs, between = live._keeper._jobs, []
        for step, _ in enumerate(fed(live, recording)):
            if step % 2 == 0:  # for a while beside a job, for a while after it, however fast the machine is
                wait(list(jobs.values()))
            if all(job.done() for job in jobs.values()):
                between.append(threads())
        live.close()
        assert threads() == {2}
    assert within == {"step": {1}, "judge": {1}}
    assert len(between) > 100
    assert all(one == {2} for one in between)


@pytest.mark.slow
def test_a_recording_of_a_real_robot(tmp_path: Path, shared_data: Path) -> None:
    """MRCLAM 6, robot 3, a map that nobody knew: three revisions while it drives, and the robot stays localised."""
    recording = em.read_recording(shared_data / "mrclam" / "MRCLAM_Dataset6.zip", robot=3)
    with engine(tmp_path / "site.evermap", recording, Config()) as live:
        steps = list(fed(live, recording))
    assert steps[-1].revision >= 2
    in_map = [one for one in steps if one.frame == "prior_map"]
    assert np.mean([one.lost for one in in_map]) < 0.02
    ours = online(in_map)
    whole = em.run_slam(recording).trajectory
    both, mine, theirs = np.intersect1d(ours.stamp_s, whole.stamp_s, return_indices=True)
    assert len(both) > 1000
    gap_m = ours.pose_world_robot[mine, :2] - whole.pose_world_robot[theirs, :2]
    assert np.sqrt((gap_m**2).sum(axis=1).mean()) < 0.15
