"""PPO in plain PyTorch, in one file: train in the batched arenas, then evaluate in the pymunk world.

    python scripts/examples/ppo_torch.py                          # an adversary learns M4 on random maps, about a minute
    python scripts/examples/ppo_torch.py --side ego --mission M5  # an ego learns to intercept a route follower

The loop and its defaults are those of CleanRL's ppo_continuous_action, with many arenas and large batches instead of
observation and reward normalisation.
"""

from __future__ import annotations

import time

import gymnasium
import numpy as np
import torch
import typer
from torch import nn
from torch.distributions import Normal

import tab_marl  # noqa: F401, registers the environments


class Agent(nn.Module):
    """A Gaussian policy and a value, each with two layers of `width`; observations are divided by their spaces' bounds."""

    def __init__(self, space: gymnasium.spaces.Box, width: int = 64) -> None:
        super().__init__()
        self.register_buffer("scale", torch.as_tensor(np.maximum(np.abs(space.low), np.abs(space.high))))

        def network(outputs: int, gain: float) -> nn.Sequential:
            layers = [nn.Linear(space.shape[0], width), nn.Linear(width, width), nn.Linear(width, outputs)]
            for layer, last in zip(layers, (2**0.5, 2**0.5, gain), strict=True):
                nn.init.orthogonal_(layer.weight, last)
                nn.init.zeros_(layer.bias)
            return nn.Sequential(layers[0], nn.Tanh(), layers[1], nn.Tanh(), layers[2])

        self.actor, self.critic = network(2, 0.01), network(1, 1.0)
        self.log_std = nn.Parameter(torch.full((2,), -0.5))

    def policy(self, observation: torch.Tensor) -> Normal:
        return Normal(self.actor(observation / self.scale), self.log_std.exp(), validate_args=False)

    def value(self, observation: torch.Tensor) -> torch.Tensor:
        return self.critic(observation / self.scale).squeeze(-1)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """The mean action, for one observation or many: what an environment takes as `opponent`."""
        with torch.no_grad():
            return self.policy(torch.as_tensor(observations)).mean.clamp(-1, 1).numpy()


def advantages(rewards, values, last_value, ends, discount, trace):
    """Generalised advantage estimates ``[T, N]``; `ends[t]` says that the episode ended with step t."""
    found, after, value_after = torch.zeros_like(rewards), 0.0, last_value
    for t in reversed(range(len(rewards))):
        goes_on = 1.0 - ends[t]
        error = rewards[t] + discount * value_after * goes_on - values[t]
        found[t] = after = error + discount * trace * goes_on * after
        value_after = values[t]
    return found


def update(agent, optimizer, data, epochs: int, batch: int, clip: float = 0.2, entropy: float = 0.001) -> None:
    """PPO's epochs over `data`: observations, actions, log-probabilities, advantages and returns, all flat ``[B, ...]``."""
    observations, actions, old_log_probability, advantage, returns = data
    for _ in range(epochs):
        for chosen in torch.randperm(len(returns)).split(batch):
            policy = agent.policy(observations[chosen])
            ratio = (policy.log_prob(actions[chosen]).sum(-1) - old_log_probability[chosen]).exp()
            gain = (advantage[chosen] - advantage[chosen].mean()) / (advantage[chosen].std() + 1e-8)
            surrogate = torch.minimum(ratio * gain, ratio.clamp(1 - clip, 1 + clip) * gain).mean()
            value_error = (agent.value(observations[chosen]) - returns[chosen]).square().mean()
            loss = 0.5 * value_error - surrogate - entropy * policy.entropy().sum(-1).mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()


def train(
    envs: gymnasium.vector.VectorEnv, steps: int, rollout: int = 64, batch: int = 4096, epochs: int = 4, seed: int = 0,
    learning_rate: float = 1e-3, discount: float = 0.99, reward_scale: float = 0.02, report=None,
) -> tuple[Agent, float]:  # fmt: skip
    """Train on a vector environment; returns the agent and the environment steps per second, learning included."""
    torch.manual_seed(seed)
    agent = Agent(envs.single_observation_space)
    optimizer = torch.optim.Adam(agent.parameters(), lr=learning_rate, eps=1e-5)
    n, began = envs.num_envs, time.perf_counter()
    observation = torch.as_tensor(envs.reset(seed=seed)[0])
    updates = max(1, steps // (rollout * n))
    for done in range(updates):
        optimizer.param_groups[0]["lr"] = learning_rate * (1.0 - done / updates)
        seen = torch.zeros(rollout, n, *envs.single_observation_space.shape)
        actions, log_probability = torch.zeros(rollout, n, 2), torch.zeros(rollout, n)
        rewards, ends = torch.zeros(rollout, n), torch.zeros(rollout, n)
        with torch.no_grad():
            for t in range(rollout):
                seen[t] = observation
                policy = agent.policy(observation)
                actions[t] = policy.sample()
                log_probability[t] = policy.log_prob(actions[t]).sum(-1)
                after, reward, terminated, truncated, _ = envs.step(actions[t].clamp(-1, 1).numpy())
                rewards[t] = torch.as_tensor(reward) * reward_scale
                ends[t] = torch.as_tensor(terminated | truncated)
                observation = torch.as_tensor(after)
            values = agent.value(seen)
            advantage = advantages(rewards, values, agent.value(observation), ends, discount, 0.95)
        data = (seen, actions, log_probability, advantage, advantage + values)
        update(agent, optimizer, [x.flatten(0, 1) for x in data], epochs, batch)
        if report is not None:
            report(done + 1, updates, float(rewards.sum() / reward_scale / ends.sum().clamp(min=1)))
    return agent, updates * rollout * n / (time.perf_counter() - began)


def evaluate(env: gymnasium.Env, agent: Agent, episodes: int, seed: int = 10_000) -> dict[str, float]:
    """Shares of episodes that ended with interception and with the mission completed, and the mean return."""
    found = []
    for i in range(episodes):
        observation, info = env.reset(seed=seed + i)
        total, over = 0.0, False
        while not over:
            observation, reward, terminated, truncated, info = env.step(agent.act(observation))
            total, over = total + reward, terminated or truncated
        found.append((info["intercepted"], info["mission_status"] == "completed", total))
    return dict(zip(("intercepted", "completed", "return"), np.mean(found, axis=0).tolist(), strict=True))


def main(
    side: str = "adversary", mission: str = "M4", scenario: str = "random", steps: int = 2_000_000, arenas: int = 512,
    episodes: int = 100, seed: int = 0,
) -> None:  # fmt: skip
    torch.set_num_threads(1)
    world = {"mission": mission, "scenario": scenario}
    envs = gymnasium.make_vec(f"tab_marl/Batched{side.capitalize()}-v0", num_envs=arenas, **world)

    def report(done: int, updates: int, returned: float) -> None:
        if done % max(1, updates // 10) == 0:
            print(f"update {done:4d} of {updates}: {returned:8.2f} reward per episode")

    agent, rate = train(envs, steps, seed=seed, report=report)
    print(f"{rate:,.0f} environment steps per second, learning included")
    opponent = {"opponent": "static"} if side == "adversary" else {}
    found = evaluate(gymnasium.make(f"tab_marl/{side.capitalize()}-v0", **world, **opponent), agent, episodes)
    print(f"in the pymunk world, {episodes} new episodes: " + ", ".join(f"{k} {v:.2f}" for k, v in found.items()))


if __name__ == "__main__":
    typer.run(main)
