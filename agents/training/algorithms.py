"""The algorithms that train adversaries, as a table. Their names are those of rl-baselines3-zoo."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True)
class Algorithm:
    """What differs between them, as far as training is concerned."""

    title: str
    """As people write it; also the name of the class."""
    module: str
    on_policy: bool
    seconds_per_kilostep: float
    """CPU seconds of 1000 control steps with the packaged hyperparameters on one 2026 server core: only what is left of a
    population's training is estimated with it."""

    def load(self) -> Any:
        """The class."""
        return getattr(import_module(self.module), self.title)


ALGORITHMS: dict[str, Algorithm] = {
    "ppo": Algorithm("PPO", "stable_baselines3", True, 0.12),
    "a2c": Algorithm("A2C", "stable_baselines3", True, 0.05),
    "sac": Algorithm("SAC", "stable_baselines3", False, 0.3),
    "td3": Algorithm("TD3", "stable_baselines3", False, 0.2),
    "tqc": Algorithm("TQC", "sb3_contrib", False, 0.38),
    "ppo_lstm": Algorithm("RecurrentPPO", "sb3_contrib", True, 0.17),
}
