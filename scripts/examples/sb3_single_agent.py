"""stable-baselines3's PPO on one side of the pymunk environment, then self-play against what was learned.

    python scripts/examples/sb3_single_agent.py

First an adversary learns its mission while the ego stands still, then an ego learns to intercept a frozen copy of it.
Who plays the other side is one argument: a scripted player's name, a policy of the zoo, or any function of observations.
"""

from __future__ import annotations

import math
import time

import gymnasium
import typer
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

import tab_marl as tm

SETTINGS = {"n_steps": 256, "batch_size": 1024, "n_epochs": 4, "learning_rate": 1e-3, "gamma": 0.99, "device": "cpu"}


class Closer(gymnasium.Wrapper):
    """The ego's own reward, made smaller, and 2 per metre by which it comes closer to the adversary.

    Interceptions by chance are too rare to learn from. Adversaries need no such help: their "shaped" reward pays for
    progress along their route.
    """

    def reset(self, **arguments):
        result = self.env.reset(**arguments)
        self.last = self.gap()
        return result

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        before, self.last = self.last, self.gap()
        return observation, 0.05 * reward + 2 * (before - self.last), terminated, truncated, info

    def gap(self) -> float:
        ego, adversary = self.unwrapped.inner.episode.motion
        return math.dist(ego[:2], adversary[:2])


def learn(
    side: str, opponent: object, steps: int, copies: int = 8, mission: str = "M4", seed: int = 0, episodes: int = 50
) -> PPO:  # fmt: skip
    """PPO for one side against `opponent`, in `copies` environments at once."""
    arguments = {"mission": mission, "opponent": opponent, "adversary_rewards": "shaped"}
    envs = make_vec_env(
        f"tab_marl/{side}-v0", copies, seed, env_kwargs=arguments, wrapper_class=Closer if side == "Ego" else None
    )
    model = PPO("MlpPolicy", envs, seed=seed, **SETTINGS)
    began = time.process_time()
    model.learn(steps)
    rate = model.num_timesteps / (time.process_time() - began)
    won = play(model, gymnasium.make(f"tab_marl/{side}-v0", **arguments), seed + 1000, episodes)
    what = "missions completed" if side == "Adversary" else "adversaries intercepted in time"
    print(f"{side}: {rate:,.0f} environment steps per CPU second; {won} of {episodes} {what}")
    return model


def play(model: PPO, env: gymnasium.Env, seed: int, episodes: int) -> int:
    """Episodes that the side of this environment wins, acting without noise."""
    adversary_wins = intercepted = 0
    for episode in range(episodes):
        observation, _ = env.reset(seed=seed + episode)
        over = False
        while not over:
            action = model.predict(observation, deterministic=True)[0]
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        adversary_wins += info["mission_status"] == "completed"
        intercepted += info["intercepted"]
    return adversary_wins if env.unwrapped.side == "adversary" else intercepted


def frozen(model: PPO):
    """What a model would do, as a function of observations."""
    return lambda observation: model.predict(observation, deterministic=True)[0]


def main(steps: int = 150_000, seed: int = 0) -> None:
    adversary = learn("Adversary", "static", steps, seed=seed)
    learn("Ego", frozen(adversary), steps, seed=seed)
    learn("Ego", tm.load_zoo()[0], steps, seed=seed)  # and against a policy that ships


if __name__ == "__main__":
    typer.run(main)
