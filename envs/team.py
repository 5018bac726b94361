"""Several egos against several adversaries in one arena: PettingZoo's ParallelEnv around a TeamEpisode. Glue only.

Agents are ``ego_0`` .. and ``adversary_0`` ..; each adversary has its own mission, monitor and start. One against one is
`InterceptEnv`, to the last bit; that one has the other ego tasks and the curriculum.

- An ego that comes within `interception_metres` of an adversary intercepts it: the adversary is terminated and leaves the
  arena at that physics substep. With `end_on_completion` so is an adversary whose mission is completed or has failed.
- Egos are a team: `Rewards.interception` and `mission_completed` are paid to every ego; time, control and collisions are each
  one's own. The info "interceptions" counts those that an ego made itself.
- The episode ends for the egos when no adversary is left in play, and for all at the horizon.
- Egos observe each other, and all adversaries that a camera sees (layout: `ego_observation`). An adversary observes what it
  does in `InterceptEnv`, its own task and the nearest ego that it notices; it does not observe other adversaries.

The state ``[6 (egos + adversaries) + 2 + missions (+ in play)]`` is every robot's x, y, cos, sin, v, w, the seconds elapsed and
left, each mission's status (0 under way, 1 completed, -1 failed), and with several adversaries whether each is in play.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import ArrayLike, NDArray
from pettingzoo import ParallelEnv

from tab_marl.envs.actions import COMMANDS, ActionKind, action_space, check_kind
from tab_marl.envs.adversary_side import AdversarySide, adversary_space, as_style, notices_ego
from tab_marl.envs.ego_observation import ROWS_WITHOUT_LIDAR, Row, box_of, ego_rows, ego_space, robot_rows, robot_values
from tab_marl.envs.intercept import Infos, Observations, check_shape
from tab_marl.envs.lidar import Lidar
from tab_marl.envs.pictures import FRAMES_PER_SECOND, RENDER_MODES, Pictures
from tab_marl.envs.reward import AdversaryRewards, Events, adversary_reward, ego_reward
from tab_marl.envs.styles import Style
from tab_marl.envs.team_episode import TeamEpisode, TeamEvents, draw_team_starts
from tab_marl.envs.team_source import TeamSource, team_source
from tab_marl.mission import Mission
from tab_marl.mission.tasks import Task
from tab_marl.mission.teams import TeamTask
from tab_marl.world.scenario import Scenario

MOST_ROBOTS = 16
"""Per side."""
_UNSEEN = (0.0,) * 7
_STATUS = {"active": 0.0, "completed": 1.0, "failed": -1.0}


class TeamEnv(ParallelEnv[str, NDArray[np.float32], NDArray[np.float32]]):
    """Egos that must intercept adversaries with missions. See the module's and `__init__`'s descriptions."""

    metadata: ClassVar[dict[str, Any]] = {
        "name": "tab_marl_team_v0",
        "render_modes": list(RENDER_MODES),
        "render_fps": FRAMES_PER_SECOND,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        egos: int = 2,
        adversaries: int = 2,
        task: TeamTask | TeamSource | None = None,
        mission: str | Mission | Sequence[str | Mission] = "M1",
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
        adversary_sees_ego_metres: float | None = None,
        sampled: bool = False,
    ) -> None:
        """`egos`, `adversaries`: how many of each. `mission`: one for all adversaries, or a sequence with one for each.
        `task`: a TeamTask, or a function of a Generator that draws one. The other arguments are `InterceptEnv`'s; the style
        is all adversaries', each draws its own latents.
        """
        for name, count in (("egos", egos), ("adversaries", adversaries)):
            if not 1 <= count <= MOST_ROBOTS:
                raise ValueError(f"{name} is {count}, must lie in 1..{MOST_ROBOTS}")
        if max_cycles is not None and max_cycles < 1:
            raise ValueError(f"max_cycles is {max_cycles}, must be >= 1 or None (the scenario's horizon)")
        self.render_mode = render_mode
        self.end_on_completion, self.full_observation = end_on_completion, full_observation
        self.max_cycles = max_cycles
        self.adversary_style = as_style(adversary_style)
        self.adversary_rewards = AdversaryRewards.of(adversary_rewards)
        self.action_kind = check_kind(actions)
        self.ego_agents = tuple(f"ego_{k}" for k in range(egos))
        self.adversary_agents = tuple(f"adversary_{j}" for j in range(adversaries))
        self.possible_agents = [*self.ego_agents, *self.adversary_agents]
        self.agents: list[str] = []
        self._source = team_source(
            task, mission, scenario, family, egos, adversaries,
            sampled=sampled, adversary_sees_ego_metres=adversary_sees_ego_metres,
        )  # fmt: skip
        self._rng = np.random.default_rng()
        self._pictures = Pictures("tab-marl: team", render_mode, show_lidar)
        self._episode: TeamEpisode | None = None
        # The spaces come from a first task, drawn from a generator of its own so that episodes do not depend on it.
        first = self._source(np.random.default_rng(0))
        self._check_team(first)
        self._shape_of = first.scenario
        spaces = {agent: ego_space(self._shape_of, egos, adversaries) for agent in self.ego_agents}
        self.observation_spaces = spaces | {agent: adversary_space() for agent in self.adversary_agents}
        self.action_spaces = {agent: action_space(self.action_kind) for agent in self.possible_agents}
        self.state_space = box_of(state_rows(self._shape_of, egos, adversaries))

    @property
    def episode(self) -> TeamEpisode:
        """The running episode. Raises RuntimeError before the first reset."""
        if self._episode is None:
            raise RuntimeError("there is no episode yet: call reset first")
        return self._episode

    @property
    def task(self) -> TeamTask:
        """The task of the running episode."""
        return self.episode.team

    def task_of(self, agent: str) -> Task:
        """What an agent plays: an adversary its own task, an ego the first adversary's."""
        tasks = self.episode.team.tasks
        return tasks[self.adversary_agents.index(agent)] if agent in self.adversary_agents else tasks[0]

    def spawn_generator(self) -> np.random.Generator:
        """A generator of its own that follows from the seed of the last seeded reset: for opponents."""
        return self._rng.spawn(1)[0]

    def observation_space(self, agent: str) -> Box:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box | Discrete:
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Observations, Infos]:
        """Begin an episode. `options` may hold "task" (a TeamTask); other keys are ignored. The same seed, options and
        actions give the same episode.
        """
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        team: TeamTask = (options or {}).get("task") or self._source(self._rng)
        self._check_team(team)
        scenario = team.scenario
        check_shape(
            scenario, self._shape_of, ego_rows(scenario, *self._counts), self.observation_spaces[self.ego_agents[0]]
        )
        egos, adversaries = draw_team_starts(team, self._rng)
        self._sides = [AdversarySide(task, self.adversary_style, self._rng) for task in team.tasks]
        self._lidar = Lidar.of(scenario) if scenario.sensors.lidar_rays else None
        self._control_seconds = 1.0 / scenario.control_hertz
        self._last_step = round(scenario.horizon_seconds * scenario.control_hertz)
        if self.max_cycles is not None:
            self._last_step = min(self._last_step, self.max_cycles)
        self._episode = TeamEpisode(team, [side.monitor for side in self._sides], egos, adversaries)
        self.agents = list(self.possible_agents)
        self._pictures.start(team.tasks[0])
        if self.render_mode == "human":
            self.render()
        nothing = (False,) * len(self.adversary_agents)
        quiet = (False,) * len(self.possible_agents)
        return self._observe(), self._infos(TeamEvents(nothing, nothing, nothing, nothing, quiet))

    def step(
        self, actions: Mapping[str, ArrayLike]
    ) -> tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Advance by one control step; every living agent acts. Raises ValueError as `InterceptEnv.step`."""
        episode = self.episode
        if not self.agents:
            if not actions:
                return {}, {}, {}, {}, {}
            raise RuntimeError("the episode is over: call reset")
        events = episode.step(self._commands(actions))
        over = [c or f for c, f in zip(events.completed, events.failed, strict=True)]
        if self.end_on_completion:
            for j, ended in enumerate(over):
                if ended:
                    episode.retire(j)
        done = not any(episode.in_play)
        cut = not done and episode.control_steps >= self._last_step
        living, results = self.agents, (self._observe(), self._rewards(events), self._infos(events))
        terminations = {agent: done for agent in living}
        for j, agent in enumerate(self.adversary_agents):
            if agent in terminations:
                terminations[agent] = not episode.in_play[j]
        truncations = {agent: cut and not terminations[agent] for agent in living}
        self.agents = [agent for agent in living if not (terminations[agent] or truncations[agent])]
        if self.render_mode == "human":
            self.render()
        return results[0], results[1], terminations, truncations, results[2]

    def state(self) -> NDArray[np.float32]:
        """The whole state; its layout is in the module's description."""
        episode, scenario = self.episode, self.episode.scenario
        values: list[float] = []
        for i, motion in enumerate(episode.motions):
            robot = scenario.ego if i < episode.egos else scenario.adversary
            values += robot_values(motion, robot.max_speed)
        values += [episode.seconds, self._left(episode.seconds)]
        values += [_STATUS[monitor.status] for monitor in episode.monitors]
        if episode.adversaries > 1:
            values += [float(here) for here in episode.in_play]
        return np.array(values, dtype=np.float32)

    def set_field(self, field: Any, label: str = "belief") -> None:
        """See `InterceptEnv.set_field`."""
        self._pictures.set_field(field, self._shape_of if self._episode is None else self._episode.scenario, label)

    def render(self) -> NDArray[np.uint8] | None:
        """The picture ``[height, width, 3]`` in mode "rgb_array"; None in mode "human", which shows it in a window."""
        if self.render_mode is None:
            raise RuntimeError(f"render() needs a render_mode: make the environment with one of {list(RENDER_MODES)}")
        return self._pictures.draw(self.episode, not self.agents)

    def close(self) -> None:
        """Close the window, if there is one."""
        self._pictures.close()

    @property
    def _counts(self) -> tuple[int, int]:
        return len(self.ego_agents), len(self.adversary_agents)

    def _commands(self, actions: Mapping[str, ArrayLike]) -> list[tuple[float, float]]:
        command, scenario = COMMANDS[self.action_kind], self.episode.scenario
        found = [(0.0, 0.0)] * len(self.possible_agents)
        living = set(self.agents)
        for i, agent in enumerate(self.possible_agents):
            if agent not in living:
                continue
            if agent not in actions:
                raise ValueError(f"actions lack {agent!r}: every living agent must act, got {sorted(actions)}")
            robot = scenario.ego if i < len(self.ego_agents) else scenario.adversary
            found[i] = command(actions[agent], agent, robot)
        return found

    def _observe(self) -> Observations:
        episode = self.episode
        scenario, elapsed = episode.scenario, episode.seconds
        n = episode.egos
        egos, adversaries = episode.motions[:n], episode.motions[n:]
        top = scenario.adversary.max_speed
        common: list[float] = [elapsed, self._left(elapsed)]
        for j, motion in enumerate(adversaries):
            shown = episode.seen[j] or (self.full_observation and episode.played[j])
            common += (1.0, *robot_values(motion, top)) if shown else _UNSEEN
        if len(adversaries) > 1:
            common += [float(here) for here in episode.in_play]
        own = [robot_values(motion, scenario.ego.max_speed) for motion in egos]
        found: Observations = {}
        for k, agent in enumerate(self.ego_agents):
            if agent not in self.agents:
                continue
            values = [*own[k], *common]
            for other, of in enumerate(own):
                if other != k:
                    values += of
            if self._lidar is not None:
                values += self._lidar.scan(egos[k].x, egos[k].y, egos[k].theta).tolist()
            found[agent] = np.array(values, dtype=np.float32)
        for j, agent in enumerate(self.adversary_agents):
            if agent in self.agents:
                nearest = min(egos, key=lambda ego: math.hypot(ego.x - adversaries[j].x, ego.y - adversaries[j].y))
                noticed = nearest if notices_ego(scenario, adversaries[j], nearest) else None
                found[agent] = self._sides[j].observe(adversaries[j], noticed)
        return found

    def _rewards(self, events: TeamEvents) -> dict[str, float]:
        episode, seconds = self.episode, self._control_seconds
        scenario = episode.scenario
        team = scenario.rewards.interception * sum(events.intercepted)
        team += scenario.rewards.mission_completed * sum(events.completed)
        paid: dict[str, float] = {}
        for k, agent in enumerate(self.ego_agents):
            if agent in self.agents:
                own = Events(ego_collided=events.collided[k])
                paid[agent] = ego_reward(own, episode.motions[k], scenario, seconds) + team
        for j, agent in enumerate(self.adversary_agents):
            if agent in self.agents:
                own = Events(
                    events.intercepted[j], events.completed[j], events.failed[j], False,
                    events.collided[episode.egos + j], events.active[j],
                )  # fmt: skip
                paid[agent] = adversary_reward(own, self.adversary_rewards, scenario, seconds, self._sides[j].gained)
        return paid

    def _infos(self, events: TeamEvents) -> Infos:
        episode = self.episode
        common = {"in_play": sum(episode.in_play), "physics_steps": episode.physics_steps}
        found: Infos = {}
        for i, agent in enumerate(self.possible_agents):
            j = i - episode.egos
            if agent not in self.agents:
                continue
            info: dict[str, Any] = {**common, "collided": events.collided[i]}
            if j < 0:
                info["interceptions"] = episode.captor.count(i)
            else:
                monitor = episode.monitors[j]
                info["intercepted"] = episode.captor[j] is not None
                info["mission_status"], info["why_failed"] = monitor.status, monitor.why_failed
                info["completed_seconds"] = episode.completed_at[j]
            found[agent] = info
        return found

    def _left(self, elapsed: float) -> float:
        return max(0.0, self._last_step * self._control_seconds - elapsed)

    def _check_team(self, team: TeamTask) -> None:
        egos, adversaries = self._counts
        if (len(team.ego_starts), len(team.tasks)) != (egos, adversaries):
            raise ValueError(
                f"the task is for {len(team.ego_starts)} egos and {len(team.tasks)} adversaries, the environment for {egos} "
                f"and {adversaries}: make an environment for it"
            )


def state_rows(scenario: Scenario, egos: int, adversaries: int) -> tuple[Row, ...]:
    """The layout of the state."""
    w, h = scenario.width_metres, scenario.height_metres
    clocks = {row.name: row for row in ego_rows(scenario)[:ROWS_WITHOUT_LIDAR]}
    return (
        *(row for k in range(egos) for row in robot_rows(f"ego {k} ", scenario.ego, w, h)),
        *(row for j in range(adversaries) for row in robot_rows(f"adversary {j} ", scenario.adversary, w, h)),
        clocks["elapsed"],
        clocks["left"],
        *(Row(f"mission {j}", -1.0, 1.0) for j in range(adversaries)),
        *(Row(f"adversary {j} in play", 0.0, 1.0) for j in range(adversaries) if adversaries > 1),
    )
