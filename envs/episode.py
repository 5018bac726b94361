"""One episode without any library's interface: physics, meeting at every substep, mission and ego task at the control rate."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tab_marl.envs.lidar import Lidar
from tab_marl.envs.physics import ADVERSARY, EGO, Arena, Start
from tab_marl.envs.reward import Events
from tab_marl.mission.monitor import Monitor
from tab_marl.mission.tasks import Task
from tab_marl.world.grid import free_points
from tab_marl.world.regions import BOUNDARY_METRES, Region, sample_in
from tab_marl.world.scenario import Scenario

START_DRAWS = 256
"""Points drawn at a time when looking for a free start."""
START_ROUNDS = 40

CLOSING_MARGIN = 2.0
"""Robots so much farther apart than they can close in one control step at top speed need no check at every substep."""


class Episode:
    """The state of one episode; `step` advances it by one control step."""

    def __init__(self, task: Task, monitor: Monitor, ego: Start, adversary: Start) -> None:
        scenario = task.scenario
        self.task = task
        self.scenario = scenario
        self.monitor = monitor
        self.arena = Arena(scenario, (ego, adversary))
        self.substeps_per_step = scenario.physics_hertz // scenario.control_hertz
        self.physics_steps = 0
        self.control_steps = 0
        self.intercepted = False
        self.encountered = False
        """Ego task avoidance: the robots met, which ended the episode."""
        self.arrived = False
        """Ego task avoidance: the ego reached its goal, which ended the episode."""
        self.watched = False
        """Ego task surveillance: the ego watches the adversary now."""
        self.watched_steps = 0
        """Control steps at whose end the ego watched the adversary."""
        self.completed_seconds: float | None = None
        """When the mission was completed."""
        self.motion = (self.arena.motion(EGO), self.arena.motion(ADVERSARY))
        self.trails: tuple[list[tuple[float, float]], ...] = ([], [])
        """Centres of ego and adversary after every control step so far."""
        self.seen_by: tuple[int, ...] = ()
        """Indices of the checkpoints whose cameras see the adversary now."""
        self.last_seen: tuple[float, float, float] | None = None
        """x, y [m] and time [s] of the latest sighting."""
        self._stage = (0, 0)
        self._cameras = [(i, c.x, c.y, c.camera_metres + BOUNDARY_METRES) for i, c in enumerate(scenario.checkpoints)]
        self._forgiven = [-1, -1]
        """Until which control step a renewed touch counts as the same collision, per robot."""
        self._forgive_steps = round(scenario.step_seconds * scenario.control_hertz)
        self._meeting = scenario.interception_metres**2
        fastest = scenario.ego.max_speed + scenario.adversary.max_speed
        self._ego_task = scenario.ego_task
        self._sight = Lidar.of(scenario) if scenario.ego_task == "surveillance" else None
        self._safe_gap = (scenario.interception_metres + CLOSING_MARGIN * fastest / scenario.control_hertz) ** 2
        monitor.reset((self.motion[ADVERSARY].x, self.motion[ADVERSARY].y))
        self._sense()

    @property
    def seconds(self) -> float:
        """Simulated so far; a step cut short by interception counts its substeps only."""
        return self.physics_steps / self.scenario.physics_hertz

    @property
    def ended(self) -> bool:
        """Whether the ego's task is over; never in surveillance."""
        return self.intercepted or self.encountered or self.arrived

    def step(self, ego: tuple[float, float], adversary: tuple[float, float]) -> Events:
        """Advance one control step under (v [m/s], w [rad/s]) of each robot; stops at the substep in which they meet,
        unless the ego's task is surveillance."""
        arena = self.arena
        active = self.monitor.status == "active"
        arena.command(ego, adversary)
        met = False
        (ego_x, ego_y, *_), (x, y, *_) = self.motion
        if self._sight is not None or (x - ego_x) ** 2 + (y - ego_y) ** 2 > self._safe_gap:
            arena.run(self.substeps_per_step)
            self.physics_steps += self.substeps_per_step
        else:
            for _ in range(self.substeps_per_step):
                arena.substep()
                self.physics_steps += 1
                if arena.squared_gap() <= self._meeting:
                    met = True
                    break
        self.control_steps += 1
        self.motion = (arena.motion(EGO), arena.motion(ADVERSARY))
        if self._ego_task == "interception":
            self.intercepted = met
        elif self._ego_task == "avoidance":
            self.encountered = met
            self.arrived = not met and self._at_goal()
        status = "active"
        if active and not met:
            status = self._watch_mission()
        self._sense()
        return Events(
            self.intercepted,
            status == "completed",
            status == "failed",
            self._collided(EGO),
            self._collided(ADVERSARY),
            active,
            self.encountered,
            self.arrived,
            self.watched,
        )

    def _at_goal(self) -> bool:
        goal = self.scenario.ego_goal
        return goal is not None and bool(goal.contains(self.motion[EGO][:2]))

    def mission_progress(self) -> tuple[int, int]:
        """(goals completed, visits counted for the current one); stays where it was when the mission failed."""
        if self.monitor.location >= 0:
            self._keep_stage(self.monitor.location)
        return self._stage

    def _keep_stage(self, location: int) -> None:
        automaton = self.monitor.automaton
        self._stage = (int(automaton.goals_done[location]), int(automaton.visits[location]))

    def _watch_mission(self) -> str:
        motion = self.motion[ADVERSARY]
        before = self.monitor.location
        status = self.monitor.step((motion.x, motion.y), motion.v)
        if status == "completed":
            self.completed_seconds = self.seconds
        if status != "active":
            self._keep_stage(before)  # for the picture of a mission that fails now
        return status

    def _sense(self) -> None:
        (ego_x, ego_y, *_), (x, y, *_) = self.motion
        self.trails[EGO].append((ego_x, ego_y))
        self.trails[ADVERSARY].append((x, y))
        self.seen_by = tuple([i for i, cx, cy, reach in self._cameras if math.hypot(x - cx, y - cy) <= reach])
        if self._sight is not None:
            near = math.hypot(x - ego_x, y - ego_y) <= self.scenario.watch_metres + BOUNDARY_METRES
            self.watched = near and self._sight.sees(ego_x, ego_y, x, y)
            self.watched_steps += self.watched and self.control_steps > 0
        if self.seen_by or self.watched:
            self.last_seen = (x, y, self.seconds)

    def _collided(self, robot: int) -> bool:
        """Whether a new collision began: a touch within one tick of the last touch is still the same one."""
        if not self.arena.touching[robot]:
            return False
        new = self.control_steps > self._forgiven[robot]
        self._forgiven[robot] = self.control_steps + self._forgive_steps
        return new


