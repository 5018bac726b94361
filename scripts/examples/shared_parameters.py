"""One network for both sides of the parallel environment: parameter sharing through PettingZoo's parallel API.

    python scripts/examples/shared_parameters.py

The sides observe vectors of different length, so the shorter one is padded, and two entries say whose turn it is. PPO is
that of ppo_torch.py beside this file.
"""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium
import numpy as np
import pettingzoo
import torch
import typer

import tab_marl  # noqa: F401, registers the environments

sys.path.insert(0, str(Path(__file__).parent))
from ppo_torch import Agent, advantages, update


class Padded:
    """Observations of every agent, one row each ``[agents, D]``: values over their bounds, zeros, and who it is."""

    def __init__(self, env: pettingzoo.ParallelEnv) -> None:
        self.agents = list(env.possible_agents)
        spaces = [env.observation_space(agent) for agent in self.agents]
        self._scales = [np.maximum(np.abs(s.low), np.abs(s.high)) for s in spaces]
        self._width = max(s.shape[0] for s in spaces)
        self.space = gymnasium.spaces.Box(-1.0, 1.0, (self._width + len(self.agents),), dtype=np.float32)

    def __call__(self, observations: dict[str, np.ndarray]) -> torch.Tensor:
        rows = np.zeros((len(self.agents), *self.space.shape), dtype=np.float32)
        for i, (agent, scale) in enumerate(zip(self.agents, self._scales, strict=True)):
            rows[i, : len(scale)] = observations[agent] / scale
            rows[i, self._width + i] = 1.0
        return torch.as_tensor(rows)


def main(steps: int = 200_000, rollout: int = 2048, mission: str = "M4", seed: int = 0) -> None:
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    env = pettingzoo.make("parallel", "tab_marl/intercept-v0", mission=mission, end_on_completion=True)
    padded = Padded(env)
    agent = Agent(padded.space)
    optimizer = torch.optim.Adam(agent.parameters(), lr=1e-3, eps=1e-5)
    n = len(padded.agents)
    observation = padded(env.reset(seed=seed)[0])
    for number in range(max(1, steps // rollout)):
        seen, actions = torch.zeros(rollout, n, *padded.space.shape), torch.zeros(rollout, n, 2)
        log_probability, rewards, ends = (torch.zeros(rollout, n) for _ in range(3))
        outcomes = []
        with torch.no_grad():
            for t in range(rollout):
                seen[t], policy = observation, agent.policy(observation)
                actions[t] = policy.sample()
                log_probability[t] = policy.log_prob(actions[t]).sum(-1)
                chosen = dict(zip(padded.agents, actions[t].clamp(-1, 1).numpy(), strict=True))
                after, reward, _, _, infos = env.step(chosen)
                rewards[t] = 0.02 * torch.tensor([reward[name] for name in padded.agents])
                if not env.agents:
                    info = infos["adversary_0"]
                    outcomes.append((info["intercepted"], info["mission_status"] == "completed"))
                    ends[t] = 1.0
                    after, _ = env.reset()
                observation = padded(after)
            values = agent.value(seen)
            advantage = advantages(rewards, values, agent.value(observation), ends, 0.99, 0.95)
        data = (seen, actions, log_probability, advantage, advantage + values)
        update(agent, optimizer, [x.flatten(0, 1) for x in data], epochs=4, batch=1024)
        if outcomes and number % 5 == 0:
            intercepted, completed = np.mean(outcomes, axis=0)
            print(
                f"{(number + 1) * rollout:8,d} steps: intercepted {intercepted:.2f}, mission completed {completed:.2f}"
            )


if __name__ == "__main__":
    typer.run(main)
