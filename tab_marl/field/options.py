"""How a field models motion, and which constraints beyond the mission hold."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from tab_marl.world.scenario import UnknownName


@dataclass(frozen=True)
class FieldOptions:
    """How motion is modelled and which constraints beyond the mission hold."""

    reference: Literal["drive_and_turn", "run_and_tumble", "walk", "paper_walk", "unicycle"] = "run_and_tumble"
    """`drive_and_turn`: straight runs, turns on the spot and rests; it begins at rest. `run_and_tumble`: turns take no
    time. `walk`: memoryless, displacements up to full speed. `paper_walk`: memoryless, all cells within one tick's reach.
    `unicycle`: any speed and turn rate that the robot has, afresh each tick."""
    cell_metres: float | None = None
    """None: the finest of CELL_SIZES_METRES within `state_budget`."""
    headings: int = 16
    """Directions, where the reference has any (in space 6, 14 or 26); halved when even the coarsest cells exceed the budget."""
    mean_run_metres: float = 1.0
    """Of run-and-tumble and drive-and-turn. 0.5 predicts better, neither intercepts better (docs/studies/field.md)."""
    rest_seconds: float = 10.0
    """How long a rest lasts on average, in drive-and-turn."""
    begins_at_rest: bool = False
    """In the plane, run-and-tumble begins facing anywhere and first turns on the spot, as drive-and-turn always does: predicts the first
    seconds better (docs/studies/field.md). False: it begins in full motion."""
    goal_marginals: float = 1.0
    """How far the shares of places that can stand for one another are set: 1, as `goal_nearness` says; 0, as the mission
    and the motion have it; between, that much of the one and the rest of the other."""
    goal_nearness: float = 0.0
    """Where one of several places is to be visited first: a place whose shortest way is x times the nearest one's is visited
    exp(-goal_nearness (x - 1)) times as often. 0, and wherever else places can stand for one another: all equally often.
    1.5 is nearest to what learned adversaries do; expecting it intercepts no more of them (docs/studies/planner.md)."""
    timing_prior: bool = False
    """The completion tick is uniform over the feasible ticks."""
    completion_probability: float = 1.0
    """c of the paper's eq. 1: how likely the adversary completes its mission; below 1 it may fail."""
    kernel: Literal["bridge", "marginal"] = "bridge"
    """`bridge`: the field's own transition law. `marginal`: each next state is drawn from the field's marginal at that
    tick, whatever the present state (the letter of the paper); such trajectories jump."""
    precision: Literal["single", "double"] = "single"
    """Of the stored messages; the work is always done in double precision."""
    state_budget: int = 8_000_000
    """Automaton states x cells x modes up to which finer cells are preferred."""
    only_reachable: bool | None = None
    """Solve only where the adversary can be, given its start: the same law in less time and memory, but a belief that a
    sighting contradicts finds less to fall back on. None: where the whole table would exceed `state_budget`."""
    memory_gigabytes: float = 4.0
    """`solve` refuses a problem that needs more (1 GB = 1e9 bytes)."""
    marginal_tolerance: float = 0.05
    """Relative error at which goal marginals, timing priors and completion probability are met."""
    constraint_tolerance: float = 1e-4
    """Error of a probability at which a soft constraint is met."""
    max_iterations: int = 60
    """Of the fit of their weights."""
    least_share: float = 1e-9
    """A place or tick that the reference reaches less often than this share is not feasible and gets no equal share."""

    def __post_init__(self) -> None:
        for name, known in (
            ("reference", ("drive_and_turn", "run_and_tumble", "walk", "paper_walk", "unicycle")),
            ("kernel", ("bridge", "marginal")),
            ("precision", ("single", "double")),
        ):
            if getattr(self, name) not in known:
                raise UnknownName(f"FieldOptions.{name}", str(getattr(self, name)), known)
        for name in (
            "cell_metres",
            "mean_run_metres",
            "rest_seconds",
            "marginal_tolerance",
            "constraint_tolerance",
            "state_budget",
            "memory_gigabytes",
        ):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"FieldOptions.{name} is {value}, must be > 0")
        if not 0 <= self.goal_marginals <= 1:
            raise ValueError(
                f"FieldOptions.goal_marginals is {self.goal_marginals}, must lie in [0, 1]: 1 for equal shares, 0 for none of it"
            )
        if not (math.isfinite(self.goal_nearness) and self.goal_nearness >= 0):
            raise ValueError(
                f"FieldOptions.goal_nearness is {self.goal_nearness}, must be finite and >= 0 (0: equal shares)"
            )
        if not 0 < self.completion_probability <= 1:
            raise ValueError(
                f"FieldOptions.completion_probability is {self.completion_probability}, must lie in (0, 1]"
            )
        if self.headings < 4:
            raise ValueError(f"FieldOptions.headings is {self.headings}, must be >= 4")
        if self.max_iterations < 1:
            raise ValueError(f"FieldOptions.max_iterations is {self.max_iterations}, must be >= 1")

    @classmethod
    def preset(cls, name: str) -> FieldOptions:
        """`default`, or `paper`: the literal field (memoryless, the mission alone) with displacements repaired."""
        presets = {"default": cls(), "paper": cls(reference="walk", goal_marginals=0.0)}
        if name not in presets:
            raise UnknownName("field preset", name, presets)
        return presets[name]
