"""Difficulty that follows a learner's success, for single-agent views with a curriculum."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from tab_marl.envs.single_agent import SingleAgentEnv
from tab_marl.mission.curriculum import check_difficulty

Success = Callable[[dict[str, Any]], bool]
"""Whether an episode was won, from its last info."""


def adversary_won(info: dict[str, Any]) -> bool:
    """Its mission is completed."""
    return bool(info["mission_status"] == "completed")


def ego_won(info: dict[str, Any]) -> bool:
    """Interception or arrival; surveillance needs a criterion of its own."""
    if "watched_seconds" in info:
        raise ValueError("success is None and the ego's task is surveillance: say which watched_seconds count as won")
    return bool(info["intercepted"] or info.get("arrived", False))


class DifficultyLadder(gymnasium.Wrapper[NDArray[np.float32], Any, NDArray[np.float32], Any]):
    """Raises the difficulty when the learner wins often, and lowers it when it hardly wins.

    Every reset draws the episode's task at the ladder's difficulty, or below it: easier tasks stay in the mixture, so that
    they are not forgotten. Each environment of a vector environment has a ladder of its own.
    """

    def __init__(
        self,
        env: gymnasium.Env[NDArray[np.float32], Any],
        start: float = 0.0,
        rise: float = 0.8,
        fall: float = 0.4,
        window: int = 20,
        step: float = 0.05,
        easier_share: float = 0.2,
        success: Success | None = None,
    ) -> None:
        """`start`: the first difficulty. After `window` episodes at one difficulty it rises by `step` if at least the share
        `rise` of them was won, and falls if less than `fall` was. `easier_share`: of episodes drawn uniformly below.
        `success`: whether an episode was won, from its last info; None: `ego_won` or `adversary_won`.

        Raises ValueError for an environment without a curriculum, and for numbers that make no ladder.
        """
        super().__init__(env)
        view = env.unwrapped
        if not isinstance(view, SingleAgentEnv) or view.difficulty is None:
            raise ValueError(
                "DifficultyLadder needs an environment with a curriculum: make it with scenario='random' and difficulty=0.0, "
                "or tab_marl/Ego-curriculum-v0"
            )
        if not 0 <= fall < rise <= 1:
            raise ValueError(f"fall is {fall} and rise is {rise}, must be 0 <= fall < rise <= 1")
        if window < 1 or not 0 < step <= 1 or not 0 <= easier_share < 1:
            raise ValueError(
                f"window is {window}, step {step}, easier_share {easier_share}: must be >= 1, in (0, 1] and in [0, 1)"
            )
        self.difficulty = check_difficulty(start)
        """Of the ladder now."""
        self._success = success or (ego_won if view.side == "ego" else adversary_won)
        self._rise, self._fall, self._step, self._easier_share = rise, fall, step, easier_share
        self._window: deque[bool] = deque(maxlen=window)
        self._rng = np.random.default_rng()
        self._counts = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode; its difficulty is in the info. A "difficulty" in `options` goes before the ladder's."""
        if seed is not None:
            self._rng = np.random.default_rng((seed, 0x1ADDE5))
        easier, share = self._rng.random(2)
        level = self.difficulty * share if easier < self._easier_share else self.difficulty
        level = (options or {}).get("difficulty", level)
        self._counts = level == self.difficulty
        observation, info = self.env.reset(seed=seed, options={**(options or {}), "difficulty": level})
        return observation, {**info, "difficulty": level}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """As the environment's; the end of an episode moves the ladder."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if (terminated or truncated) and self._counts:
            self._window.append(self._success(info))
            if len(self._window) == self._window.maxlen:
                self._move(sum(self._window) / len(self._window))
        return observation, float(reward), terminated, truncated, info

    def _move(self, won: float) -> None:
        if won >= self._rise:
            self.difficulty = min(1.0, self.difficulty + self._step)
        elif won < self._fall:
            self.difficulty = max(0.0, self.difficulty - self._step)
        else:
            return
        self._window.clear()
