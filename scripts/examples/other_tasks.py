"""The same planner with other tasks: getting somewhere unmet, and watching. ``python scripts/examples/other_tasks.py``.

Nothing is told to the planner but the scenario's rewards (`Scenario.ego_task`). Each planner plays the same tasks against the
same adversaries; the scripted ones know the map and not the belief: straight to the own goal (avoidance), and wait at the
mission's nearest goal (surveillance). ``--film`` also writes an episode of each task as a GIF.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer
from numpy.typing import ArrayLike, NDArray
from rich.console import Console
from rich.table import Table

from tab_marl.agents.planners import PlannerAgent, PlannerOptions, RandomAgent, goal_places
from tab_marl.envs.ego_observation import parse_ego_observation
from tab_marl.envs.intercept_v0 import parallel_env
from tab_marl.evaluation.adversaries import opponent, zoo_names
from tab_marl.evaluation.film import write_film
from tab_marl.evaluation.statistics import bootstrap_mean, share
from tab_marl.mission.tasks import Task, sample_task
from tab_marl.planning.pursuit.routes import RouteMap

EgoTask = Literal["avoidance", "surveillance"]
BASE_SEED = 60_000


class Scripted:
    """Drives to one place by the shortest path and stays: the own goal, else the mission's nearest goal."""

    def reset(self, task: Task, rng: np.random.Generator) -> None:
        places = goal_places(task)
        own = task.scenario.ego_goal
        self.routes = RouteMap.build(task.scenario, places)
        home = self.routes.grid.cells_of([task.scenario.ego_start.centre])[0]
        wanted = self.routes.grid.cells_of(places if own is None else [own.centre])
        near = np.abs(self.routes.waypoints[:, None] - self.routes.grid.centres[wanted]).sum(-1).argmin(axis=0)
        self.route = int(near[np.argmin(self.routes.distances[near, home])])

    def act(self, observation: ArrayLike) -> NDArray[np.float32]:
        view, robot = parse_ego_observation(observation), self.routes.scenario.ego
        v, w = self.routes.control((view.x, view.y, view.theta), self.route)
        return np.array([2.0 * v / robot.max_speed - 1.0, w / robot.max_turn_rate], dtype=np.float32)


def make(name: str) -> Any:
    if name == "scripted":
        return Scripted()
    return RandomAgent(PlannerOptions()) if name == "random" else PlannerAgent(name, PlannerOptions())


def play(task: Task, name: str, seed: int, film: Path | None = None) -> dict[str, float]:
    """One episode: the ego's return, and what its task counts."""
    agent, names = make(name), zoo_names("development")
    policy = opponent(names[seed % len(names)])
    env = parallel_env(
        task=task, adversary_style=policy.style, full_observation=name == "oracle",
        render_mode=None if film is None else "rgb_array",
    )  # fmt: skip
    observations, _ = env.reset(seed=seed)
    agent.reset(task, np.random.default_rng(seed))
    policy.reset(task, np.random.default_rng([seed, 1]))
    total, frames = 0.0, []
    while env.agents:
        actions = {"ego_0": agent.act(observations["ego_0"]), "adversary_0": policy.act(observations["adversary_0"])}
        if film is not None and env.episode.control_steps % 2 == 0:
            if env.episode.control_steps == 0 and hasattr(agent, "belief_image"):
                env.set_field(agent.belief_image, f"belief of {name}")
            frames.append(env.render())
        observations, rewards, *_ = env.step(actions)
        total += rewards["ego_0"]
    episode = env.episode
    if film is not None:
        write_film(frames, film, task.scenario.control_hertz // 2)
    env.close()
    if task.scenario.ego_task == "avoidance":
        return {"return": total, "met %": 100.0 * episode.encountered, "arrived %": 100.0 * episode.arrived}
    watched = episode.watched_steps / task.scenario.control_hertz
    return {"return": total, "watched s": watched, "watched %": 100.0 * watched / task.scenario.horizon_seconds}


def cell(column: str, values: list[float]) -> str:
    """A mean with its interval; for a share of episodes the one that also holds where all went alike."""
    scale = 100.0 if column in ("met %", "arrived %") else 1.0
    found = share(np.array(values) / 100.0) if scale == 100.0 else bootstrap_mean(values)
    return f"{scale * found.value:.1f} [{scale * found.low:.1f}, {scale * found.high:.1f}]"


def main(
    tasks: Annotated[str, typer.Option(help="avoidance, surveillance or both")] = "avoidance,surveillance",
    planners: str = "random,scripted,S-POMCP,TAB-POMCP,oracle",
    episodes: int = 40,
    mission: str = "M1",
    family: str = "ambiguous",
    film: Annotated[Path | None, typer.Option(help="folder for the GIFs")] = None,
) -> None:
    for ego_task in tasks.split(","):
        found: dict[str, list[dict[str, float]]] = {name: [] for name in planners.split(",")}
        for seed in range(BASE_SEED, BASE_SEED + episodes):
            task = sample_task(np.random.default_rng(seed), mission, family)
            task = replace(task, scenario=task.scenario.for_task(ego_task))  # type: ignore[arg-type]
            for name, rows in found.items():
                shown = film / f"{ego_task}.gif" if film and name == "TAB-POMCP" and seed == BASE_SEED else None
                rows.append(play(task, name, seed, shown))
        table = Table(title=f"{ego_task}: {mission} {family}, {episodes} paired episodes, 95 % intervals")
        table.add_column("planner")
        first = next(iter(found.values()))[0]
        for column in first:
            table.add_column(column, justify="right")
        for name, rows in found.items():
            table.add_row(name, *(cell(column, [row[column] for row in rows]) for column in first))
        Console(width=110).print(table)


if __name__ == "__main__":
    typer.run(main)
