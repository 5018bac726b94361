"""What a policy does when nobody hunts it: success on held-out tasks, in both worlds."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tab_marl.agents.adversaries import AdversaryPolicy
from tab_marl.agents.measures.rollouts import Rollouts, run_bank
from tab_marl.agents.policies.cards import MissionRecord, World
from tab_marl.agents.training.env import HELD_OUT, build_bank, draw_tasks
from tab_marl.envs.adversary_observation import AdversaryTask
from tab_marl.envs.batched import Bank
from tab_marl.envs.intercept import ADVERSARY_AGENT, EGO_AGENT, InterceptEnv
from tab_marl.mission.automaton import UNBOUNDED
from tab_marl.mission.tasks import Task
from tab_marl.world.grid import GridMap

BATCHED: World = "batched"
PHYSICS: World = "physics"
NEVER_MET_METRES = 1e-3


def wilson(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's interval of a share (Wilson 1927), 95 % by default. Raises ValueError without trials."""
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"{successes} successes of {trials} trials: need 0 <= successes <= trials, trials >= 1")
    share, n = successes / trials, trials
    centre = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    return max(0.0, centre - half), min(1.0, centre + half)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Tasks that no training run has seen."""

    tasks: tuple[Task, ...]
    seed: int

    @classmethod
    def draw(cls, count: int, seed: int = 99, missions: Sequence[str] = ("M1", "M2", "M3", "M4", "M5")) -> HeldOut:
        """`count` tasks, missions and families in turn."""
        return cls(tuple(draw_tasks(HELD_OUT, seed, count, missions, ("point", "ambiguous", "perimeter"))), seed)

    def bank(self, policy: AdversaryPolicy, draw: int = 0) -> Bank:
        """The tasks under the policy's style; another `draw`, other latents."""
        return build_bank(self.tasks, policy.style, 1000 * self.seed + draw)

    @property
    def missions(self) -> NDArray[np.str_]:
        return np.array([task.mission_id for task in self.tasks])


def mission_records(missions: NDArray[np.str_], completed: NDArray[np.bool_], world: World) -> list[MissionRecord]:
    """Success per mission type with its interval."""
    records = []
    for mission in sorted({str(m) for m in missions}):
        of_mission = completed[missions == mission]
        done, n = int(of_mission.sum()), len(of_mission)
        low, high = wilson(done, n)
        records.append(
            MissionRecord(
                mission=mission, world=world, completed=done, episodes=n, low=round(low, 4), high=round(high, 4)
            )
        )
    return records


def play_physics(
    policy: AdversaryPolicy, tasks: Sequence[Task], seed: int, on_played: Callable[[int, int], None] | None = None
) -> NDArray[np.bool_]:
    """``[N]`` whether the policy completed each task in the physics environment, the ego parked out of its way."""
    completed = np.zeros(len(tasks), dtype=bool)
    for i, task in enumerate(tasks):
        # The ego stays far off and cannot meet anybody: only the adversary and its mission are tested.
        unopposed = replace(task, scenario=replace(task.scenario, interception_metres=NEVER_MET_METRES))
        env = InterceptEnv(unopposed, adversary_style=policy.style, end_on_completion=True)
        observations, _ = env.reset(seed=seed + i, options={"ego_start": (*_parking(task), 0.0)})
        policy.reset(unopposed, np.random.default_rng((seed, i)))
        still = np.array([-1.0, 0.0], dtype=np.float32)
        while env.agents:
            action = policy.act(observations[ADVERSARY_AGENT])
            observations, *_ = env.step({EGO_AGENT: still, ADVERSARY_AGENT: action})
        completed[i] = env.episode.monitor.status == "completed"
        if on_played is not None:
            on_played(i + 1, len(tasks))
    return completed


def _parking(task: Task) -> tuple[float, float]:
    """The free point farthest from every place of the mission and from the adversary's start."""
    scenario = task.scenario
    grid = GridMap.from_scenario(scenario, 0.1, scenario.ego.radius_metres + 0.02)
    centres = [scenario.adversary_start.centre]
    for constraint in task.mission.constraints:
        for place in constraint.places:
            centres.append(scenario.region(place).centre if isinstance(place, str) else place)
    gaps = np.min([np.hypot(*(grid.centres - c).T) for c in centres], axis=0)
    x, y = grid.centres[int(np.argmax(gaps))]
    return float(x), float(y)


def allowed_seconds(task: AdversaryTask) -> float:
    """The most time that the mission allows along its plain route; inf if nothing but the horizon of others bounds it."""
    automaton, tick = task.automaton, task.automaton.tick_seconds
    route = task.parts.plain
    cells, locations = route.path(task.parts.via_home, task.scenario.adversary_start.centre)
    masks = automaton.masks(route.grid.centres[cells])
    allowed = 0.0
    for i in range(len(cells) - 1):
        u = int(locations[i])
        if not automaton.progress[u, masks[i + 1]] or locations[i + 1] == u:
            continue
        latest = automaton.latest[u]
        if latest[0] < UNBOUNDED:
            allowed = float(latest[0]) * tick
        elif min(latest[1:]) < UNBOUNDED:
            allowed += float(min(latest[1:])) * tick
        else:
            allowed = task.scenario.horizon_seconds
    return allowed or math.inf


def run_held_out(policy: AdversaryPolicy, held_out: HeldOut, draw: int = 0) -> tuple[Bank, Rollouts]:
    """One unopposed episode per held-out task in the batched world."""
    bank = held_out.bank(policy, draw)
    rng = np.random.default_rng((held_out.seed, draw))
    return bank, run_bank(policy, bank, np.arange(len(bank)), rng)
