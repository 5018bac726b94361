"""What a decision costs, and where its time goes: ``python benchmarks/interception.py``.

Every planner decides on the same observations: an ego that drives at random is watched, and each planner is asked what it
would do. They share everything but the adversary model, so the ratio to S-POMCP is the price of the model (the paper
reports 1.4 for TAB-POMCP). Times are processor seconds of the deciding thread, so other jobs disturb them little.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from tab_marl.agents.planners import PlannerAgent, PlannerOptions, RandomAgent
from tab_marl.envs.intercept_v0 import parallel_env
from tab_marl.evaluation.adversaries import opponent, zoo_names
from tab_marl.mission.tasks import Task, sample_task
from tab_marl.planning.pursuit.decide import PursuitOptions

PLANNERS = ("S-POMCP", "FP-POMCP", "MLE-POMCP", "TAB-POMCP", "population-POMCP")
BASE_SEED = 50_000


def watch(task: Task, agents: list[PlannerAgent], seed: int, adversary: str) -> None:
    """Let every agent decide along one episode of a random ego, until the mission is over or the robots meet."""
    env = parallel_env(task=task)
    observations, _ = env.reset(seed=seed)
    driver, policy = RandomAgent(PlannerOptions()), opponent(adversary)
    for number, agent in enumerate([driver, *agents, policy]):
        agent.reset(task, np.random.default_rng([seed, number]))
    turn = 0
    while env.agents and env.episode.monitor.status == "active":
        turn += 1
        for i in range(len(agents)):  # in turns, so that none always finds the caches warm
            agents[(i + turn) % len(agents)].act(observations["ego_0"])
        actions = {"ego_0": driver.act(observations["ego_0"]), "adversary_0": policy.act(observations["adversary_0"])}
        observations, *_ = env.step(actions)
    env.close()


def main(
    episodes: int = 10,
    missions: str = "M1,M4",
    family: str = "ambiguous",
    simulations: Annotated[int, typer.Option(help="of the tree, the same for all")] = PursuitOptions().simulations,
) -> None:
    options = PlannerOptions(pursuit=PursuitOptions(simulations=simulations))
    agents = [PlannerAgent(name, options) for name in PLANNERS]
    parts: dict[str, list[tuple[float, ...]]] = {name: [] for name in PLANNERS}
    names = zoo_names()
    for mission in missions.split(","):
        for number in range(-1, episodes):  # the first one loads the compiled kernels
            seed = BASE_SEED + max(number, 0)
            task = sample_task(np.random.default_rng(seed), mission, family)
            watch(task, agents, seed, names[seed % len(names)])
            for agent in agents if number >= 0 else ():
                parts[agent.name] += agent.decision_parts
    table = Table(title=f"milliseconds a decision, {missions} {family}, {simulations} simulations")
    for column in (
        "planner",
        "decisions",
        "belief",
        "sampling",
        "valuation",
        "tree",
        "sum",
        "95 %",
        "x S-POMCP",
        "sims/s",
    ):
        table.add_column(column, justify="left" if column == "planner" else "right")
    reference = np.array(parts["S-POMCP"]).sum(axis=1).mean()
    for name in PLANNERS:
        spent = 1e3 * np.array(parts[name])
        mean, total = spent.mean(axis=0), spent.sum(axis=1)
        table.add_row(
            name, str(len(spent)), *(f"{part:.2f}" for part in mean), f"{total.mean():.1f}",
            f"{np.quantile(total, 0.95):.1f}", f"{total.mean() / 1e3 / reference:.2f}",
            f"{simulations / mean[3] * 1e3:,.0f}",
        )  # fmt: skip
    Console(width=110).print(table)


if __name__ == "__main__":
    typer.run(main)
