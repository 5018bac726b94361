"""An oracle for missions: quantifies over a whole trajectory in seconds; no automaton, no clocks, no locations.

And a generator of missions and trajectories in which something happens.
"""

from __future__ import annotations

import math

import numpy as np

from tab_marl.mission.model import Constraint, ConstraintType, Mission, Place
from tab_marl.world.regions import Disc, Region
from tab_marl.world.scenario import Scenario

EPSILON = 1e-9
NEVER = math.inf


class Oracle:
    """One trajectory, points [T+1, 2], one per tick."""

    def __init__(self, mission: Mission, scenario: Scenario, tick: float, points: np.ndarray) -> None:
        self.mission, self.scenario, self.tick, self.points = mission, scenario, tick, points
        self.ticks = range(len(points))
        self.metres_from = {
            place: np.asarray(region_of(place, scenario).distance(points))
            for constraint in mission.constraints
            for place in (*constraint.places, *constraint.restricted)
        }

    def verdict(self) -> tuple[str, int | None]:
        """("completed" or "failed", tick), or ("active", None)."""
        done, broken = self.goals()
        completed = done[-1] if done else self.end_without_goals()
        for constraint in self.mission.beside:
            broken += [t for t in self.ticks if self.in_force(constraint, t, done) and not self.admits(constraint, t)]
        broken = [t for t in broken if t <= completed and t < len(self.points)]
        if broken:
            return "failed", min(broken)
        return ("completed", int(completed)) if completed < len(self.points) else ("active", None)

    def goals(self) -> tuple[list[float], list[float]]:
        """(tick at which each goal is completed, ticks at which something goes wrong with a goal)."""
        done: list[float] = []
        broken: list[float] = []
        begun: float = -1
        for goal in self.mission.goals:
            visits = self.visits(goal, begun) if begun < NEVER else []
            finished = visits[-1] if len(visits) == goal.visits else NEVER
            broken += self.time_violations(goal, begun, visits, finished)
            broken += [
                t for t in self.ticks if begun < t <= finished and any(self.inside(p, t) for p in goal.restricted)
            ]
            done.append(finished)
            begun = finished
        return done, broken

    def visits(self, goal: Constraint, begun: float) -> list[float]:
        """Ticks of the counted visits: each the first tick after the last at which a place that counts is entered."""
        ticks: list[float] = []
        places: list[Place] = []
        while len(ticks) < goal.visits:
            after = ticks[-1] if ticks else begun
            found = None
            for t in self.ticks:
                candidates = [
                    p for p in goal.places if t > after and self.inside(p, t) and self.counts(goal, p, places)
                ]
                if goal.recurrences > 1 and goal.different == 1 and places:
                    left = any(self.outside_by_leave(places[-1], u) for u in self.ticks if after < u <= t)
                    candidates = candidates if left else []
                if goal.presence and len(ticks) + 1 == goal.visits and not self.not_before(goal, t, begun):
                    candidates = []
                if candidates:
                    found = (t, candidates[0])
                    break
            if found is None:
                return ticks
            ticks.append(found[0])
            places.append(found[1])
        return ticks

    @staticmethod
    def counts(goal: Constraint, place: Place, visited: list[Place]) -> bool:
        if goal.different == 1:
            return True
        after = {*visited, place}
        return place not in visited and len(after | set(goal.including)) <= goal.different

    def not_before(self, goal: Constraint, t: int, begun: float) -> bool:
        low, _ = self.window(goal)
        since = max(begun, 0) * self.tick if goal.since == "previous" else 0.0
        return t * self.tick - since >= low - EPSILON

    def window(self, goal: Constraint) -> tuple[float, float]:
        assert goal.seconds is not None
        if goal.type is ConstraintType.DEADLINE:
            return 0.0, goal.seconds
        slack = max(self.scenario.exact_seconds, self.scenario.exact_fraction * goal.seconds)
        return goal.seconds - slack, goal.seconds + slack

    def time_violations(self, goal: Constraint, begun: float, visits: list[float], finished: float) -> list[float]:
        broken: list[float] = []
        times = [v * self.tick for v in visits]
        starts = [max(begun, 0) * self.tick, *times]
        if goal.seconds is not None and goal.recurrences == 1:
            low, high = self.window(goal)
            since = starts[0] if goal.since == "previous" else 0.0
            if goal.since == "start" or begun < NEVER:
                broken += self.outside_window(since, low, high, finished)
        if begun == NEVER:
            return broken
        for number in range(goal.visits):
            if number > len(visits):
                break
            entered = visits[number] if number < len(visits) else NEVER
            if goal.recurrences > 1 and goal.seconds is not None:
                broken += self.outside_window(starts[number], *self.window(goal), entered)
            if goal.max_gap_seconds is not None:
                broken += self.outside_window(starts[number], 0.0, goal.max_gap_seconds, entered)
        return broken

    def outside_window(self, since: float, low: float, high: float, entered: float) -> list[float]:
        """The tick of an early entry, or the first tick after the window if there was no entry by its end."""
        if entered * self.tick - since < low - EPSILON:
            return [entered]
        if entered * self.tick - since > high + EPSILON:
            return [t for t in self.ticks if t * self.tick - since > high + EPSILON][:1]
        return []

    def in_force(self, constraint: Constraint, t: int, done: list[float]) -> bool:
        if constraint.seconds is not None:
            return t * self.tick < constraint.seconds - EPSILON
        if constraint.until_goal is not None:
            return t < done[self.mission.goal_indices.index(constraint.until_goal)]
        return True

    def admits(self, constraint: Constraint, t: int) -> bool:
        if not constraint.places:
            return True
        return any(self.inside(p, t) for p in constraint.places) != constraint.avoid

    def end_without_goals(self) -> float:
        ends = [self.scenario.horizon_seconds if c.seconds is None else c.seconds for c in self.mission.constraints]
        kinds = {c.type for c in self.mission.constraints}
        latest = max(ends) if kinds == {ConstraintType.UNTIL} else max(self.scenario.horizon_seconds, *ends)
        return min((t for t in self.ticks if t * self.tick >= latest - EPSILON), default=NEVER)

    def inside(self, place: Place, t: int) -> bool:
        return bool(self.metres_from[place][t] <= EPSILON)

    def outside_by_leave(self, place: Place, t: int) -> bool:
        return bool(self.metres_from[place][t] > self.scenario.leave_metres + EPSILON)


