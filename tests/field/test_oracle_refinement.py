"""Refining the grid converges, and at the rate it should: slopes are fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse, stats

from tab_marl.field import FieldOptions, FieldProblem, solve
from tab_marl.mission import Constraint, FiniteAutomaton, Mission
from tab_marl.world.regions import Box
from tab_marl.world.scenario import Robot, Scenario


def test_a_walk_on_ever_finer_cells_becomes_brownian_motion():
    """Steps of h every h^2 seconds: P(one metre up within one second) is 2 (1 - Phi(1)) (reflection), the error O(h^2)."""
    exact = 2 * stats.norm.sf(1.0)
    sizes, errors = [], []
    for per_metre in (4, 8, 16, 32):
        ticks, cells = per_metre**2, 5 * per_metre
        half = np.full(cells - 1, 0.5)
        step = sparse.diags_array([half, half], offsets=[-1, 1])
        labels = np.zeros(cells, dtype=int)
        labels[-1] = 1
        start = np.zeros(cells)
        start[-1 - per_metre] = 1.0
        reach = FiniteAutomaton(delta=[[0, 1], [1, 1]], initial=0, accepting=1)
        field = solve(FieldProblem.from_arrays(step, labels=labels, automaton=reach, start=start, horizon=ticks))
        sizes.append(1 / per_metre)
        errors.append(abs(np.exp(field.log_partition) - exact))
    slope = np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert slope == pytest.approx(2.0, abs=0.1)
    assert errors[-1] < 1e-3 * exact


def test_the_field_of_a_mission_converges_in_the_plane():
    """Walls and regions lie on cell edges at every size: what is left is rounding within cells, of second order."""
    world = replace(
        Scenario.preset("open"), adversary=Robot(radius_metres=1e-6, max_speed=0.2), step_seconds=1.0, horizon_seconds=40.0,
        adversary_start=Box(0.5, 0.5, 1.0, 1.0),
    )  # fmt: skip
    mission = Mission((Constraint("deadline", ("top right",), seconds=40.0),))
    found = []
    for metres in (0.1, 0.05, 0.025, 0.0125):
        options = FieldOptions(reference="walk", cell_metres=metres, goal_marginals=False, precision="double")
        field = solve(FieldProblem.from_mission(mission, world, options))
        automaton = field.problem.automaton
        completing = (field.transitions * (automaton.delta == automaton.accepting)).sum(axis=1)
        found.append([field.log_partition, float(completing @ (automaton.rank - 1.0))])
    away = np.abs(np.diff(found, axis=0))  # of log Z and of the mean tick of completion
    order = np.log2(away[:-1] / away[1:])
    assert (order > 1.5).all() and (order < 2.5).all()
    assert away[-1][0] < 0.03 and away[-1][1] < 0.02
