"""Oracles of the field: everything here enumerates trajectories or states one by one, in plain Python."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from tab_marl.field import FieldProblem
from tab_marl.mission import COMPLETED, FAILED, compile_mission
from tab_marl.world.regions import Box
from tab_marl.world.scenario import Checkpoint, Robot, Scenario


@dataclass
class Enumeration:
    """Every trajectory of `horizon` ticks with its probability under the reference, started from mu0."""

    states: np.ndarray  # [N, T + 1] base states
    reference: np.ndarray  # [N] mu0(cell) * share(mode) * product of Q
    completed_tick: np.ndarray  # [N], -1 never
    failed: np.ndarray  # [N] bool
    visits: np.ndarray  # [N, B]
    modes: int

    @property
    def cells(self) -> np.ndarray:
        return self.states // self.modes

    def tilted(self, log_weights: np.ndarray) -> np.ndarray:
        """[N] the law with P(cell at tick 0) = mu0 and trajectories reweighted by exp(log_weights)."""
        weight = self.reference * np.exp(log_weights)
        first = self.cells[:, 0]
        out = np.zeros(len(weight))
        for cell in np.unique(first):
            here = first == cell
            total = weight[here].sum()
            if total > 0:
                out[here] = weight[here] / total * self.reference_start[cell]
        return out / out.sum()

    reference_start: dict | None = None

    def fit(self, features: np.ndarray, targets: np.ndarray, allowed: np.ndarray) -> np.ndarray:
        """Exponential tilting of the allowed trajectories to E[features] = targets, by Newton on the convex dual."""
        theta = np.zeros(features.shape[1])
        base = np.where(allowed, 0.0, -np.inf)
        first = self.cells[:, 0]
        for _ in range(200):
            law = self.tilted(base + features @ theta)
            gap = targets - law @ features
            if np.abs(gap).max() < 1e-15:
                break
            curvature = np.zeros((len(theta), len(theta)))
            for cell in np.unique(first):
                here = first == cell
                mass = law[here].sum()
                if mass > 0:
                    centred = features[here] - (law[here] / mass) @ features[here]
                    curvature += (centred * law[here, None]).T @ centred
            step = np.linalg.lstsq(curvature, gap, rcond=1e-12)[0]
            theta += step * min(1.0, 2.0 / max(np.abs(step).max(), 1e-300))
        return law

    def divergence(self, law: np.ndarray) -> float:
        used = law > 0
        return float(law[used] @ np.log(law[used] / self.reference[used]))

    def occupancy(self, law: np.ndarray, cells: int) -> np.ndarray:
        return np.stack([np.bincount(self.cells[:, t], law, minlength=cells) for t in range(self.states.shape[1])])


def enumerate_trajectories(problem: FieldProblem, horizon: int, advance=None) -> Enumeration:
    """All trajectories; the reference is killed where its rows say so until the mission ends, then rescaled to 1.

    `advance(state or None, cell) -> (state, "active" | "completed" | "failed", branch or -1)` runs the mission; by
    default the problem's own tables.
    """
    motion = problem.reference
    shares = motion.first_mode_shares()
    matrices = [motion.matrix(r).toarray() for r in range(motion.count)]
    automaton = problem.automaton
    branches = int(automaton.branch.max(initial=-1)) + 1

    def by_tables(state, cell):
        symbol = problem.labels[cell]
        q = automaton.initial if state is None else state
        following = int(automaton.delta[q, symbol])
        status = {automaton.accepting: "completed", automaton.rejecting: "failed"}.get(following, "active")
        return following, status, int(automaton.branch[q, symbol])

    def by_mission(state, cell):
        return advance(state, cell)

    run = by_tables if advance is None else by_mission
    out = []

    def grow(path, probability, state, status, done, visits, tables_state):
        if len(path) == horizon + 1:
            out.append((path, probability, done, status == "failed", visits))
            return
        row = matrices[problem.reference_of[tables_state]][path[-1]]
        if status != "active":
            row = row / row.sum()
        for following in np.flatnonzero(row):
            if status == "active":
                cell = following // motion.modes
                next_state, next_status, branch = run(state, cell)
                next_tables = int(automaton.delta[tables_state, problem.labels[cell]])
                seen = visits
                if branch >= 0 and next_status != "failed":
                    seen = (*visits[:branch], visits[branch] + 1, *visits[branch + 1 :])
                finished = len(path) if next_status == "completed" else -1
                grow(
                    [*path, following],
                    probability * row[following],
                    next_state,
                    next_status,
                    finished,
                    seen,
                    next_tables,
                )
            else:
                grow([*path, following], probability * row[following], state, status, done, visits, tables_state)

    for cell in np.flatnonzero(problem.start):
        for mode in range(motion.modes):
            if shares[mode] == 0:
                continue
            state, status, branch = run(None, cell)
            visits = tuple(int(b == branch and status != "failed") for b in range(branches))
            tables_state = int(automaton.delta[automaton.initial, problem.labels[cell]])
            grow(
                [cell * motion.modes + mode], problem.start[cell] * shares[mode], state, status,
                0 if status == "completed" else -1, visits, tables_state,
            )  # fmt: skip
    found = Enumeration(
        np.array([o[0] for o in out]),
        np.array([o[1] for o in out]),
        np.array([o[2] for o in out]),
        np.array([o[3] for o in out]),
        np.array([o[4] for o in out], dtype=float).reshape(len(out), branches),
        motion.modes,
    )
    found.reference_start = {int(c): float(problem.start[c]) for c in np.flatnonzero(problem.start)}
    return found


def mission_runner(mission, scenario, grid):
    """`advance` from the mission's own automaton, clocks and all: no table of the field's is used."""
    compiled = compile_mission(mission, scenario, scenario.step_seconds)
    masks = compiled.masks(grid.centres)

    def advance(state, cell):
        mask = int(masks[cell])
        following = compiled.first(mask) if state is None else compiled.advance(state, mask)
        before = compiled.initial if state is None else state.location
        branch = -1
        if following.location != before and following.location != FAILED:
            branch = int(compiled.branch[before, mask])
        status = {COMPLETED: "completed", FAILED: "failed"}.get(following.location, "active")
        return following, status, branch

    return advance


def tiny(speed: float = 1.0, **changes) -> Scenario:
    """3 x 3 cells of 1 m, ticks of 1 s: A upper left, B upper right, C middle right, start in the lower row."""
    settings = {
        "name": "tiny",
        "checkpoints": (
            Checkpoint("Checkpoint A", 0.5, 2.5, 0.2, 0.4),
            Checkpoint("Checkpoint B", 2.5, 2.5, 0.2, 0.4),
            Checkpoint("Checkpoint C", 2.5, 1.5, 0.2, 0.4),
        ),
        "ego_start": Box(2, 2, 3, 3),
        "adversary_start": Box(0, 0, 2, 1),
        "adversary": Robot(radius_metres=0.01, max_speed=speed),
        "step_seconds": 1.0,
        "horizon_seconds": 5.0,
        "central_zone_metres": 0.3,
        "exact_seconds": 0.5,
        "exact_fraction": 0.0,
    }
    return Scenario(**(settings | changes))


@pytest.fixture
def oracle():
    """(enumerate_trajectories, mission_runner)."""
    return enumerate_trajectories, mission_runner


@pytest.fixture
def tiny_scenario():
    return tiny
