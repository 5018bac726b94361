"""Drivers with habits drawn at random: closed forms of what is drawn, and every way before the mission's own monitor."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tab_marl.mission.model import Constraint, Mission
from tab_marl.mission.monitor import Monitor
from tab_marl.mission.tasks import sample_task
from tab_marl.planning.models.drawn_ways import WaysOptions, draw_ways, smooth_noise
from tab_marl.planning.models.mission_map import MissionMap
from tab_marl.world.grid import GridMap, free_points
from tab_marl.world.regions import Box, Disc
from tab_marl.world.scenario import Checkpoint, Scenario

RNG = np.random.default_rng
PLAIN = WaysOptions(drivers=10, cost_deviation=0.0, place_widths=0.0, fence_widths=0.0, late_share=0.0)
"""Drivers without habits."""
FEW = WaysOptions(drivers=12)

OPEN = Scenario(
    name="three goals",
    checkpoints=(
        Checkpoint("Checkpoint A", 0.4, 2.6, 0.15, 0.3),
        Checkpoint("Checkpoint B", 2.6, 2.6, 0.15, 0.3),
        Checkpoint("Checkpoint C", 1.5, 1.3, 0.15, 0.3),
    ),
    ego_start=Disc(2.8, 0.3, 0.1),
    adversary_start=Disc(1.5, 0.4, 0.05),
    horizon_seconds=60.0,
)
PILLAR = replace(OPEN, name="a pillar on the way", obstacles=(Disc(1.4, 1.5, 0.25),))


def deadline(seconds: float, *places: str) -> Mission:
    return Mission((Constraint("deadline", tuple(f"Checkpoint {p}" for p in places), seconds=seconds),), "M1")  # type: ignore[arg-type]


def test_noise_has_unit_variance_everywhere_and_the_correlation_that_it_says() -> None:
    grid = GridMap.from_scenario(OPEN, 0.1)
    fields = smooth_noise(grid, 4000, 0.5, RNG(0))
    assert np.abs(fields.mean(axis=0)).max() < 0.08
    assert np.abs(fields.std(axis=0) - 1.0).max() < 0.06
    middle = int(grid.cells_of([(1.55, 1.55)])[0])
    for distance in (0.2, 0.5, 0.8):
        other = int(grid.cells_of([(1.55 + distance, 1.55)])[0])
        expected = math.exp(-((distance / 0.5) ** 2) / 2)
        assert np.corrcoef(fields[:, middle], fields[:, other])[0, 1] == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize(("mission", "share"), (("M1", 0.9), ("M2", 0.75), ("M3", 0.75), ("M4", 0.9), ("M5", 0.65)))
def test_ways_complete_their_mission_before_the_monitor(mission: str, share: float) -> None:
    """The monitor reads continuous positions, ways read labels on squares of a third of a cell: some brush a place, or wait
    for an exact time, a centimetre on the wrong side.
    """
    agree = []
    for family, seed in (("ambiguous", 3), ("ambiguous", 4), ("perimeter", 5)):
        task = sample_task(RNG(seed), mission, family)
        scenario = task.scenario
        positions, completed = draw_ways(scenario, task.mission, RNG(1), FEW)
        assert positions.shape == (24, scenario.horizon_ticks + 1, 2)
        assert (completed > 0).all()
        for way, done in zip(positions, completed, strict=True):
            monitor = Monitor(task.mission, scenario, scenario.step_seconds)
            monitor.reset(way[0])
            for point in way[1 : done + 1]:
                monitor.step(point)
            agree.append(monitor.status == "completed")
        steps = np.hypot(*np.diff(positions, axis=1).transpose(2, 0, 1))
        assert steps.max() <= scenario.adversary.max_speed * scenario.step_seconds + 1e-9
        on_the_way = positions[scenario.adversary_start.distance(positions) > 0.2]
        assert free_points(scenario, on_the_way, 0.7 * scenario.adversary.radius_metres).all()
    assert np.mean(agree) >= share


def test_drivers_without_habits_take_the_shortest_way() -> None:
    mission = deadline(40.0, "A", "B", "C")
    positions, completed = draw_ways(PILLAR, mission, RNG(2), PLAIN)
    mission_map = MissionMap.build(PILLAR, mission)
    for way, done in zip(positions, completed, strict=True):
        moved = np.hypot(*np.diff(way[: done + 1], axis=0).T).sum()
        shortest = mission_map.route.metres(mission_map.automaton.initial, way[:1])[0]
        assert shortest - 0.15 <= moved <= 1.08 * shortest + 0.15
        turning = np.argmax(np.hypot(*(way - way[0]).T) > 0) - 1
        assert 0 <= turning <= math.ceil(math.pi / PILLAR.adversary.max_turn_rate / PILLAR.step_seconds)
        assert done - turning == pytest.approx(moved / mission_map.reach_metres, abs=1.0)


def test_prices_share_the_choice_of_places() -> None:
    mission = deadline(50.0, "A", "B", "C")
    ends = {}
    for widths in (0.0, 2.0):
        positions, completed = draw_ways(
            OPEN, mission, RNG(4), replace(PLAIN, drivers=300, starts_each=1, place_widths=widths)
        )
        at = positions[np.arange(300), completed]
        places = np.array([(c.x, c.y) for c in OPEN.checkpoints])
        nearest = np.hypot(*(at[:, None] - places).transpose(2, 0, 1)).argmin(axis=1)
        ends[widths] = np.bincount(nearest, minlength=3) / 300
    assert ends[0.0][2] == 1.0
    # The near place is 0.8 m from the start, the far ones 2.3 m: with prices uniform over 6 m it is cheapest for
    # P(u0 + 0.8 < min(u1, u2) + 2.3) = 0.58, by integration.
    assert ends[2.0][2] == pytest.approx(_nearest_share(0.8, 2.3, 6.0), abs=0.08)
    assert ends[2.0][0] == pytest.approx(ends[2.0][1], abs=0.08)


def _nearest_share(near: float, far: float, highest: float) -> float:
    """How often the near place is the cheapest of three, two of which are equally far."""
    u = (np.arange(20000) + 0.5) / 20000 * highest
    return float(np.mean(np.clip(1.0 - (u - (far - near)) / highest, 0.0, 1.0) ** 2))


def test_fences_send_half_the_drivers_round_the_other_side() -> None:
    mission = deadline(50.0, "A")
    behind = replace(PILLAR, checkpoints=(Checkpoint("Checkpoint A", 1.5, 2.6, 0.15, 0.3),))
    sides = {}
    for widths in (0.0, 0.5):
        positions, _ = draw_ways(behind, mission, RNG(5), replace(PLAIN, drivers=200, fence_widths=widths))
        passing = np.abs(positions[..., 1] - 1.5).argmin(axis=1)
        sides[widths] = (positions[np.arange(400), passing, 0] > 1.4).mean()
    assert sides[0.0] == 1.0  # the pillar stands left of the straight line
    assert sides[0.5] == pytest.approx(0.5, abs=0.1)


def test_late_ways_set_out_at_any_time_that_the_mission_leaves() -> None:
    mission = deadline(40.0, "A")
    positions, completed = draw_ways(OPEN, mission, RNG(6), replace(PLAIN, drivers=400, late_share=1.0))
    assert (completed > 0).all() and completed.max() <= 80
    set_out = np.argmax(np.hypot(*(positions - positions[:, :1]).transpose(2, 0, 1)) > 0, axis=1) - 1
    latest = set_out + 80 - completed  # setting out later by what was left at the end
    shares = set_out / latest
    assert np.quantile(shares, (0.25, 0.5, 0.75)) == pytest.approx((0.25, 0.5, 0.75), abs=0.08)


def test_where_time_is_short_habits_give_way_to_the_mission() -> None:
    mission = deadline(40.0, "A")
    shortest = MissionMap.build(PILLAR, mission).route.metres(0, [PILLAR.adversary_start.centre])[0]
    tight = deadline(1.1 * shortest / PILLAR.adversary.max_speed, "A")
    _, completed = draw_ways(PILLAR, tight, RNG(7), replace(FEW, cost_deviation=2.0))
    assert (completed > 0).mean() > 0.9
    _, completed = draw_ways(PILLAR, deadline(0.5 * shortest / PILLAR.adversary.max_speed, "A"), RNG(7), FEW)
    assert (completed == -1).all()


def test_starts_in_obstacles_move_out_and_missions_that_are_over_end_at_once() -> None:
    anywhere = replace(PILLAR, adversary_start=Box(0.2, 0.2, 2.8, 2.8))
    positions, _ = draw_ways(anywhere, deadline(50.0, "A", "B", "C"), RNG(9), replace(FEW, drivers=60))
    assert free_points(anywhere, positions[:, 0], 0.0).all()
    there = replace(OPEN, adversary_start=Disc(0.4, 2.6, 0.05))
    positions, completed = draw_ways(there, deadline(20.0, "A"), RNG(9), FEW)
    assert (completed == 0).all() and (positions == positions[:, :1]).all()


def test_the_same_seed_draws_the_same_ways() -> None:
    task = sample_task(RNG(8), "M4", "ambiguous")
    first, again, other = (draw_ways(task.scenario, task.mission, RNG(seed), FEW)[0] for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize(
    "bad",
    (
        {"drivers": 0},
        {"starts_each": 0},
        {"cost_deviation": -1.0},
        {"cost_deviation": math.inf},
        {"place_widths": math.nan},
        {"fence_widths": -0.1},
        {"smooth_widths": 0.0},
        {"late_share": 1.5},
    ),
)
def test_options_out_of_bounds_are_refused_by_name(bad: dict[str, float]) -> None:
    (name,) = bad
    with pytest.raises(ValueError, match=f"WaysOptions.{name} is"):
        WaysOptions(**bad)  # type: ignore[arg-type]
