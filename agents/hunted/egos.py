"""The live egos that adversaries are trained against: one per arena, drawn anew for every episode."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tab_marl.agents.planner_memory import PlannerMemory
from tab_marl.agents.planners import PLANNERS, PlannerAgent, PlannerOptions, make_planner
from tab_marl.envs.opponents import OPPONENTS, make_opponent
from tab_marl.mission.tasks import Task
from tab_marl.planning.pursuit.itineraries import PursuitOptions
from tab_marl.world.scenario import UnknownName

SEPARATOR = "+"
"""Between the names of egos of which one is drawn per episode: "FP-POMCP+TAB-POMCP"."""
DECISION_MILLISECONDS = 5.0
"""What planners search in training (`PursuitOptions.for_milliseconds`): 60 sampled paths and 40 simulations a decision, a
seventh of an evaluation's, for a quarter of the time."""
SEEDS = 2**62


def hunter_names(opponent: str) -> tuple[str, ...]:
    """The egos that an opponent setting names. Raises UnknownName, or ValueError for the oracle, which sees too much."""
    names = tuple(part.strip() for part in opponent.split(SEPARATOR))
    for name in names:
        if name == "oracle":
            raise ValueError("the ego 'oracle' sees the adversary always: adversaries are not hunted by it in training")
        if not name.endswith(".zip") and name not in (*PLANNERS, *OPPONENTS["ego"]):
            raise UnknownName("ego", name, (*OPPONENTS["ego"], *PLANNERS))
    return names


def hunting_options() -> PlannerOptions:
    """How planners plan while they hunt in training: with a seventh of the search of an evaluation.

    TAB-POMCP expects the field alone: ways drawn for every episode would take longer than the episode.
    """
    return PlannerOptions(
        pursuit=PursuitOptions.for_milliseconds(DECISION_MILLISECONDS), memory=PlannerMemory(), ways=None
    )  # fmt: skip


class Hunters:
    """N arenas' egos. `options` are the planners'; they share its memory of tasks."""

    def __init__(self, names: Sequence[str], arenas: int, options: PlannerOptions | None = None) -> None:
        if not names:
            raise ValueError("there must be at least one ego that hunts, got none")
        self.names = tuple(names)
        self._options = options or hunting_options()
        self._saved = {name: make_opponent(name, "ego") for name in names if name.endswith(".zip")}
        """Saved models, read once; every arena has another of them, since a recurrent one remembers its episode."""
        self._own: list[dict[str, Any]] = [{} for _ in range(arenas)]
        self._playing: list[Any] = [None] * arenas

    def begin(self, arena: int, hunter: int, task: Task, seed: int, learned: str = "") -> str:
        """An episode begins in an arena: ego number `hunter` plays, from `seed`.

        Returns what it has learned in earlier episodes, as JSON text ("" for nothing); `learned` puts that back first.
        """
        name = self.names[hunter]
        player = self._own[arena].get(name)
        if player is None:
            known_by = self._saved.get(name, name)
            player = make_planner(name, self._options) if name in PLANNERS else make_opponent(known_by, "ego")
            self._own[arena][name] = player
        if learned and isinstance(player, PlannerAgent):
            player.restore(json.loads(learned))
        known = player.learned_state() if isinstance(player, PlannerAgent) else None
        reset = getattr(player, "reset", None)
        if reset is not None:
            reset(task, np.random.default_rng(seed))
        self._playing[arena] = player
        return "" if known is None else json.dumps(known)

    def leave(self, arena: int) -> None:
        """The arena's episode is over."""
        self._playing[arena] = None

    def act(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Actions ``[N, 2]`` for the egos' observations ``[N, D]``; arenas without an episode get a standing ego."""
        actions = np.tile(np.array([-1.0, 0.0], dtype=np.float32), (len(observations), 1))
        for i, player in enumerate(self._playing):
            if player is not None:
                actions[i] = player.act(observations[i])
        return actions
