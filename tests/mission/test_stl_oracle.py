"""Missions as signal temporal logic: the verdict of a published monitor, rtamt, beside the library's own.

Each kind is written as an STL formula over signed distances, from its meaning and without any table of the library's. The
formulas are evaluated on continuous trajectories sampled at the ticks.

Left out is what STL cannot say: a window over two phases of one visit (leave, come back) followed by more visits, which
needs a clock that the formula can name (three or more timed recurrences, timed recurrences at different places); windows
that count from the start for a later `exact` goal; speed limits, which no position tells; and the tick of completion,
since a formula is only true or false.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import rtamt
from mission_oracle import random_mission, region_of

from tab_marl.mission import Constraint, Mission, Monitor
from tab_marl.world.regions import Box, Disc
from tab_marl.world.scenario import Scenario

SCENARIO = replace(Scenario.preset("open"), horizon_seconds=20.0)
TICK = 0.5
LAST = 40
"""Ticks of a trajectory; the open end of every window."""


class Formula:
    """Writes STL over one signal per place: `p0` is metres inside the place (negative outside)."""

    def __init__(self, mission: Mission) -> None:
        self.mission = mission
        self.places = sorted({p for c in mission.constraints for p in (*c.places, *c.restricted)}, key=str)
        self.text = getattr(self, mission.name)(*mission.goals)

    def signals(self, points: np.ndarray) -> dict[str, list[float]]:
        return {f"p{i}": depth(region_of(p, SCENARIO), points).tolist() for i, p in enumerate(self.places)}

    def at(self, *places) -> str:
        return "(" + " or ".join(f"(p{self.places.index(p)} >= 0)" for p in places) + ")"

    def beside(self, number: int = 0) -> str:
        constraint = self.mission.beside[number]
        return f"(not {self.at(*constraint.places)})" if constraint.avoid else self.at(*constraint.places)

    def window(self, goal: Constraint, since: int = 0) -> str:
        """Ticks of the goal's window, for a formula that starts `since` ticks after the clock did."""
        low, high = 0.0, LAST * TICK
        if goal.type == "deadline":
            high = goal.seconds
        elif goal.type == "exact":
            slack = max(SCENARIO.exact_seconds, SCENARIO.exact_fraction * goal.seconds)
            low, high = goal.seconds - slack, goal.seconds + slack
        first, last = math.ceil(low / TICK - 1e-9), math.floor(high / TICK + 1e-9)
        return f"[{max(first - since, 0)}:{min(last, LAST) - since}]"

    def first(self, place: str, window: str, safe: str = "", then: str = "", safe_then: str | None = None) -> str:
        """The first tick in `place` lies in the window, all is safe until then, and `then` holds there."""
        there = safe if safe_then is None else safe_then
        waiting = f"(not {place})" + (f" and {safe}" if safe else "")
        done = place + (f" and {there}" if there else "") + (f" and {then}" if then else "")
        return f"(({waiting}) until{window} ({done}))"

    def next(self, text: str) -> str:
        return f"(eventually[1:1] {text})"

    def chain(self, goals, safe=()) -> str:
        """One goal after another, each seen from the tick after the last."""
        text = ""
        for number in reversed(range(len(goals))):
            goal = goals[number]
            kept_out = safe[number] if safe else ""
            there = kept_out
            if not safe and goal.restricted:
                kept_out = there = f"(not {self.at(*goal.restricted)})"
            if isinstance(kept_out, tuple):
                kept_out, there = kept_out
            window = self.window(goal, since=1 if number else 0)
            text = self.first(self.at(*goal.places), window, kept_out, self.next(text) if text else "", there)
        return text

    def deadline(self, *goals) -> str:
        return self.chain(goals)

    deadline_chain = exact = eventually = order = restricted = deadline

    def exact_presence(self, goal) -> str:
        return f"eventually{self.window(goal)} {self.at(*goal.places)}"

    def always_avoid(self, goal) -> str:
        return self.chain([goal], [self.beside()])

    def always_stay(self, goal) -> str:
        return self.chain([goal], [self.beside()])

    def until_seconds(self, goal) -> str:
        strictly_before = math.ceil(self.mission.beside[0].seconds / TICK - 1e-9) - 1
        there = self.at(*goal.places)
        safe = f"({self.beside()} or (once[1:{LAST}] {there}))"
        return f"((eventually[0:{LAST}] {there}) and (always[0:{strictly_before}] {safe}))"

    def until_goal(self, *goals) -> str:
        return self.chain(goals, [(self.beside(), ""), ""])

    def until_stay(self, *goals) -> str:
        return self.chain(goals, [self.beside(), (self.beside(), "")])

    def recurrence_twice(self, goal) -> str:
        """Twice, at most so many seconds apart, gone by `leave_metres` in between."""
        name = f"p{self.places.index(goal.places[0])}"
        ticks = math.floor(goal.seconds / TICK + 1e-9)
        left = f"({name} < -{SCENARIO.leave_metres})"
        back = " or ".join(
            f"(eventually[{u}:{u}] ({left} and (eventually[1:{ticks - u}] {self.at(*goal.places)})))"
            for u in range(1, ticks)
        )
        return self.first(self.at(*goal.places), self.window(goal), then=f"({back})")

    def k_of_n(self, goal) -> str:
        within = f"eventually{self.window(goal)}"
        some = [
            " and ".join(f"({within} {self.at(p)})" for p in places)
            for places in itertools.combinations(goal.places, goal.different)
        ]
        return "(" + " or ".join(f"({all_of})" for all_of in some) + ")"

    def k_of_n_including(self, goal) -> str:
        must, others = goal.including[0], [p for p in goal.places if p not in goal.including]
        return f"((eventually[0:{LAST}] {self.at(must)}) and (eventually[0:{LAST}] {self.at(*others)}))"

    def two_of_three_with_gaps(self, goal) -> str:
        ticks = math.floor(goal.max_gap_seconds / TICK + 1e-9)
        first = []
        for p in goal.places:
            others = self.at(*(o for o in goal.places if o != p))
            first.append(f"({self.at(p)} and {self.next(f'(eventually[0:{ticks - 1}] {others})')})")
        return f"((not {self.at(*goal.places)}) until[0:{ticks}] ({' or '.join(first)}))"

    def without_goals(self) -> str:
        constraint = self.mission.constraints[0]
        return f"always[0:{math.ceil(constraint.seconds / TICK - 1e-9) - 1}] {self.beside()}"


