"""One episode of several egos and adversaries: physics, interception of each at every substep, every mission by itself.

An adversary that is intercepted leaves the arena at that substep; the others drive on. The episode is over when none is
left in play. With one robot on each side it is `episode.Episode`, to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tab_marl.envs.episode import CLOSING_MARGIN, START_DRAWS
from tab_marl.envs.physics import Arena, Motion, Start
from tab_marl.mission.monitor import Monitor
from tab_marl.mission.teams import TeamTask
from tab_marl.world.grid import free_points
from tab_marl.world.regions import BOUNDARY_METRES, Region, sample_in
from tab_marl.world.scenario import Scenario

ROUNDS = 500
"""Draws of all starts together before it is given up."""


@dataclass(frozen=True, slots=True)
class TeamEvents:
    """What happened during one control step; tuples are per adversary, except `collided`."""

    intercepted: tuple[bool, ...]
    completed: tuple[bool, ...]
    failed: tuple[bool, ...]
    active: tuple[bool, ...]
    """The mission was under way, and the adversary in play, when the step began."""
    collided: tuple[bool, ...]
    """Per robot, egos first: it began to touch a wall or an obstacle."""


class TeamEpisode:
    """The state of one episode; robots are numbered egos first."""

    def __init__(
        self, team: TeamTask, monitors: Sequence[Monitor], egos: Sequence[Start], adversaries: Sequence[Start]
    ) -> None:
        scenario = team.scenario
        self.team, self.scenario, self.monitors = team, scenario, tuple(monitors)
        self.egos, self.adversaries = len(egos), len(adversaries)
        self.arena = Arena(scenario, (*egos, *adversaries), self.egos)
        self.physics_steps = self.control_steps = 0
        self.motions: list[Motion] = [self.arena.motion(i) for i in range(self.egos + self.adversaries)]
        self.in_play = [True] * self.adversaries
        """Neither intercepted nor retired."""
        self.played = list(self.in_play)
        """In play when the latest step began."""
        self.captor: list[int | None] = [None] * self.adversaries
        """Number of the ego that intercepted each adversary."""
        self.completed_at: list[float | None] = [None] * self.adversaries
        """Seconds at which each mission was completed."""
        self.seen: list[tuple[int, ...]] = [()] * self.adversaries
        """Per adversary, indices of the checkpoints whose cameras see it now."""
        self.sighted: list[tuple[float, float, float] | None] = [None] * self.adversaries
        """Per adversary, x, y [m] and time [s] of the latest sighting."""
        self.paths: list[list[tuple[float, float]]] = [[] for _ in self.motions]
        """Centres of every robot after every control step so far."""
        self._substeps = scenario.physics_hertz // scenario.control_hertz
        self._meeting = scenario.interception_metres**2
        fastest = scenario.ego.max_speed + scenario.adversary.max_speed
        self._safe_gap = (scenario.interception_metres + CLOSING_MARGIN * fastest / scenario.control_hertz) ** 2
        self._cameras = [(i, c.x, c.y, c.camera_metres + BOUNDARY_METRES) for i, c in enumerate(scenario.checkpoints)]
        self._forgiven = [-1] * len(self.motions)
        self._forgive_steps = round(scenario.step_seconds * scenario.control_hertz)
        for monitor, motion in zip(self.monitors, self.motions[self.egos :], strict=True):
            monitor.reset((motion.x, motion.y))
        self._sense()

    @property
    def seconds(self) -> float:
        """Simulated so far."""
        return self.physics_steps / self.scenario.physics_hertz

    def step(self, commands: Sequence[tuple[float, float]]) -> TeamEvents:
        """Advance one control step under (v [m/s], w [rad/s]) of every robot; those out of play are not looked at."""
        arena, first = self.arena, self.egos
        active = tuple(p and m.status == "active" for p, m in zip(self.in_play, self.monitors, strict=True))
        self.played = before = list(self.in_play)
        arena.command(*commands)
        if self._nearest() > self._safe_gap:
            arena.run(self._substeps)
            self.physics_steps += self._substeps
        else:
            for _ in range(self._substeps):
                arena.substep()
                self.physics_steps += 1
                self._intercept()
                if not any(self.in_play):
                    break
        self.control_steps += 1
        for i in range(len(self.motions)):
            if i < first or self.in_play[i - first]:
                self.motions[i] = arena.motion(i)
        completed, failed = [False] * self.adversaries, [False] * self.adversaries
        for j, monitor in enumerate(self.monitors):
            if active[j] and self.in_play[j]:
                motion = self.motions[first + j]
                status = monitor.step((motion.x, motion.y), motion.v)
                completed[j], failed[j] = status == "completed", status == "failed"
                if completed[j]:
                    self.completed_at[j] = self.seconds
        self._sense()
        return TeamEvents(
            tuple(was and not now for was, now in zip(before, self.in_play, strict=True)),
            tuple(completed),
            tuple(failed),
            active,
            tuple(self._collided(i) for i in range(len(self.motions))),
        )

    def retire(self, adversary: int) -> None:
        """Take an adversary whose mission is over out of play."""
        self.in_play[adversary] = False
        self.arena.remove(self.egos + adversary)

    def _nearest(self) -> float:
        """Smallest squared gap between an ego and an adversary in play."""
        gap, first = self.arena.squared_gap, self.egos
        return min(gap(k, first + j) for j in range(self.adversaries) if self.in_play[j] for k in range(first))

    def _intercept(self) -> None:
        for j in range(self.adversaries):
            if self.in_play[j]:
                gaps = [self.arena.squared_gap(k, self.egos + j) for k in range(self.egos)]
                if min(gaps) <= self._meeting:
                    self.captor[j] = int(np.argmin(gaps))
                    self.motions[self.egos + j] = self.arena.motion(self.egos + j)
                    self.retire(j)

    def _sense(self) -> None:
        for path, motion in zip(self.paths, self.motions, strict=True):
            path.append((motion.x, motion.y))
        for j in range(self.adversaries):
            x, y, *_ = self.motions[self.egos + j]
            cameras = self._cameras if self.played[j] else ()
            self.seen[j] = tuple([i for i, cx, cy, reach in cameras if math.hypot(x - cx, y - cy) <= reach])
            if self.seen[j]:
                self.sighted[j] = (x, y, self.seconds)

    def _collided(self, robot: int) -> bool:
        """Whether a new collision began: a touch within one tick of the last touch is still the same one."""
        if not self.arena.touching[robot]:
            return False
        new = self.control_steps > self._forgiven[robot]
        self._forgiven[robot] = self.control_steps + self._forgive_steps
        return new


def draw_team_starts(team: TeamTask, rng: np.random.Generator) -> tuple[list[Start], list[Start]]:
    """Starts of all egos and all adversaries: uniform in the free parts of their regions, headings uniform, no two robots
    in each other, egos and adversaries farther apart than interception. Raises ValueError if there are none."""
    scenario = team.scenario
    regions = [(region, scenario.ego.radius_metres) for region in team.ego_starts]
    regions += [(task.scenario.adversary_start, scenario.adversary.radius_metres) for task in team.tasks]
    egos = len(team.ego_starts)
    for _ in range(ROUNDS):
        starts = [_draw(scenario, region, radius, rng) for region, radius in regions]
        if all(
            math.dist(starts[i][:2], starts[j][:2])
            > (scenario.interception_metres if i < egos <= j else regions[i][1] + regions[j][1])
            for i in range(len(starts))
            for j in range(i + 1, len(starts))
        ):
            return starts[:egos], starts[egos:]
    raise ValueError(
        f"scenario {scenario.name!r}: the start regions leave no places for {egos} egos and {len(team.tasks)} adversaries "
        f"apart from each other: move TeamTask.ego_starts or the adversaries' starts"
    )


def _draw(scenario: Scenario, region: Region, radius: float, rng: np.random.Generator) -> Start:
    points = sample_in(region, rng, 16)
    heading = float(rng.uniform(-math.pi, math.pi))
    free = np.flatnonzero(free_points(scenario, points, radius))
    if len(free) == 0:
        points = sample_in(region, rng, START_DRAWS)
        free = np.flatnonzero(free_points(scenario, points, radius))
    if len(free) == 0:
        raise ValueError(
            f"scenario {scenario.name!r}: start region {region} has no free point for a robot of radius {radius} m: move it "
            "off the walls and obstacles"
        )
    x, y = points[free[0]].tolist()
    return (x, y, heading)