def draw_starts(
    scenario: Scenario,
    rng: np.random.Generator,
    ego: Start | None = None,
    adversary: Start | None = None,
) -> tuple[Start, Start]:
    """Starts of both robots: uniform in the free part of their start regions, headings uniform, farther apart than
    interception. A given start is kept. Raises ValueError if the regions leave no such pair.
    """
    for _ in range(START_ROUNDS):
        egos = _free_starts(scenario, scenario.ego_start, scenario.ego.radius_metres, rng, "ego_start", ego)
        adversaries = _free_starts(
            scenario, scenario.adversary_start, scenario.adversary.radius_metres, rng, "adversary_start", adversary
        )  # fmt: skip
        count = min(len(egos), len(adversaries))
        gaps = np.hypot(*(egos[:count, :2] - adversaries[:count, :2]).T)
        apart = np.flatnonzero(gaps > scenario.interception_metres)
        if len(apart):
            first = int(apart[0])
            return _start(egos[first]), _start(adversaries[first])
    if ego is not None or adversary is not None:
        raise ValueError(
            f"starts {ego or 'drawn'} of the ego and {adversary or 'drawn'} of the adversary are never farther apart than "
            f"interception_metres = {scenario.interception_metres}: move the given start away"
        )
    raise ValueError(
        f"scenario {scenario.name!r}: ego_start and adversary_start leave no pair of starts farther apart than "
        f"interception_metres = {scenario.interception_metres}: move the regions apart or lower interception_metres"
    )


def check_start(scenario: Scenario, start: object, name: str) -> Start:
    """A given start (x [m], y [m], theta [rad]). Raises ValueError if it is malformed or not free."""
    pose = np.asarray(start, dtype=np.float64)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise ValueError(f"options[{name!r}] is {start!r}, must be three finite numbers (x [m], y [m], theta [rad])")
    robot = scenario.ego if name == "ego_start" else scenario.adversary
    if not free_points(scenario, pose[None, :2], robot.radius_metres)[0]:
        raise ValueError(
            f"options[{name!r}]: a robot of radius {robot.radius_metres} m at ({pose[0]:g}, {pose[1]:g}) touches a wall or "
            "an obstacle: give a free point"
        )
    return _start(pose)


def _free_starts(
    scenario: Scenario, region: Region, radius: float, rng: np.random.Generator, field: str, fixed: Start | None
) -> NDArray[np.float64]:
    if fixed is not None:
        return np.tile(np.asarray(fixed, dtype=np.float64), (START_DRAWS, 1))
    points = sample_in(region, rng, START_DRAWS)
    headings = rng.uniform(-math.pi, math.pi, size=(START_DRAWS, 1))
    free = free_points(scenario, points, radius)
    if not free.any():
        raise ValueError(
            f"scenario {scenario.name!r}: {field} {region} has no free point for a robot of radius {radius} m: "
            "move it off the walls and obstacles"
        )
    return np.hstack([points, headings])[free]


def _start(row: NDArray[np.float64]) -> Start:
    x, y, theta = row.tolist()
    return (x, y, theta)