OWN = {
    "recurrence_twice": lambda rng: (
        Constraint("deadline", ("Checkpoint A",), round(float(rng.uniform(5, 15)), 1), recurrences=2),
    ),
    "two_of_three_with_gaps": lambda rng: (
        Constraint(
            "eventually", ("Checkpoint A", "Checkpoint B", "Checkpoint C"), different=2,
            max_gap_seconds=round(float(rng.uniform(3, 9)), 1),
        ),
    ),
    "without_goals": lambda rng: (
        Constraint("until", ("top right",), round(float(rng.uniform(1, 9)), 1), avoid=True),
    ),
    "until_stay": lambda rng: (
        Constraint("eventually", ("Checkpoint A",)),
        Constraint("eventually", ("Checkpoint E",)),
        Constraint("until", ("left half",), until_goal=1),
    ),
}  # fmt: skip
KINDS = (
    "deadline", "deadline_chain", "exact", "exact_presence", "eventually", "always_avoid", "always_stay",
    "until_seconds", "until_goal", "order", "restricted", "k_of_n", "k_of_n_including", *OWN,
)  # fmt: skip


def depth(region, points: np.ndarray) -> np.ndarray:
    """Metres inside the region, negative outside; its own geometry."""
    x, y = points.T
    if isinstance(region, Disc):
        return region.radius - np.hypot(x - region.x, y - region.y)
    assert isinstance(region, Box)
    across = np.minimum(x - region.x_min, region.x_max - x)
    along = np.minimum(y - region.y_min, region.y_max - y)
    outside = np.hypot(np.minimum(across, 0), np.minimum(along, 0))
    return np.where(outside > 0, -outside, np.minimum(across, along))


def continuous_trajectory(rng: np.random.Generator, mission: Mission) -> np.ndarray:
    """Straight legs at changing speeds between points that matter and others, with rests. ``[LAST + 1, 2]``."""
    spots = [region_of(p, SCENARIO).centre for c in mission.constraints for p in (*c.places, *c.restricted)]
    script = [region_of(p, SCENARIO).centre for goal in mission.goals for p in goal.places] * 2
    here, points, willing = rng.uniform(0, 3, 2), [], rng.choice([0.0, 0.6, 0.8])
    while len(points) <= LAST:
        if script and rng.random() < willing:
            target = np.array(script.pop(0))
        else:
            target = np.array(spots[rng.integers(len(spots))]) if rng.random() < willing / 2 else rng.uniform(0, 3, 2)
        target = target + rng.normal(0, 0.05, 2)
        legs = max(1, math.ceil(float(np.hypot(*(target - here))) / (TICK * rng.uniform(0.2, 1.5))))
        points += [here + (target - here) * (i + 1) / legs for i in range(legs)]
        points += [target] * int(rng.integers(0, 4))
        here = target
    return np.array(points[: LAST + 1])


def library_verdict(mission: Mission, points: np.ndarray) -> bool:
    monitor = Monitor(mission, SCENARIO, TICK)
    status = monitor.reset(points[0])
    for point in points[1:]:
        if status != "active":
            break
        status = monitor.step(point)
    return status == "completed"


@pytest.mark.parametrize("kind", KINDS)
def test_a_published_monitor_agrees(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    verdicts = []
    for _ in range(5):
        constraints = OWN[kind](rng) if kind in OWN else random_mission(rng, kind).constraints
        mission = Mission(constraints, kind)
        formula = Formula(mission)
        monitor = rtamt.StlDiscreteTimeSpecification()
        for i in range(len(formula.places)):
            monitor.declare_var(f"p{i}", "float")
        monitor.spec = formula.text
        monitor.parse()
        for _ in range(12):
            points = continuous_trajectory(rng, mission)
            robustness = monitor.evaluate({"time": list(range(LAST + 1)), **formula.signals(points)})[0][1]
            verdicts.append(robustness > 0)
            assert library_verdict(mission, points) == verdicts[-1], (mission, formula.text, points.tolist())
    # The trajectories must be worth something: both verdicts occur.
    assert 2 <= sum(verdicts) <= len(verdicts) - 2
