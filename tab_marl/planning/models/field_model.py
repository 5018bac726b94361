"""Half of TAB-POMCP's adversary: the TAB-Field, solved once per mission and filtered exactly on everything seen and not seen."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tab_marl.field.problem import FieldOptions, FieldProblem
from tab_marl.field.sampling import sample_paths
from tab_marl.field.solve import solve
from tab_marl.field.tab_field import TabField
from tab_marl.mission.model import Mission
from tab_marl.planning.models.interface import SampledPaths, TickObservation
from tab_marl.planning.models.mission_map import MissionMap
from tab_marl.planning.models.sight import Sight
from tab_marl.world.grid import GridMap
from tab_marl.world.scenario import Scenario

ALL_DONE = 1e-3
"""With less than this chance that the mission is still under way, the hunt is for the reference process."""
AGREEING_SHARE = 0.05
"""With at least this probability on the mission states that a sighting leaves, they are kept as they are."""
SUBCELLS = 5
"""Points per side of a cell at which a camera's view is tested."""


@lru_cache(maxsize=4)
def solved_field(scenario: Scenario, mission: Mission, options: FieldOptions) -> TabField:
    """The field of a task; cached, because all planners of a unit share it."""
    return solve(FieldProblem.from_mission(mission, scenario, options))


@lru_cache(maxsize=32)
def camera_cover(scenario: Scenario, grid: GridMap) -> NDArray[np.float64]:
    """``[C]``: the share of each cell that lies in some camera disc."""
    offsets = ((np.arange(SUBCELLS) + 0.5) / SUBCELLS - 0.5) * grid.cell_metres
    shift = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 1, 2)
    return np.asarray(scenario.seen(grid.centres[None] + shift).mean(axis=0))


class FieldModel:
    """The exact belief over cells x modes x mission states under the field's own kernel."""

    def __init__(
        self,
        scenario: Scenario,
        mission: Mission,
        options: FieldOptions | None = None,
        field: TabField | None = None,
    ) -> None:
        """`field`: the task's, if it is solved already.

        Raises InfeasibleField when the reference process cannot complete the mission.
        """
        self.scenario = scenario
        self.field = field or solved_field(scenario, mission, options or FieldOptions())
        grid = self.field.problem.grid
        assert isinstance(grid, GridMap)  # a field made from a planar mission has one
        self.grid = grid
        self.map = MissionMap.build(scenario, mission)
        self._cover = camera_cover(scenario, grid)
        self.belief = self.field.belief()
        self._at_sighting = 0.0

    @property
    def fallbacks(self) -> int:
        return self.belief.fallbacks

    @property
    def log_evidence(self) -> float:
        """Log-likelihood of the observations since the last sighting."""
        return self.belief.log_evidence - self._at_sighting if np.isfinite(self.belief.log_evidence) else -50.0

    def start(self, observation: TickObservation, rng: np.random.Generator) -> None:
        self.belief, self._at_sighting = self.field.belief(), 0.0
        self._condition(observation)

    def observe(self, observation: TickObservation, rng: np.random.Generator) -> None:
        before = self.belief.automaton_states, self.belief.masses.sum(axis=1)
        self.belief.predict()
        self._condition(observation)
        if observation.sighting is not None:
            self._read_places(*before, observation)

    def sample(self, count: int, ticks: int, rng: np.random.Generator) -> SampledPaths:
        belief = self.belief
        under_way = belief.automaton_states != belief.chain.accepting
        hunting = 1.0 - belief.completed < ALL_DONE
        if self.scenario.ego_task == "interception" and not hunting and not under_way.all():
            belief = belief.copy()
            belief.masses = belief.masses[under_way] / belief.masses[under_way].sum()
            belief.automaton_states = belief.automaton_states[under_way]
        paths = sample_paths(self.field.chain, belief, rng, count, ticks)
        completed = np.full(count, -1, dtype=np.int32) if hunting else paths.completed_tick
        return SampledPaths(paths.positions, completed)

    def occupancy(self) -> tuple[GridMap, NDArray[np.float64]]:
        return self.grid, self.belief.cell_marginal()

    def _condition(self, observation: TickObservation) -> None:
        seen, scenario = observation.sighting, self.scenario
        if seen is None or not observation.seen_now:
            cover = self._cover
            if scenario.ego_task == "surveillance":
                in_sight = Sight.of(scenario).watched(observation.ego, self.grid.centres, scenario.watch_metres)
                cover = np.maximum(cover, in_sight)
            self.belief.condition_on_unseen(cover, observation.ego, scenario.interception_metres)
        if seen is not None:
            # Seen within the tick but not at its end: it drove on.
            travelled = seen.speed * seen.age_seconds
            point = (seen.x + travelled * math.cos(seen.theta), seen.y + travelled * math.sin(seen.theta))
            self.belief.condition_on_seen(point, seen.theta, seen.speed / scenario.adversary.max_speed)
            if not np.isfinite(self.belief.log_evidence):  # the filter fell back: it starts anew from here
                self.belief.log_evidence = 0.0
            self._at_sighting = self.belief.log_evidence

    def _read_places(
        self, states: NDArray[np.int32], totals: NDArray[np.float64], observation: TickObservation
    ) -> None:
        """Correct what the mission's state is by where the adversary was really seen, to the centimetre and ten times a
        second, instead of by the cell that it is in at the tick.

        `states` and `totals` are the automaton states a tick ago and their probabilities.
        """
        belief, automaton, seen = self.belief, self.field.problem.automaton, observation.sighting
        assert seen is not None
        if self.field.problem.options.kernel != "bridge":
            return
        following = np.empty_like(states)
        for location in np.unique(automaton.location[states]):
            mask = self.map.label(int(location), (seen.x, seen.y), observation.track)
            if mask not in automaton.masks:  # no cell has this label
                return
            members = automaton.location[states] == location
            following[members] = automaton.delta[states[members], int(automaton.symbols([mask])[0])]
        targets, index = np.unique(following, return_inverse=True)
        agreeing = np.isin(belief.automaton_states, targets)
        if agreeing.all():
            return
        if belief.masses[agreeing].sum() > AGREEING_SHARE:
            belief.automaton_states, belief.masses = belief.automaton_states[agreeing], belief.masses[agreeing]
        else:
            rows = np.bincount(index, weights=totals)[:, None] * belief.masses.sum(axis=0)
            feasible = rows * (belief.chain.norm[targets] > 0)
            belief.automaton_states, belief.masses = targets.astype(np.int32), feasible if feasible.any() else rows
        belief.masses = belief.masses / belief.masses.sum()
