"""The interception environment: PettingZoo's ParallelEnv around an Episode. Glue only; every part is a module beside it.

Agents are ``ego_0`` and ``adversary_0``. What they do and what is refused: `actions`. One step is one control step (0.1 s,
ten physics substeps). An episode ends at interception (terminated) or at the horizon (truncated); with `end_on_completion`
also when the mission is completed or fails. Where the ego's task is avoidance (`Scenario.ego_task`), it ends when the robots
meet or the ego is in its goal; surveillance runs to the horizon.

An environment can be deep-copied and pickled in mid-episode, and the copy goes on exactly as the original would: its physics
is restored by replaying the episode's commands (`physics.Arena`). Windows and overlays do not travel.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import ArrayLike, NDArray
from pettingzoo import ParallelEnv

from tab_marl.envs.actions import COMMANDS, ActionKind, action_space, check_kind
from tab_marl.envs.adversary_side import AdversarySide, adversary_space, as_style, notices_ego
from tab_marl.envs.ego_observation import Row, box_of, ego_rows, ego_space, observe_ego, robot_rows, robot_values
from tab_marl.envs.episode import Episode, check_start, draw_starts
from tab_marl.envs.lidar import Lidar
from tab_marl.envs.pictures import FRAMES_PER_SECOND, RENDER_MODES, Pictures
from tab_marl.envs.reward import AdversaryRewards, Events, adversary_reward, ego_reward
from tab_marl.envs.styles import Style
from tab_marl.envs.task_source import TaskSource, at_difficulty, difficulty_of, largest_task, task_source
from tab_marl.mission import Mission
from tab_marl.mission.curriculum import Curriculum
from tab_marl.mission.tasks import Task
from tab_marl.world.scenario import EgoTask, Scenario

EGO_AGENT, ADVERSARY_AGENT = "ego_0", "adversary_0"
AGENTS = (EGO_AGENT, ADVERSARY_AGENT)

Observations = dict[str, NDArray[np.float32]]
Infos = dict[str, dict[str, Any]]


class InterceptEnv(ParallelEnv[str, NDArray[np.float32], NDArray[np.float32]]):
    """An ego that must intercept an adversary with a mission. See the module's and `__init__`'s descriptions."""

    metadata: ClassVar[dict[str, Any]] = {
        "name": "tab_marl_intercept_v0",
        "render_modes": list(RENDER_MODES),
        "render_fps": FRAMES_PER_SECOND,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        task: Task | TaskSource | None = None,
        mission: str | Mission = "M1",
        scenario: str | Scenario = "lab",
        family: str = "point",
        adversary_style: Style | str | None = None,
        render_mode: str | None = None,
        end_on_completion: bool = False,
        full_observation: bool = False,
        max_cycles: int | None = None,
        adversary_rewards: AdversaryRewards | str | None = None,
        show_lidar: bool = False,
        actions: ActionKind = "continuous",
        ego_task: EgoTask | None = None,
        adversary_sees_ego_metres: float | None = None,
        sampled: bool = False,
        difficulty: float | None = None,
        curriculum: Curriculum | None = None,
    ) -> None:
        """`task`, `mission`, `scenario`, `family`, `sampled`, `difficulty`, `curriculum`, `ego_task` and
        `adversary_sees_ego_metres`: what is played, see `task_source`.

        `adversary_style`: a Style or a style's name for the routes that the adversary observes; None is the direct one.
        `end_on_completion`: the episode also ends when the mission is completed or fails.
        `full_observation`: the ego sees the adversary always.
        `max_cycles`: the most control steps, if fewer than the horizon's.
        `adversary_rewards`: "plain" (None), "shaped", or an AdversaryRewards.
        `actions`: "continuous" or "discrete", for both agents.
        """
        if max_cycles is not None and max_cycles < 1:
            raise ValueError(f"max_cycles is {max_cycles}, must be >= 1 or None (the scenario's horizon)")
        self.render_mode = render_mode
        self.end_on_completion = end_on_completion
        self.full_observation = full_observation
        self.max_cycles = max_cycles
        self.adversary_style = as_style(adversary_style)
        self.adversary_rewards = AdversaryRewards.of(adversary_rewards)
        self.possible_agents = list(AGENTS)
        self.agents: list[str] = []
        self._source = task_source(
            task, mission, scenario, family, sampled=sampled, difficulty=difficulty, curriculum=curriculum,
            ego_task=ego_task, adversary_sees_ego_metres=adversary_sees_ego_metres,
        )  # fmt: skip
        self._rng = np.random.default_rng()
        self._pictures = Pictures("tab-marl: intercept", render_mode, show_lidar)
        self._episode: Episode | None = None
        self._over = False
        # The spaces come from a first task, drawn from a generator of its own so that episodes do not depend on it.
        self._shape_of = largest_task(self._source).scenario
        self.action_kind = check_kind(actions)
        self.observation_spaces = {EGO_AGENT: ego_space(self._shape_of), ADVERSARY_AGENT: adversary_space()}
        self.action_spaces = {agent: action_space(self.action_kind) for agent in AGENTS}
        self.state_space = box_of(_state_rows(self._shape_of))

    @property
    def episode(self) -> Episode:
        """The running episode. Raises RuntimeError before the first reset."""
        if self._episode is None:
            raise RuntimeError("there is no episode yet: call reset first")
        return self._episode

    @property
    def task(self) -> Task:
        """The task of the running episode."""
        return self.episode.task

    @property
    def ego_task(self) -> EgoTask:
        """What the ego is paid for."""
        return self._shape_of.ego_task

    def spawn_generator(self) -> np.random.Generator:
        """A generator of its own that follows from the seed of the last seeded reset: for opponents."""
        return self._rng.spawn(1)[0]

    def observation_space(self, agent: str) -> Box:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box | Discrete:
        return self.action_spaces[agent]

    @property
    def difficulty(self) -> float | None:
        """At which tasks are drawn; None without a curriculum."""
        return difficulty_of(self._source)

    def set_difficulty(self, difficulty: float) -> None:
        """Draw tasks at this difficulty (0..1) from the next reset on. Raises ValueError without a curriculum."""
        self._source = at_difficulty(self._source, difficulty)

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Observations, Infos]:
        """Begin an episode. `options` may hold "task" (a Task), "difficulty" (0..1, for this episode, where there is a
        curriculum), "ego_start" and "adversary_start" (x, y, theta); other keys are ignored. The same seed, options and
        actions give the same episode.
        """
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        rng, options = self._rng, options or {}
        source = (
            self._source if options.get("difficulty") is None else at_difficulty(self._source, options["difficulty"])
        )
        task = options.get("task") or source(rng)
        scenario: Scenario = task.scenario
        check_shape(scenario, self._shape_of, ego_rows(scenario), self.observation_spaces[EGO_AGENT])
        given = {name: check_start(scenario, options[name], name) for name in ("ego_start", "adversary_start") if name in options}  # fmt: skip
        starts = draw_starts(scenario, rng, given.get("ego_start"), given.get("adversary_start"))
        control_seconds = 1.0 / scenario.control_hertz
        self._control_seconds = control_seconds
        self._side = AdversarySide(task, self.adversary_style, rng)
        self._lidar = Lidar.of(scenario) if scenario.sensors.lidar_rays else None
        self._last_step = round(scenario.horizon_seconds * scenario.control_hertz)
        if self.max_cycles is not None:
            self._last_step = min(self._last_step, self.max_cycles)
        self._episode = Episode(task, self._side.monitor, *starts)
        self._over = False
        self.agents = list(AGENTS)
        self._pictures.start(task)
        if self.render_mode == "human":
            self.render()
        return self._observe(), self._infos(Events())

    def step(
        self, actions: Mapping[str, ArrayLike]
    ) -> tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Advance by one control step. Raises ValueError for a missing, malformed or non-finite action."""
        episode = self.episode
        if self._over:
            if not actions:
                return {}, {}, {}, {}, {}
            raise RuntimeError("the episode is over: call reset")
        scenario = episode.scenario
        command = COMMANDS[self.action_kind]
        try:
            ego, adversary = actions[EGO_AGENT], actions[ADVERSARY_AGENT]
        except KeyError as missing:
            raise ValueError(
                f"actions lack {missing.args[0]!r}: every living agent must act, got {sorted(actions)}"
            ) from None
        events = episode.step(
            command(ego, EGO_AGENT, scenario.ego), command(adversary, ADVERSARY_AGENT, scenario.adversary)
        )
        ended = episode.ended or (self.end_on_completion and (events.completed or events.failed))
        truncated = not ended and episode.control_steps >= self._last_step
        seconds = self._control_seconds
        observations = self._observe()
        rewards = {
            EGO_AGENT: ego_reward(events, episode.motion[0], scenario, seconds),
            ADVERSARY_AGENT: adversary_reward(events, self.adversary_rewards, scenario, seconds, self._side.gained),
        }
        self._over = ended or truncated
        if self._over:
            self.agents = []
        result = (
            observations,
            rewards,
            {EGO_AGENT: ended, ADVERSARY_AGENT: ended},
            {EGO_AGENT: truncated, ADVERSARY_AGENT: truncated},
            self._infos(events),
        )
        if self.render_mode == "human":
            self.render()
        return result

    def state(self) -> NDArray[np.float32]:
        """The whole state ``[15]``: both robots (x, y, cos, sin, v, w), seconds elapsed and left, and the mission's
        status (0 under way, 1 completed, -1 failed)."""
        episode = self.episode
        scenario = episode.scenario
        ego, adversary = episode.motion
        elapsed = episode.seconds
        status = {"completed": 1.0, "failed": -1.0}.get(episode.monitor.status, 0.0)
        values = [*robot_values(ego, scenario.ego.max_speed), *robot_values(adversary, scenario.adversary.max_speed)]
        return np.array([*values, elapsed, self._left(elapsed), status], dtype=np.float32)

    def set_field(self, field: Any, label: str = "belief") -> None:
        """Lay a belief or field over the map in every picture from now on; None removes it.

        `field`: an image ``[rows, columns]`` (row 0 at the bottom), a pair (GridMap, values ``[cells]``), values
        ``[cells]`` on the scenario's grid of 0.1 or 0.05 m, or a function without arguments that returns one of these.
        """
        self._pictures.set_field(field, self._shape_of if self._episode is None else self._episode.scenario, label)

    def render(self) -> NDArray[np.uint8] | None:
        """The picture ``[height, width, 3]`` in mode "rgb_array"; None in mode "human", which shows it in a window."""
        if self.render_mode is None:
            raise RuntimeError(f"render() needs a render_mode: make the environment with one of {list(RENDER_MODES)}")
        return self._pictures.draw(self.episode, self._over)

    def close(self) -> None:
        """Close the window, if there is one."""
        self._pictures.close()

    def _observe(self) -> Observations:
        episode = self.episode
        ego, adversary = episode.motion
        scenario = episode.scenario
        elapsed = episode.seconds
        seen = adversary if episode.seen_by or episode.watched or self.full_observation else None
        goal = None if scenario.ego_goal is None else scenario.ego_goal.centre
        ranges = None if self._lidar is None else self._lidar.scan(ego.x, ego.y, ego.theta)
        limits = (scenario.ego.max_speed, scenario.adversary.max_speed)
        noticed = ego if notices_ego(scenario, adversary, ego) else None
        return {
            EGO_AGENT: observe_ego(ego, elapsed, self._left(elapsed), seen, ranges, limits, goal),
            ADVERSARY_AGENT: self._side.observe(adversary, noticed),
        }

    def _left(self, elapsed: float) -> float:
        return max(0.0, self._last_step * self._control_seconds - elapsed)

    def _infos(self, events: Events) -> Infos:
        episode = self.episode
        monitor = episode.monitor
        common: dict[str, Any] = {
            "intercepted": events.intercepted,
            "mission_status": monitor.status,
            "why_failed": monitor.why_failed,
            "completed_seconds": episode.completed_seconds,
            "physics_steps": episode.physics_steps,
        }
        return {
            EGO_AGENT: {**common, "collided": events.ego_collided, **_ego_task_info(episode)},
            ADVERSARY_AGENT: {**common, "collided": events.adversary_collided},
        }


