"""Forecast scores: probabilities sum to one on any grid, sets hold what they claim, and the estimate finds the truth."""

from __future__ import annotations

import numpy as np
import pytest

from tab_marl.evaluation.field_figures import markdown, table
from tab_marl.evaluation.field_study import Cell, rows_of
from tab_marl.evaluation.prediction import REFERENCE_CELL_METRES, Forecast, kernel_forecast, mixed
from tab_marl.world.grid import GridMap
from tab_marl.world.scenario import Scenario

LAB = Scenario.preset("lab")


def some_forecast(cell_metres: float, completed: float = 0.3) -> Forecast:
    grid = GridMap.from_scenario(LAB, cell_metres)
    mass = np.random.default_rng(3).gamma(0.3, size=grid.cells)
    return Forecast(grid, (1 - completed) * mass / mass.sum(), completed)


@pytest.mark.parametrize("cell_metres", [0.05, 0.1, 0.15])
def test_probabilities_of_all_outcomes_sum_to_one(cell_metres: float) -> None:
    forecast = some_forecast(cell_metres)
    points = forecast.grid.centres
    per_area = np.exp(forecast.log_score(points, np.zeros(len(points), dtype=bool)))
    done = np.exp(forecast.log_score(points[:1], np.ones(1, dtype=bool)))[0]
    assert per_area.sum() * (cell_metres / REFERENCE_CELL_METRES) ** 2 + done == pytest.approx(1.0)


def test_the_set_of_a_level_holds_that_share_of_its_own_draws() -> None:
    forecast, rng, count = some_forecast(0.1), np.random.default_rng(5), 20_000
    drawn = rng.choice(forecast.grid.cells + 1, size=count, p=np.append(forecast.mass, forecast.completed))
    completed = drawn == forecast.grid.cells
    points = forecast.grid.centres[np.where(completed, 0, drawn)]
    for level in (0.5, 0.9):
        # The floor of 1 % widens the sets a little: at most by that much.
        assert forecast.covered(points, completed, level, rng).mean() == pytest.approx(level, abs=0.02)


def test_a_better_informed_forecast_scores_higher_and_an_estimate_nears_the_truth() -> None:
    grid, rng = GridMap.from_scenario(LAB, 0.05), np.random.default_rng(6)
    centre, spread = np.array([0.8, 2.2]), 0.12
    shape = np.exp(-((grid.centres - centre) ** 2).sum(axis=1) / (2 * spread**2))
    truth = Forecast(grid, 0.8 * shape / shape.sum(), 0.2)

    def draw(count: int) -> tuple[np.ndarray, np.ndarray]:
        cells = rng.choice(grid.cells, size=count, p=shape / shape.sum())
        return grid.centres[cells], rng.random(count) < 0.2

    points, completed = draw(4000)
    best = truth.log_score(points, completed).mean()
    few, many = (kernel_forecast(grid, *draw(n)).log_score(points, completed).mean() for n in (40, 2000))
    assert few < many < best + 0.01 and many > best - 0.08
    flat = Forecast(grid, np.full(grid.cells, 0.8 / grid.cells), 0.2)
    assert flat.log_score(points, completed).mean() < few
    half = mixed([truth, flat], [1, 3])
    assert half.mass == pytest.approx(0.25 * truth.mass + 0.75 * flat.mass)


def test_a_forecast_must_be_a_distribution() -> None:
    grid = GridMap.from_scenario(LAB, 0.15)
    with pytest.raises(ValueError, match=r"with completed sums to 0\.5"):
        Forecast(grid, np.zeros(grid.cells), 0.5)


def test_a_task_gives_a_row_per_model_and_moment_and_the_table_ranks_them() -> None:
    import pandas as pd

    rows = pd.DataFrame(
        rows_of(Cell("M1", "point", 1.8, 0), ("direct",), 40_000, ("S", "tumble", "knows the population"))
    )
    scored = rows[rows.n > 0]
    start = scored[(scored.watched == 0) & (scored.ahead == 5.0)].set_index("model").log_score
    assert start["knows the population"] > start["tumble"] > start["S"]
    assert "knows the population | " in table(scored[scored.watched == 0]) and "+0.00 [+0.00, +0.00]" in table(
        scored[scored.watched == 0]
    )
    assert markdown(["a"], [["1"]]) == "| a |\n| --- |\n| 1 |"
