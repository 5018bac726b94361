"""Gymnasium views of the interception environment: one side learns, the other is scripted or a policy.

``gymnasium.make("tab_marl/Ego-v0")`` and ``gymnasium.make("tab_marl/Adversary-v0")``. Observations, actions and rewards
are those of `InterceptEnv` for that side; by default an episode ends with the mission.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Space
from numpy.typing import NDArray

from tab_marl.envs.intercept import ADVERSARY_AGENT, EGO_AGENT, RENDER_MODES, InterceptEnv
from tab_marl.envs.opponents import Player, make_opponent

Opponent = str | Player | Callable[[NDArray[np.float32]], Any]


class SingleAgentEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One side of the interception environment as a Gymnasium environment."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": list(RENDER_MODES), "render_fps": 10}  # type: ignore[misc]

    def __init__(
        self,
        side: str,
        opponent: Opponent,
        render_mode: str | None = None,
        end_on_completion: bool = True,
        **arguments: Any,
    ) -> None:
        """`side`: "ego" or "adversary", who learns. `opponent` plays the other side (see `opponents`); an adversary with a
        `style` brings it along. Further arguments go to `InterceptEnv`.
        """
        agents = {"ego": (EGO_AGENT, ADVERSARY_AGENT), "adversary": (ADVERSARY_AGENT, EGO_AGENT)}
        if side not in agents:
            raise ValueError(f"side is {side!r}, must be 'ego' or 'adversary'")
        self._own, self._other = agents[side]
        self._opponent = make_opponent(opponent, "adversary" if side == "ego" else "ego")
        style = getattr(self._opponent, "style", None)
        if side == "ego" and style is not None:
            arguments.setdefault("adversary_style", style)
        self.inner = InterceptEnv(render_mode=render_mode, end_on_completion=end_on_completion, **arguments)
        """The environment of both sides."""
        self.render_mode = render_mode
        self.observation_space = cast(Space[NDArray[np.float32]], self.inner.observation_space(self._own))
        self.action_space = cast(Space[NDArray[np.float32]], self.inner.action_space(self._own))
        self._seen_by_other: NDArray[np.float32] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode; see `InterceptEnv.reset`."""
        super().reset(seed=seed)
        observations, infos = self.inner.reset(seed=seed, options=options)
        begin = getattr(self._opponent, "reset", None)
        if begin is not None:
            begin(self.inner.task, self.inner.spawn_generator())
        self._seen_by_other = observations[self._other]
        return observations[self._own], infos[self._own]

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Advance by one control step; the opponent acts on its own observation of the same moment."""
        if self._seen_by_other is None:
            raise RuntimeError("there is no episode yet: call reset first")
        other = self._opponent.act(self._seen_by_other)
        observations, rewards, terminations, truncations, infos = self.inner.step(
            {self._own: action, self._other: other}
        )
        self._seen_by_other = observations[self._other]
        own = self._own
        return observations[own], rewards[own], terminations[own], truncations[own], infos[own]

    def render(self) -> NDArray[np.uint8] | None:
        """See `InterceptEnv.render`."""
        return self.inner.render()

    def set_field(self, field: Any, label: str = "belief") -> None:
        """See `InterceptEnv.set_field`."""
        self.inner.set_field(field, label)

    def close(self) -> None:
        """Close the window, if there is one."""
        self.inner.close()


def ego_env(opponent: Opponent = "follow", **arguments: Any) -> SingleAgentEnv:
    """The ego learns; the adversary follows its route unless told otherwise."""
    return SingleAgentEnv("ego", opponent, **arguments)


def adversary_env(opponent: Opponent = "pursue", **arguments: Any) -> SingleAgentEnv:
    """The adversary learns; the ego drives to wherever a camera saw it unless told otherwise."""
    return SingleAgentEnv("adversary", opponent, **arguments)