def region_of(place: Place, scenario: Scenario) -> Region:
    return Disc(*place, scenario.target_radius_metres) if isinstance(place, tuple) else scenario.region(place)


KINDS = (
    "deadline", "deadline_chain", "exact", "exact_presence", "eventually", "always_avoid", "always_stay",
    "until_seconds", "until_goal", "until_stay", "recurrence", "recurrence_any", "recurrence_exact",
    "recurrence_different", "k_of_n", "k_of_n_including", "max_gap", "order", "restricted", "without_goals", "mixed",
)  # fmt: skip

# Discs only where a visit must be left again: growing a box keeps its corners square, which is another region than
# "farther than leave_metres"; that is tested by itself.
DISCS: tuple[Place, ...] = ("Checkpoint A", "Checkpoint B", "Checkpoint C", "Checkpoint E", (2.0, 1.6))
AREAS: tuple[Place, ...] = ("central zone", "top right", "left half", "bottom half")


def some(rng: np.random.Generator, places: tuple[Place, ...], count: int) -> tuple[Place, ...]:
    return tuple(places[i] for i in rng.choice(len(places), size=count, replace=False))


def seconds(rng: np.random.Generator, low: float = 1.0, high: float = 12.0) -> float:
    return round(float(rng.uniform(low, high)), 1)


