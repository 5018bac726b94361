"""Drive-and-turn against a Monte Carlo of the robot it stands for, and what it does at the start."""

from __future__ import annotations

import numpy as np
import pytest

from tab_marl.field import FieldOptions, FieldProblem, solve
from tab_marl.field.processes import drive_and_turn
from tab_marl.field.processes.drive_and_turn import RESTS_PER_STOP, STOPS_PER_RUN
from tab_marl.field.processes.tumble import TURNS_PER_RUN
from tab_marl.world.grid import GridMap
from tab_marl.world.regions import Box
from tab_marl.world.scenario import Robot, Scenario

TURN, REST, RUN, SPEED = 0.9, 20.0, 1.0, 0.11
OPEN = Scenario(
    "open", (), Box(0, 0, 1, 1), Box(0, 0, 1, 1), 4.05, 4.05, adversary=Robot(0.01), central_zone_metres=0.3
)


def test_positions_and_modes_agree_with_a_simulated_robot() -> None:
    grid = GridMap.from_scenario(OPEN, 0.05)
    reference = drive_and_turn(grid, SPEED, TURN, REST, 16, RUN)
    middle, ticks, robots = int(grid.cells_of([(2.025, 2.025)])[0]), 8, 40_000
    mass = np.zeros(reference.states)
    mass.reshape(-1, reference.modes)[middle] = reference.first_mode_shares()
    step = reference.matrix()
    for _ in range(ticks):
        mass = mass @ step
    by_cell = mass.reshape(-1, reference.modes)

    rng = np.random.default_rng(7)
    stop, veer = SPEED / RUN * STOPS_PER_RUN, SPEED / RUN * TURNS_PER_RUN
    turned = TURN / (np.pi / 2)
    turning_time, resting_time = (1 - RESTS_PER_STOP) / turned, RESTS_PER_STOP * REST
    kind = np.where(
        rng.random(robots) < turning_time / (turning_time + resting_time), 1, 2
    )  # 0 drives, 1 turns, 2 rests
    heading = rng.integers(16, size=robots)
    at = np.zeros((robots, 2))
    for _ in range(ticks):
        chance, anew = rng.random(robots), rng.integers(16, size=robots)
        drives, leaves = kind == 0, chance < np.where(kind == 1, turned, 1 / REST)
        heading = np.where(drives & (chance < veer), (heading + rng.choice([-1, 1], robots)) % 16, heading)
        stops = drives & (chance >= veer) & (chance < veer + stop)
        heading = np.where(~drives & leaves, anew, heading)
        kind = np.where(stops, np.where(rng.random(robots) < RESTS_PER_STOP, 2, 1), np.where(drives | leaves, 0, kind))
        angle = heading * 2 * np.pi / 16
        at += SPEED * (kind == 0)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    shares = [by_cell[:, :16].sum(), by_cell[:, 16].sum(), by_cell[:, 17].sum()]
    assert shares == pytest.approx([float((kind == k).mean()) for k in range(3)], abs=0.012)
    away = grid.centres - grid.centres[middle]
    spread = by_cell.sum(axis=1) @ (away**2).sum(axis=1)
    # Rounding to cells adds at most a quarter of a cell squared per axis and tick.
    assert (at**2).sum(axis=1).mean() <= spread + 0.02 and spread <= (at**2).sum(
        axis=1
    ).mean() + 0.02 + ticks * 0.05**2 / 2
    assert by_cell.sum(axis=1) @ away == pytest.approx([0, 0], abs=1e-3)  # no direction is preferred


def test_it_begins_at_rest_and_stays_a_distribution() -> None:
    grid = GridMap.from_scenario(OPEN, 0.45)
    reference = drive_and_turn(grid, [0.4, 0.2], TURN, REST, 8, RUN)
    first = reference.first_mode_shares()
    assert first[:8].sum() == 0 and first.sum() == pytest.approx(1)
    assert np.allclose(reference.mix.sum(axis=2), 1) and reference.mode_shares()[:8].sum() > 0.5
    sums = np.asarray(reference.matrix(1).sum(axis=1))
    assert sums.max() <= 1 + 1e-12 and sums.min() < 1  # runs into walls are lost, all else is kept


def test_a_field_on_it_starts_where_the_robot_stands() -> None:
    scenario = Scenario.preset("lab")
    found = {
        name: solve(FieldProblem.from_mission("Reach Checkpoint A within 25s", scenario, FieldOptions(reference=name)))
        for name in ("drive_and_turn", "run_and_tumble")
    }
    start = np.asarray(scenario.adversary_start.centre)

    def moved(name: str) -> float:
        field = found[name]
        assert field.problem.grid is not None
        return float(field.occupancy[1] @ np.hypot(*(field.problem.grid.centres - start).T))

    assert moved("drive_and_turn") < moved("run_and_tumble")
    assert found["drive_and_turn"].completes == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"radians_per_tick": 0.0}, "radians_per_tick is 0.0, must be finite and > 0"),
        ({"rest_ticks": 0.5}, "rest_ticks is 0.5, must be finite and >= 1"),
        ({"mean_run_metres": float("nan")}, "mean_run_metres is nan"),
        ({"headings": 2}, "headings is 2, must be >= 3"),
    ],
)
def test_bad_numbers_are_refused(arguments: dict[str, float], message: str) -> None:
    given = {"radians_per_tick": TURN, "rest_ticks": REST} | arguments
    with pytest.raises(ValueError, match=message):
        drive_and_turn(GridMap.from_scenario(OPEN, 0.45), 0.1, **given)  # type: ignore[arg-type]
