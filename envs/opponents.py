"""Scripted players for the side that does not learn: a name, an object with `act(observation)`, or a plain function.

==========  ==========  ==============================================================================================
name        side        what it does
==========  ==========  ==============================================================================================
static      either      stands still
random      either      a new random action every half second
follow      adversary   follows the route that its observation shows, and waits where it would be too early
pursue      ego         drives to where a camera last saw the adversary, round obstacles, and waits there; of several
                        it takes the one nearest to itself
arrive      ego         drives to its own goal round obstacles (ego task avoidance), whatever the adversary does
==========  ==========  ==============================================================================================

Any other name is handed to the loader that `registration.register_all` was given: with `import tab_marl`, the name of a zoo
policy (adversary) or of a planner (ego), the folder of a policy, or a stable-baselines3 model's zip file (either side).

An object may also have `reset(task, rng)`, called at the start of every episode.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib import import_module
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from tab_marl.envs import adversary_kernels as rows
from tab_marl.envs.ego_observation import EgoView, parse_adversaries, parse_ego_observation
from tab_marl.envs.lidar import Lidar
from tab_marl.envs.registration import opponent_loader
from tab_marl.mission.tasks import Task
from tab_marl.world.grid import GridMap
from tab_marl.world.kernels import steer
from tab_marl.world.scenario import UnknownName

Action = NDArray[np.float32]

STAND_STILL = np.array([-1.0, 0.0], dtype=np.float32)
HOLD_SECONDS = 0.5
"""How long a random player keeps its action, and how often a pursuer plans anew."""
EARLY_SECONDS = 0.2
"""A follower that would arrive so much too early waits."""
CELL_METRES = 0.1
LOOK_METRES = 0.8
"""How far ahead a pursuer looks for the next point of its way."""
CLEARANCE_METRES = 0.02
"""Between a pursuer and obstacles, where the map allows it."""


@runtime_checkable
class Player(Protocol):
    """What plays one side."""

    def act(self, observation: NDArray[np.float32]) -> Action:
        """The action ``[2]`` in [-1, 1] for an observation of this side."""
        ...


class Static:
    """Stands still."""

    def act(self, observation: NDArray[np.float32]) -> Action:
        return STAND_STILL


class Random:
    """A random action, held for HOLD_SECONDS."""

    def reset(self, task: Task, rng: np.random.Generator) -> None:
        self._rng = rng
        self._hold = round(HOLD_SECONDS * task.scenario.control_hertz)
        self._step = 0
        self._action = STAND_STILL

    def act(self, observation: NDArray[np.float32]) -> Action:
        if self._step % self._hold == 0:
            self._action = self._rng.uniform(-1.0, 1.0, 2).astype(np.float32)
        self._step += 1
        return self._action


def follow_route(observation: NDArray[np.float32], turn_per_step: float | NDArray[np.float64]) -> Action:
    """Turn towards the observed route and drive along it; wait where that would be too early.

    `observation`: ``[D]`` or ``[N, D]`` of the adversary; `turn_per_step`: largest turn in one control step, rad.
    Returns actions ``[2]`` or ``[N, 2]`` in [-1, 1].
    """
    o = np.atleast_2d(observation)
    forward, left = o[:, rows.O_ROUTE], o[:, rows.O_ROUTE + 1]
    waits = (o[:, rows.O_TARGET] > 0.5) & (10.0 * o[:, rows.O_TARGET + 1] > EARLY_SECONDS)
    nowhere = (forward == 0) & (left == 0)
    speed = np.where((forward < 0.5) | waits | nowhere, 0.0, np.minimum(forward, o[:, rows.O_LIMIT]))
    turn = np.clip(np.arctan2(left, forward) / turn_per_step, -1.0, 1.0)
    action = np.stack([2.0 * speed - 1.0, np.where(nowhere, 0.0, turn)], axis=1).astype(np.float32)
    return action if np.ndim(observation) == 2 else action[0]


class Follow:
    """Follows the route in the adversary's observation (`follow_route`)."""

    def reset(self, task: Task, rng: np.random.Generator) -> None:
        self._turn_per_step = task.scenario.adversary.max_turn_rate / task.scenario.control_hertz

    def act(self, observation: NDArray[np.float32]) -> Action:
        return follow_route(observation, self._turn_per_step)


class _Driver:
    """Drives round obstacles by the shortest free way."""

    def reset(self, task: Task, rng: np.random.Generator) -> None:
        self._scenario = task.scenario
        self._seconds = 1.0 / task.scenario.control_hertz
        self._replan = round(HOLD_SECONDS * task.scenario.control_hertz)
        self._grid = GridMap.from_scenario(
            task.scenario, CELL_METRES, task.scenario.ego.radius_metres + CLEARANCE_METRES
        )
        self._lidar = Lidar.of(task.scenario)
        self._target: tuple[float, float] | None = None
        self._to_go: NDArray[np.float64] | None = None
        self._step = 0

    def _head_for(self, target: tuple[float, float]) -> None:
        self._target = target
        self._to_go = self._grid.distances(self._grid.cells_of([target]))

    def _drive(self, view: EgoView) -> Action:
        self._step += 1
        if self._target is None or self._to_go is None:
            return STAND_STILL
        x, y = self._waypoint(view.x, view.y, self._target, self._to_go)
        robot = self._scenario.ego
        v, w = steer(view.x, view.y, view.theta, x, y, robot.max_speed, robot.max_turn_rate, self._seconds)
        return np.array([2.0 * v / robot.max_speed - 1.0, w / robot.max_turn_rate], dtype=np.float32)

    def _waypoint(
        self, x: float, y: float, target: tuple[float, float], to_go: NDArray[np.float64]
    ) -> tuple[float, float]:
        """The point in plain sight from which the rest of the way is shortest."""
        centres = self._grid.centres
        distance = np.hypot(centres[:, 0] - x, centres[:, 1] - y)
        for cell in np.argsort(np.where(distance <= LOOK_METRES, to_go, np.inf))[:40]:
            cx, cy = float(centres[cell, 0]), float(centres[cell, 1])
            if self._wide_view(x, y, cx, cy):
                return (cx, cy) if to_go[cell] > CELL_METRES else target
        return target

    def _wide_view(self, x: float, y: float, to_x: float, to_y: float) -> bool:
        """Whether the robot's whole width passes on the straight line."""
        length = math.hypot(to_x - x, to_y - y)
        if length == 0.0:
            return True
        radius = self._scenario.ego.radius_metres
        ox, oy = -(to_y - y) / length * radius, (to_x - x) / length * radius
        return all(self._lidar.sees(x + s * ox, y + s * oy, to_x + s * ox, to_y + s * oy) for s in (-1.0, 0.0, 1.0))