def random_goal(rng: np.random.Generator, kind: str = "mixed") -> Constraint:
    """One goal with every extra now and then."""
    shape = rng.choice(["one", "any", "different", "recurring", "recurring_different"])
    places = some(rng, DISCS, int(rng.integers(2, 4)))
    fields: dict[str, object] = {}
    if shape == "one":
        places = places[:1]
    elif shape == "different":
        fields["different"] = int(rng.integers(2, len(places) + 1))
        if rng.random() < 0.4:
            fields["including"] = places[-1:]
    elif shape == "recurring":
        fields["recurrences"] = int(rng.integers(2, 4))
    elif shape == "recurring_different":
        fields["different"] = fields["recurrences"] = len(places)
    timed = "recurring" in shape or rng.random() < 0.6
    kind_of_time = ConstraintType.EVENTUALLY
    if timed:
        kind_of_time = ConstraintType.EXACT if rng.random() < 0.3 else ConstraintType.DEADLINE
        fields["seconds"] = seconds(rng, 4, 20)
        if "recurring" not in shape:
            fields["since"] = str(rng.choice(["start", "previous"]))
            fields["presence"] = bool(kind_of_time is ConstraintType.EXACT and rng.random() < 0.4)
    if rng.random() < 0.3:
        fields["max_gap_seconds"] = seconds(rng, 3, 12)
    if rng.random() < 0.2:
        fields["restricted"] = ("central zone",)
    if rng.random() < 0.2:
        fields["speed_limit"] = round(float(rng.uniform(0.05, 0.3)), 3)
    return Constraint(kind_of_time, places, **fields)  # type: ignore[arg-type]


def random_mission(rng: np.random.Generator, kind: str = "mixed") -> Mission:
    """A mission of this kind; goals first, then what runs beside them."""
    a, b, c = some(rng, DISCS, 3)
    zone = some(rng, AREAS, 1)
    T = ConstraintType
    reach = Constraint(T.EVENTUALLY, (a,))
    table: dict[str, list[Constraint]] = {
        "deadline": [Constraint(T.DEADLINE, (a,), seconds(rng))],
        "deadline_chain": [
            Constraint(T.DEADLINE, (a,), seconds(rng, 2, 15)),
            Constraint(T.DEADLINE, (b,), seconds(rng, 2, 12), since="previous"),
        ],
        "exact": [Constraint(T.EXACT, (a,), seconds(rng))],
        "exact_presence": [Constraint(T.EXACT, (a,), seconds(rng), presence=True)],
        "eventually": [reach],
        "always_avoid": [reach, Constraint(T.ALWAYS, zone, avoid=True)],
        "always_stay": [reach, Constraint(T.ALWAYS, ("left half", "bottom half"))],
        "until_seconds": [reach, Constraint(T.UNTIL, zone, seconds(rng, 0.5, 5), avoid=True)],
        "until_goal": [
            reach, Constraint(T.EVENTUALLY, (b,)), Constraint(T.UNTIL, zone, avoid=True, until_goal=0),
        ],
        "until_stay": [reach, Constraint(T.EVENTUALLY, (b,)), Constraint(T.UNTIL, ("left half",), until_goal=1)],
        "recurrence": [Constraint(T.DEADLINE, (a,), seconds(rng, 4, 15), recurrences=int(rng.integers(2, 4)))],
        "recurrence_any": [Constraint(T.DEADLINE, (a, b), seconds(rng, 3, 8), recurrences=3)],
        "recurrence_exact": [Constraint(T.EXACT, (a, b), seconds(rng, 2, 5), recurrences=2)],
        "recurrence_different": [Constraint(T.DEADLINE, (a, b, c), 6.0, different=3, recurrences=3, including=(b,))],
        "k_of_n": [Constraint(T.DEADLINE, DISCS, seconds(rng, 6, 14), different=3)],
        "k_of_n_including": [Constraint(T.EVENTUALLY, DISCS, different=2, including=(a,))],
        "max_gap": [
            Constraint(T.EVENTUALLY, DISCS, different=3, max_gap_seconds=seconds(rng, 3, 8)),
            Constraint(T.EVENTUALLY, ("top right",), max_gap_seconds=8.0),
        ],
        "order": [reach, Constraint(T.EVENTUALLY, (b,)), Constraint(T.EVENTUALLY, (c,))],
        "restricted": [
            Constraint(T.EVENTUALLY, (a,), restricted=zone), Constraint(T.EVENTUALLY, (b,), restricted=(c,)),
        ],
        "without_goals": [
            Constraint(T.UNTIL, ("top right",), seconds(rng, 1, 6), avoid=True),
            *([Constraint(T.ALWAYS, ("bottom right",), avoid=True)] if rng.random() < 0.5 else []),
        ],
    }  # fmt: skip
    if kind in table:
        return Mission(tuple(table[kind]))
    goals = [random_goal(rng) for _ in range(int(rng.integers(1, 4)))]
    beside = []
    if rng.random() < 0.3:
        beside.append(Constraint(T.ALWAYS, ("top right",), avoid=True))
    if rng.random() < 0.3:
        beside.append(Constraint(T.UNTIL, ("left half", "top half"), seconds(rng, 0.5, 4)))
    if rng.random() < 0.3:
        number = int(rng.integers(len(goals)))
        if not (goals[number].presence and goals[number].since == "previous"):
            beside.append(Constraint(T.UNTIL, ("bottom right",), avoid=True, until_goal=number))
    if rng.random() < 0.2:
        beside.append(Constraint(T.ALWAYS, speed_limit=0.2))
    return Mission((*goals, *beside))


