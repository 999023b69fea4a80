"""New lines of sight: how much of them nobody saw through, how probably they are clear, and a street driven back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.config import Config, LivingConfig, with_overrides
from evermap.maps.living import EXISTS, LivingMap
from evermap.maps.sessions.looks import PlaceLooks, Sighting, Watch, looked_at
from evermap.maps.sessions.open_space import NewLooks, OpenSpace, Rays, weigh_new_lines
from evermap.pipeline import run_session
from evermap.sensing.kernels import unseen_length
from evermap.sensing.sightlines import SightLines
from evermap.types import ChangeKind, Sensor
from evermap_studies.worlds.parking import DAY_S, Parking

from .scenes import begun, found

CONFIG = LivingConfig()
WALLS, METRES, HIDDEN, SHOWN = CONFIG.sight.open_space
WIDE_M, NARROW_M, STEP_M = 0.35, 0.05, 0.1


def unseen(
    eye: tuple[float, float], place: tuple[float, float], rays: list[tuple[float, float, float, float]]
) -> float:
    """Of one line to 0, with rays to others; one of five numbers is to what it says."""
    ends = np.array([ray[:4] for ray in rays]).reshape(-1, 4)
    body = np.array([int(ray[4]) if len(ray) > 4 else 1 for ray in rays])
    columns = (np.array([eye]), np.array([place]), np.zeros(1, dtype=np.int64), ends[:, :2].copy(), ends[:, 2:].copy())
    return float(unseen_length(*columns, body, (WIDE_M, NARROW_M, STEP_M))[0])


@pytest.mark.parametrize(
    ("rays", "wanted"),
    [
        pytest.param([], 10.0, id="no ray"),
        pytest.param([(0.0, 0.0, 15.0, 0.0)], 0.0, id="one that leads past the place"),
        pytest.param([(0.0, 0.0, 6.0, 0.0)], 4.0, id="one that ends before it"),
        pytest.param([(0.0, 0.0, 6.0, 0.0), (20.0, 0.0, 4.0, 0.0)], 0.0, id="two from both ends"),
        pytest.param([(0.0, 0.0, 15.0, 0.0, 0)], 10.0, id="to what is missed itself"),
        pytest.param([(0.0, -4.0, 10.0, 6.0)], 10.0 - 0.5, id="one that crosses it"),
        pytest.param([(-5.0, 0.2, 15.0, 0.2)], 5.0, id="beside it, narrower where it ends"),
        pytest.param([(-5.0, 0.0, -1.0, 0.0)], 10.0, id="behind the sensor"),
    ],
)
def test_the_length_of_a_line_on_which_no_ray_passed(rays: list[tuple[float, ...]], wanted: float) -> None:
    """From (0, 0) to (10, 0); a ray is .35 m wide where it begins, and .05 m where it ends."""
    assert unseen((0.0, 0.0), (10.0, 0.0), rays) == pytest.approx(wanted, abs=2.5 * STEP_M)


def weigh(
    teachers: list[tuple[float, bool]], u: float = 2.0, p_gone: float = 0.05, of: list[int] | None = None
) -> OpenSpace:
    """What is said of 0, missed along a line of which `u` metres were not seen through, by others that were seen along
    lines with some metres, or missed along these though they stand; `of` are their names if they have several lines.
    """
    frames, rest = 4, [(u, False), *teachers]
    n = len(rest)
    row, name = np.repeat(np.arange(n), frames), np.array([0, *(of or range(1, n))])
    eye, length = np.column_stack([np.zeros(n), 100.0 * np.arange(n)]), 10.0
    place = eye + [length, 0.0]
    hit = np.array([seen for _, seen in rest])[row]
    covered = np.array([length - metres for metres, _ in rest])
    rays = Rays(eye, eye + np.column_stack([covered, np.zeros(n)]), np.full(n, n))
    looks = NewLooks(name[row], row, hit, np.full(len(row), 0.98), eye[row], place[row])
    gone = np.full(n, 1e-3)
    gone[0] = p_gone
    teaches = np.ones(n, dtype=np.bool_)
    before = np.array([WALLS, METRES, HIDDEN, SHOWN])
    return weigh_new_lines(rays, looks, gone, teaches, before, CONFIG.sight.clear, CONFIG.looks)


@pytest.mark.parametrize("u", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("shown", [0, 1, 5, 30])
def test_lines_on_which_others_are_seen_open_a_line(shown: int, u: float) -> None:
    """Walls are a Poisson process along what nobody saw through, their rate gamma distributed: no wall was in what the
    others were seen through. By hand, with the moments of both distributions.
    """
    each = 4.0
    found_ = weigh([(each, True)] * shown, u)
    metres, u = METRES + shown * each, max(u, CONFIG.looks.beside_m)
    no_wall = (metres / (metres + u)) ** WALLS
    not_hidden = 1.0 - HIDDEN / (HIDDEN + SHOWN + shown)
    assert found_.unseen_m[0] == pytest.approx(u, abs=2.0 * STEP_M)
    assert found_.p_clear[0] == pytest.approx(no_wall * not_hidden, abs=3e-3)
    assert found_.counts[:4].all() == (found_.p_clear[0] >= CONFIG.sight.clear)
    assert not found_.counts[4:].any()


def test_without_others_no_line_of_any_length_is_open() -> None:
    assert weigh([], 0.0).p_clear[0] < 0.5
    assert not weigh([], 0.0).counts.any()


def test_what_stands_and_is_missed_shows_walls() -> None:
    """In a house some of what stands is behind walls: nothing is said of what is missed."""
    shown = [(4.0, True)] * 12
    street, house = weigh(shown), weigh([*shown, *[(2.0, False)] * 5])
    assert street.p_clear[0] > 0.95
    assert house.p_clear[0] < 0.8
    assert house.counts.sum() == 0
    rate = house.learned[0] / house.learned[1]
    hidden = house.learned[2] / house.learned[2:].sum()
    assert 1.0 - (1.0 - hidden) * np.exp(-2.0 * rate) == pytest.approx(5.0 / 18.0, abs=0.05)  # five of eighteen


def test_lines_along_which_is_missed_what_is_seen_along_others_show_walls() -> None:
    """Each of some is seen along one of two lines, whichever way; half of the lines are closed."""
    names = [*range(1, 13), *range(1, 13)]
    both, one = (weigh([(4.0, True)] * 12 + [(4.0, seen)] * 12, of=names) for seen in (True, False))
    assert both.p_clear[0] > 0.95
    assert one.p_clear[0] < 0.8
    # of each the mean of its lines counts, as one: half a wall in two metres, but for the prior
    metres = METRES + 12 * 2.0
    rate = one.learned[0] / one.learned[1]
    assert rate == pytest.approx((WALLS + 6.0) / (metres + 6.0 * 2.0), rel=0.25)


def test_what_is_missed_does_not_close_its_own_line() -> None:
    """Its own miss is the evidence on it: it counts once, whatever its prior."""
    shown = [(4.0, True)] * 12
    assert weigh(shown, p_gone=0.01).p_clear[0] == pytest.approx(weigh(shown, p_gone=0.5).p_clear[0], rel=1e-6)


def test_what_a_session_learned_is_worth_so_much_to_the_next() -> None:
    found_ = weigh([(8.0, True)] * 60, p_gone=0.99)
    rate, metres, hidden, shown = found_.learned
    assert metres <= CONFIG.looks.most_unseen_m + 1e-9
    assert hidden + shown <= CONFIG.looks.most_new + 1e-9
    assert rate / metres == pytest.approx(WALLS / 480.0, rel=0.1)
    assert hidden / (hidden + shown) == pytest.approx(HIDDEN / 61.0, rel=0.2)


SENSOR = Sensor(range_max_m=40.0, bearing_min_rad=-1.0, bearing_max_rad=1.0, p_detect=0.9)


def a_row(seen: tuple[int, ...], p_here: float = 0.95, *, forth: bool = False) -> tuple[LivingMap, PlaceLooks]:
    """Things on both sides of a way, known from one side, and passed from the other: some are seen. Before that the
    session may see all of them from where they are known.
    """
    place_m = {k: (6.0 * (k // 2), 4.0 if k % 2 else -4.0) for k in range(20)}
    living = begun(found([*place_m], [*place_m.values()]), LivingConfig(cliques=False)).living
    names = living.places.site_id, living.places.landmark_id
    place = np.repeat(np.arange(20), 5)
    eye = living.places.position_m[place] * [1.0, 0.0] - [8.0, 0.0]
    lines = SightLines.empty()
    cell = lines.cells(eye, living.places.position_m[place])
    lines = lines.learned(names, place, cell, np.ones(100, dtype=np.bool_), np.ones(100))
    sites = replace(living.sites, p_here=np.full(20, p_here))
    living = replace(living, sightlines=lines, sites=sites, stamp_s=100.0)
    path = np.column_stack([np.linspace(75.0, -10.0, 170), np.zeros(170), np.full(170, np.pi)])
    if forth:
        path = np.vstack([path[::-1] * [1.0, 1.0, 0.0], path])
    stamp_s = 1000.0 + np.arange(float(len(path)))
    nothing = np.zeros((2, 0), dtype=np.int64)
    listed = Watch.of(Sighting(stamp_s, path, *nothing), living.places.position_m, SENSOR).listed
    x_m = path[listed.pose, 0] - living.places.position_m[listed.landmark, 0]
    known = (np.abs(x_m + 8.0) < 0.3) & (path[listed.pose, 2] == 0.0)
    hit = np.isin(living.places.landmark_id[listed.landmark], seen) | known
    return living, looked_at(living, living.sites.p_here, Watch(stamp_s, listed._replace(hit=hit), path), CONFIG)


def test_what_the_session_saw_is_not_gone_whatever_was_believed_before() -> None:
    """Seen from one side and missed from the other: there is a wall, as probably for what was doubtful."""
    one, other = (a_row(tuple(range(0, 20, 2)), p_here, forth=True)[1].open_space for p_here in (0.95, 0.55))
    assert one[0] / one[1] > 0.01
    np.testing.assert_allclose(other, one, rtol=1e-9)


def test_a_miss_counts_along_new_lines_where_all_others_are_seen() -> None:
    living, looks = a_row(tuple(name for name in range(20) if name != 8))
    mine = living.places.landmark_id[looks.place] == 8
    assert looks.counts[mine & ~looks.rows.hit].any()
    p_hidden = 1.0 - looks.lines.p_free[looks.rows.key[mine]]
    assert p_hidden.max() < 0.05
    assert len(looks.open_space) == 4
    assert looks.open_space[0] / looks.open_space[1] < 0.02


def test_a_miss_says_nothing_where_half_of_what_stands_is_missed() -> None:
    """Of one row all is behind a wall: nothing of it counts, though the other row is seen."""
    living, looks = a_row(tuple(range(0, 20, 2)))
    behind = living.places.landmark_id[looks.place] % 2 == 1
    assert behind.sum() > 100
    assert not looks.counts[behind].any()


@pytest.fixture(scope="module")
def street() -> tuple[Parking, LivingMap]:
    """A street of 24 cars, of which two leave, on the day before that."""
    rng = np.random.default_rng(4)
    street = Parking.of(4, n_slots=24, metres=240.0)
    for slot in range(24):
        street.park(rng, slot, -1e6, 0.5 * DAY_S if slot in (7, 15) else 1e6)
    living = run_session(street.drive(1, 0.0), None, ANY).living
    return street, living


ANY = with_overrides(Config(), ["living.accept=any"])


@pytest.mark.parametrize(("back", "aside_m"), [(True, 0.0), (False, 3.0)])
def test_cars_that_left_are_told_by_a_drive_the_other_way_or_in_the_other_lane(
    street: tuple[Parking, LivingMap], back: bool, aside_m: float
) -> None:
    world, living = street
    session = run_session(world.drive(2, DAY_S, back=back, aside_m=aside_m), living, ANY)
    left = [change for change in session.changes if change.kind is ChangeKind.VANISHED]
    known = session.living.landmarks()
    slot = dict(zip(known.landmark_id.tolist(), world.find_slots(known.position_m[:, :2]).tolist(), strict=True))
    assert {slot[change.landmark_ids[0]] for change in left} == {7, 15}
    assert len(session.changes) == 2
    gone = np.array([slot[name] in (7, 15) for name in known.landmark_id.tolist()])
    assert known.p_exists[gone].max() < EXISTS
    assert known.p_exists[~gone].min() > 0.9
    assert len(session.living.sightlines.open_space) == 4