def check_shape(scenario: Scenario, shape_of: Scenario, rows: tuple[Row, ...], space: Box) -> None:
    """A task drawn or given at reset must fit the spaces, which cannot change. Raises ValueError.

    `rows`: the layout of an ego's observation on this scenario; `shape_of`: the scenario that the spaces were made for.
    """
    if scenario.ego_task != shape_of.ego_task:
        raise ValueError(
            f"the task's scenario {scenario.name!r} is for {scenario.ego_task}, the environment was made for "
            f"{shape_of.ego_task}: make an environment for it"
        )
    if len(rows) != space.shape[0]:
        raise ValueError(
            f"the task's scenario {scenario.name!r} has {scenario.sensors.lidar_rays} lidar rays, the environment was "
            f"made for {shape_of.sensors.lidar_rays}: make an environment for it"
        )
    for row, high in zip(rows, space.high.tolist(), strict=True):
        if row.high > high * (1 + 1e-6):
            raise ValueError(
                f"the task's scenario {scenario.name!r} needs {row.name} up to {row.high:g}, the environment was made "
                f"for {high:g}: make an environment for it"
            )


def _ego_task_info(episode: Episode) -> dict[str, Any]:
    """What the ego's info tells beyond interception."""
    if episode.scenario.ego_task == "avoidance":
        return {"encountered": episode.encountered, "arrived": episode.arrived}
    if episode.scenario.ego_task == "surveillance":
        return {"watched": episode.watched, "watched_seconds": episode.watched_steps / episode.scenario.control_hertz}
    return {}


def _state_rows(scenario: Scenario) -> tuple[Row, ...]:
    rows = {row.name: row for row in ego_rows(scenario)}
    w, h = scenario.width_metres, scenario.height_metres
    return (
        *robot_rows("ego ", scenario.ego, w, h),
        *robot_rows("adversary ", scenario.adversary, w, h),
        rows["elapsed"],
        rows["left"],
        Row("mission", -1.0, 1.0),
    )
