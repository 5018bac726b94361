"""Gymnasium views of the environments: one robot learns, all others are scripted or policies.

``gymnasium.make("tab_marl/Ego-v0")`` and ``gymnasium.make("tab_marl/Adversary-v0")``, and the other ids of `registration`.
Observations, actions and rewards are those of `InterceptEnv` (of `TeamEnv`, with several robots on a side) for that robot. By
default an episode of interception ends with the mission, as does every episode in which an adversary learns.
"""

from __future__ import annotations

import copy
from typing import Any, ClassVar, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Space
from numpy.typing import NDArray

from tab_marl.envs.actions import ActionKind, action_space, check_kind, discrete_command
from tab_marl.envs.intercept import InterceptEnv
from tab_marl.envs.opponents import Opponent, Player, make_opponent
from tab_marl.envs.pictures import FRAMES_PER_SECOND, RENDER_MODES
from tab_marl.envs.team import TeamEnv
from tab_marl.world.scenario import Robot

SIDES = ("ego", "adversary")
MATES = {"ego": "pursue", "adversary": "follow"}
"""Who plays the learner's own side beside it."""
_UNIT = Robot(max_speed=1.0, max_turn_rate=1.0)


class SingleAgentEnv(gymnasium.Env[NDArray[np.float32], Any]):
    """One robot's side of an environment as a Gymnasium environment."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": list(RENDER_MODES), "render_fps": FRAMES_PER_SECOND}  # type: ignore[misc]

    def __init__(
        self,
        side: str,
        opponent: Opponent,
        render_mode: str | None = None,
        end_on_completion: bool | None = None,
        actions: ActionKind = "continuous",
        egos: int = 1,
        adversaries: int = 1,
        teammate: Opponent | None = None,
        **arguments: Any,
    ) -> None:
        """`side`: "ego" or "adversary", who learns: the first robot of that side.

        `opponent` plays every robot of the other side: a scripted player's name, that of a zoo policy or a planner, a policy's
        folder or model file, an object with `act` or `predict`, or a function (see `opponents`); an adversary with a `style`
        brings it along. `teammate` plays the rest of the learner's own side. Each robot gets a copy of its player.
        `end_on_completion`: None ends an episode with the mission, unless the ego's task is another than interception.
        `actions`: the learner's. Further arguments go to `InterceptEnv`, or to `TeamEnv` with several robots on a side.
        """
        if side not in SIDES:
            raise ValueError(f"side is {side!r}, must be 'ego' or 'adversary'")
        other = SIDES[1 - SIDES.index(side)]
        player = make_opponent(opponent, other, adversaries)
        if side == "ego":
            style = getattr(player, "style", None)
            if style is not None:
                arguments.setdefault("adversary_style", style)
        elif getattr(player, "full_observation", False):
            arguments.setdefault("full_observation", True)
        self.inner: InterceptEnv | TeamEnv
        """The environment of all robots."""
        if egos == adversaries == 1:
            self.inner = InterceptEnv(render_mode=render_mode, **arguments)
            ends = side == "adversary" or self.inner.ego_task == "interception"
        else:
            self.inner = TeamEnv(egos, adversaries, render_mode=render_mode, **arguments)
            ends = True
        self.inner.end_on_completion = ends if end_on_completion is None else end_on_completion
        self.side = side
        self._own = f"{side}_0"
        mate = None
        if (egos if side == "ego" else adversaries) > 1:
            mate = make_opponent(teammate or MATES[side], side, adversaries)
        self._players: dict[str, Player] = {}
        for agent in self.inner.possible_agents:
            if agent != self._own:
                mine = mate if agent.startswith(side) else player
                assert mine is not None
                self._players[agent] = copy.deepcopy(mine) if len(self.inner.possible_agents) > 2 else mine
        self.render_mode = render_mode
        self.action_kind = check_kind(actions)
        self.observation_space = cast(Space[NDArray[np.float32]], self.inner.observation_space(self._own))
        self.action_space = cast("Space[Any]", action_space(self.action_kind))
        self._seen: dict[str, NDArray[np.float32]] = {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode; see `InterceptEnv.reset`."""
        super().reset(seed=seed)
        observations, infos = self.inner.reset(seed=seed, options=options)
        for agent, player in self._players.items():
            begin = getattr(player, "reset", None)
            if begin is not None:
                task = self.inner.task
                if not isinstance(self.inner, InterceptEnv):
                    task = self.inner.task_of(agent)
                begin(task, self.inner.spawn_generator())
        self._seen = observations
        return observations[self._own], infos[self._own]

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Advance by one control step; everybody acts on its own observation of the same moment."""
        if not self._seen:
            raise RuntimeError("there is no episode yet: call reset first")
        own = self._own
        actions = {a: self._players[a].act(self._seen[a]) for a in self.inner.agents if a != own}
        if self.inner.agents:
            actions[own] = self._continuous(action)
        observations, rewards, terminations, truncations, infos = self.inner.step(actions)
        if own not in observations:
            raise RuntimeError("the episode is over: call reset")
        self._seen = observations
        return observations[own], rewards[own], terminations[own], truncations[own], infos[own]

    def _continuous(self, action: Any) -> Any:
        if self.action_kind == "continuous":
            return action
        speed, turn = discrete_command(action, self._own, _UNIT)
        return np.array([2.0 * speed - 1.0, turn], dtype=np.float32)

    @property
    def difficulty(self) -> float | None:
        """See `InterceptEnv.difficulty`."""
        return self.inner.difficulty if isinstance(self.inner, InterceptEnv) else None

    def set_difficulty(self, difficulty: float) -> None:
        """See `InterceptEnv.set_difficulty`."""
        if not isinstance(self.inner, InterceptEnv):
            raise ValueError(f"difficulty is {difficulty}: teams have no curriculum")  # noqa: TRY004
        self.inner.set_difficulty(difficulty)

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