class Pursue(_Driver):
    """Drives to the latest sighting; of several adversaries, to the seen one that is nearest."""

    def __init__(self, adversaries: int = 1) -> None:
        self._adversaries = adversaries

    def act(self, observation: NDArray[np.float32]) -> Action:
        view = parse_ego_observation(observation)
        shown = view.adversary
        if self._adversaries > 1:
            seen = [a for a in parse_adversaries(observation, self._adversaries) if a is not None]
            shown = min(seen, key=lambda a: math.hypot(a.x - view.x, a.y - view.y), default=None)
        if shown is not None and (self._to_go is None or self._step % self._replan == 0):
            self._head_for((shown.x, shown.y))
        return self._drive(view)


class Arrive(_Driver):
    """Drives to the ego's own goal."""

    def reset(self, task: Task, rng: np.random.Generator) -> None:
        super().reset(task, rng)
        goal = task.scenario.ego_goal
        if goal is None:
            raise ValueError(
                f"the scripted ego 'arrive' needs a goal, scenario {task.scenario.name!r} has none: its ego_task is "
                f"{task.scenario.ego_task!r}, must be 'avoidance'"
            )
        self._head_for(goal.centre)

    def act(self, observation: NDArray[np.float32]) -> Action:
        return self._drive(parse_ego_observation(observation))


class Function:
    """A plain function of the observation, as a player."""

    def __init__(self, function: Callable[[NDArray[np.float32]], Any]) -> None:
        self._function = function

    def act(self, observation: NDArray[np.float32]) -> Action:
        return np.asarray(self._function(observation), dtype=np.float32)


class Model:
    """A stable-baselines3 model, or whatever else has `predict(observation) -> (action, state)`, as a player.

    A state other than None, as recurrent models have, is handed back with the next observation.
    """

    def __init__(self, model: Any) -> None:
        self._model = model
        self._state: Any = None
        self._begun: set[int] = set()

    def reset(self, task: Task, rng: np.random.Generator) -> None:
        """Begin an episode."""
        self._state = None

    def begin(self, which: NDArray[np.int64]) -> None:
        """Of the episodes played side by side, these begin anew."""
        self._begun.update(which.tolist())

    def act(self, observation: NDArray[np.float32]) -> Action:
        remembered: dict[str, Any] = {}
        if self._state is not None:
            starts = np.isin(np.arange(len(np.atleast_2d(observation))), list(self._begun))
            remembered = {"state": self._state, "episode_start": starts}
        self._begun.clear()
        action, self._state = self._model.predict(observation, deterministic=True, **remembered)
        return np.asarray(action, dtype=np.float32)


OPPONENTS: dict[str, dict[str, Callable[[], Player]]] = {
    "ego": {"static": Static, "random": Random, "pursue": Pursue, "arrive": Arrive},
    "adversary": {"static": Static, "random": Random, "follow": Follow},
}
"""Side -> name -> player."""

Opponent = str | Player | Callable[[NDArray[np.float32]], Any]


def make_opponent(opponent: Opponent | Any, side: str, adversaries: int = 1) -> Player:
    """The player of a side, in an arena with so many adversaries.

    `opponent`: a scripted player's name, another name for the registered loader, an object with `act(observation)`, a
    stable-baselines3 model, or a function of the observation. Of a policy that may remember its episode (it has `another`) the
    player is another one, with a memory of its own. Raises UnknownName for a name that nobody knows, TypeError for what cannot
    act.
    """
    if isinstance(opponent, str):
        if opponent == "pursue" and side == "ego":
            return Pursue(adversaries)
        if opponent in OPPONENTS[side]:
            return OPPONENTS[side][opponent]()
        loader = opponent_loader()
        if loader is None:
            raise UnknownName(f"scripted {side}", opponent, OPPONENTS[side])
        module, function = loader.split(":")
        loaded: Player = getattr(import_module(module), function)(opponent, side)
        return loaded
    if isinstance(opponent, Player):
        another: Callable[[], Player] | None = getattr(opponent, "another", None)
        return opponent if another is None else another()
    if hasattr(opponent, "predict"):
        return Model(opponent)
    if callable(opponent):
        return Function(opponent)
    raise TypeError(
        f"opponent is {opponent!r}, must be one of {list(OPPONENTS[side])}, have act(observation) or predict(observation), or "
        "be a function"
    )
