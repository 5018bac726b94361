"""stable-baselines3's PPO on one side of the pymunk environment, then self-play against what was learned.

    python scripts/examples/sb3_single_agent.py

First an adversary learns its mission while the ego stands still, then an ego learns to intercept a frozen copy of it.
Who plays the other side is one argument: a scripted player's name, a policy of the zoo, or any function of observations.
"""

from __future__ import annotations

import time

import typer
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import tab_marl as tm

SETTINGS = {"n_steps": 256, "batch_size": 1024, "n_epochs": 4, "learning_rate": 1e-3, "gamma": 0.99, "device": "cpu"}


def learn(
    side: str, opponent: object, steps: int, copies: int = 8, mission: str = "M4", seed: int = 0, episodes: int = 20
) -> PPO:  # fmt: skip
    """PPO for one side against `opponent`, in `copies` environments at once."""
    arguments = {"mission": mission, "opponent": opponent}
    envs = make_vec_env(f"tab_marl/{side}-v0", n_envs=copies, seed=seed, env_kwargs=arguments)
    model = PPO("MlpPolicy", envs, seed=seed, **SETTINGS)
    began = time.process_time()
    model.learn(steps)
    rate = model.num_timesteps / (time.process_time() - began)
    env = make_vec_env(f"tab_marl/{side}-v0", seed=seed + 1000, env_kwargs=arguments)
    mean, spread = evaluate_policy(model, env, episodes)
    print(f"{side}: {rate:,.0f} environment steps per CPU second; reward per episode {mean:.1f} (s.d. {spread:.1f})")
    return model


def frozen(model: PPO):
    """What a model would do, as a function of observations."""
    return lambda observation: model.predict(observation, deterministic=True)[0]


def main(steps: int = 300_000, seed: int = 0) -> None:
    adversary = learn("Adversary", "static", steps, seed=seed)
    learn("Ego", frozen(adversary), steps, seed=seed)
    learn("Ego", tm.load_zoo()[0], steps, seed=seed)  # and against a policy that ships


if __name__ == "__main__":
    typer.run(main)
