"""Do bodies stay where they belong? Random episodes, with every robot held against walls and obstacles at every control step.

Robots are driven hard: at top speed into whatever comes, turning at random, or by extreme actions that change at random. A
body never gets far enough in one control step (2.2 cm) to pass an obstacle unnoticed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tab_marl.envs.intercept import InterceptEnv
from tab_marl.envs.team import TeamEnv
from tab_marl.world.scenario import Scenario

DEEPEST_METRES = 0.005
"""A body may sink so far into a wall: it moves 2.2 mm in the substep in which it meets one, twice that between two robots."""
DRIVINGS = ("ram", "weave", "jitter")
HOLD_STEPS = {"ram": 25, "weave": 8, "jitter": 1}
"""Control steps for which an action is held."""


@dataclass(frozen=True)
class Findings:
    """What one episode, or several together, showed."""

    episodes: int
    steps: int
    """Control steps times robots."""
    touches: int
    """Of them, those at whose end a robot was within 1 mm of a wall or an obstacle, or in it."""
    deepest_metres: float
    """How far a body was inside a wall or an obstacle, at most."""
    longest_metres: float
    """The longest way that a centre moved in a control step, over what its top speed allows: at most 1, pushes apart."""
    outside: int
    """Observations and states outside their spaces."""

    @property
    def sound(self) -> bool:
        """Whether no body left the arena or entered an obstacle and all observations were legal."""
        return self.deepest_metres <= DEEPEST_METRES and self.outside == 0


def random_episode(env: InterceptEnv | TeamEnv, seed: int, driving: str = "ram") -> Findings:
    """Play one episode with random actions of a kind (`DRIVINGS`) and look at every control step."""
    rng = np.random.default_rng((seed, DRIVINGS.index(driving)))
    observations, _ = env.reset(seed=seed)
    seen: dict[str, list[NDArray[np.float32]]] = {agent: [observations[agent]] for agent in env.agents}
    states, tracks = [env.state()], [_centres(env)]
    actions: dict[str, NDArray[np.float32]] = {}
    hold = HOLD_STEPS[driving]
    step = 0
    while env.agents:
        for i, agent in enumerate(env.agents):
            if agent not in actions or (step + 3 * i) % hold == 0:
                actions[agent] = _action(rng, driving)
        observations, *_ = env.step({agent: actions[agent] for agent in env.agents})
        for agent, observation in observations.items():
            seen[agent].append(observation)
        states.append(env.state())
        tracks.append(_centres(env))
        step += 1
    outside = _outside(np.stack(states), env.state_space)
    outside += sum(_outside(np.stack(rows), env.observation_space(agent)) for agent, rows in seen.items())
    return _judge(env.episode.scenario, np.stack(tracks), _egos(env), outside)


def together(findings: Sequence[Findings]) -> Findings:
    """Several findings as one."""
    return Findings(
        sum(f.episodes for f in findings),
        sum(f.steps for f in findings),
        sum(f.touches for f in findings),
        max(f.deepest_metres for f in findings),
        max(f.longest_metres for f in findings),
        sum(f.outside for f in findings),
    )


def depth_metres(scenario: Scenario, points: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """``[N]``: how far a body of this radius at these centres ``[N, 2]`` is inside a wall or an obstacle; negative: clear."""
    x, y = points[:, 0], points[:, 1]
    gaps = [x, y, scenario.width_metres - x, scenario.height_metres - y]
    gaps += [obstacle.distance(points) for obstacle in scenario.obstacles]
    return np.asarray(radius - np.min(gaps, axis=0))


def _action(rng: np.random.Generator, driving: str) -> NDArray[np.float32]:
    if driving == "jitter":
        return rng.choice(np.array([-1.0, 0.0, 1.0], dtype=np.float32), 2)
    turn = rng.uniform(-0.3, 0.3) if driving == "ram" else rng.uniform(-1.0, 1.0)
    return np.array([1.0, turn], dtype=np.float32)


def _centres(env: InterceptEnv | TeamEnv) -> list[tuple[float, float]]:
    motions = env.episode.motions if isinstance(env, TeamEnv) else env.episode.motion
    return [(motion.x, motion.y) for motion in motions]


def _egos(env: InterceptEnv | TeamEnv) -> int:
    return env.episode.egos if isinstance(env, TeamEnv) else 1


def _outside(rows: NDArray[np.float32], space: Any) -> int:
    return int((~((rows >= space.low) & (rows <= space.high)).all(axis=1)).sum())


def _judge(scenario: Scenario, tracks: NDArray[np.float64], egos: int, outside: int) -> Findings:
    """`tracks` ``[steps, robots, 2]`` metres."""
    deepest = longest = -np.inf
    touches = 0
    for i in range(tracks.shape[1]):
        robot = scenario.ego if i < egos else scenario.adversary
        depth = depth_metres(scenario, tracks[:, i], robot.radius_metres)
        moved = np.hypot(*np.diff(tracks[:, i], axis=0).T) * scenario.control_hertz / robot.max_speed
        deepest, longest = max(deepest, float(depth.max())), max(longest, float(moved.max(initial=0.0)))
        touches += int((depth > -1e-3).sum())
    return Findings(1, tracks.shape[0] * tracks.shape[1], touches, deepest, longest, outside)