NEUTRAL = (0.3, 1.4)
"""Outside every disc above, by more than `leave_metres`."""


def random_trajectory(
    rng: np.random.Generator, mission: Mission, scenario: Scenario, ticks: int, tick: float
) -> np.ndarray:
    """Jumps between places that matter, with stays; drawn so that missions are often completed. [ticks + 1, 2]."""
    spots = [
        region_of(place, scenario).centre
        for constraint in mission.constraints
        for place in (*constraint.places, *constraint.restricted)
    ]
    spots = spots or [NEUTRAL]
    points: list[tuple[float, float]] = []
    if rng.random() < 0.5:
        points = punctual_trajectory(rng, mission, scenario, tick)
    script = [region_of(p, scenario).centre for goal in mission.goals for p in goal.places] * 3
    follow = rng.random() < 0.7
    while len(points) <= ticks:
        if follow and script and rng.random() < 0.5:
            x, y = script.pop(0)
        elif rng.random() < 0.4:
            x, y = spots[rng.integers(len(spots))]
        else:
            x, y = rng.uniform(0, 3, size=2)
        stay = int(rng.integers(1, 6))
        spread = float(rng.choice([0.0, 0.1, 0.25]))
        points += [tuple(np.clip(np.array([x, y]) + rng.normal(0, spread, 2), 0, 3)) for _ in range(stay)]
    return np.array(points[: ticks + 1])


def punctual_trajectory(
    rng: np.random.Generator, mission: Mission, scenario: Scenario, tick: float
) -> list[tuple[float, float]]:
    """Waits at a neutral place and jumps into each goal at about the time its constraint names."""
    points: list[tuple[float, float]] = []
    for goal in mission.goals:
        begun = len(points)
        for number in range(goal.visits):
            x, y = region_of(goal.places[number % len(goal.places)], scenario).centre
            entry = len(points) + int(rng.integers(1, 5))
            if goal.type is ConstraintType.EXACT and goal.seconds is not None:
                since = len(points) - 1 if goal.recurrences > 1 else begun - 1 if goal.since == "previous" else 0
                entry = max(since, 0) + round(goal.seconds / tick) + int(rng.integers(-2, 3))
            points += [NEUTRAL] * (entry - len(points))
            points.append((x, y))
    return points
