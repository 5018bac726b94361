"""A belief as a sample of states, for any generative model: the bootstrap filter, with reinvigoration, that never dies.

One cycle of belief, plan, act and update (`tab_marl.planning.cycle.play` is this loop with a record of what happened)::

    belief = ParticleFilter(model, prior, rng=0)              # prior: states, Particles or sampler(count, rng)
    while not over:
        plan = planner.plan(belief.sample, rng)               # plan from what is believed
        observation, reward, over = world(plan.action)        # act
        if not over:
            belief.update(plan.action, observation)           # believe what was seen
    print(belief.report())

The bootstrap filter (Gordon, Salmond and Smith, IEE Proc. F 1993) steps every particle and weighs it by how well it explains the
observation, then resamples systematically. Without a likelihood a particle either gave the very observation or not, and
stepping goes on until enough did (rejection; Silver and Veness, NeurIPS 2010, algorithm 1). When no particle explains what was
seen, the history is replayed from the prior, with more particles and if need be with weights that forgive; when even that
explains nothing, a fallback is asked.
Both are counted, warned of (`BeliefWarning`) and reported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.beliefs.filter_report import Deprivation, EventLog, FilterReport, named
from tab_marl.planning.beliefs.particle_dynamics import dynamics_of
from tab_marl.planning.beliefs.recent_history import RecentHistory
from tab_marl.planning.model import Particles, action_names, draw_particles

Reinvigorate: TypeAlias = Callable[[NDArray[Any], np.random.Generator], NDArray[Any]]
"""``reinvigorate(states [n, D], rng) -> states [n, D]``: neighbours of these states, to keep the belief from thinning out."""
Fallback: TypeAlias = Callable[[int, Any, int, np.random.Generator], Any]
"""``fallback(action, observation, count, rng) -> states``: a belief for when nothing explains the observation."""


@dataclass(frozen=True)
class FilterOptions:
    """How to filter. Raises ValueError naming the field, its value and its bounds."""

    count: int = 2000
    """N: particles."""
    resample_below: float = 0.5
    """Resample when the effective sample size falls below this share of `count`; 1 resamples always."""
    tries: int = 100
    """Without a likelihood: simulated steps an update may take, as a multiple of `count`."""
    reinvigorated: float = 1 / 16
    """Share of the particles handed to `reinvigorate` before each step (Silver and Veness 2010 use 1/16)."""
    replay: int = 5
    """Particles of a replay, as a multiple of `count`; 0 goes straight to the fallback."""
    doubt: float = 1e-3
    """In a replay: the weight, relative to the best particle's, of one that does not explain an observation."""
    memory: int = 200
    """Updates that a replay reaches back at least (up to twice as many); what lies before is kept as particles."""

    def __post_init__(self) -> None:
        for name, least in (("count", 1), ("tries", 1), ("replay", 0), ("memory", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}, must be >= {least}")
        for name in ("resample_below", "reinvigorated", "doubt"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}, must be in [0, 1]")


@dataclass(eq=False)
class ParticleFilter:
    """A belief over the states of `model` (compiled, tables, continuous observations or plain Python) that follows a history.

    `likelihood` (or the model's own) is ``likelihood(state left, action, state reached, observation, data) -> float``, a
    function that numba can compile (plain Python models: without `data`). Tables need none.
    """

    model: Any
    prior: Any
    """States, `Particles` or ``sampler(count, rng)``: the belief before the first action."""
    options: FilterOptions = FilterOptions()
    rng: np.random.Generator | int = 0
    likelihood: Callable[..., float] | None = None
    reinvigorate: Reinvigorate | None = None
    fallback: Fallback | None = None
    """None: draws from the prior, led through the last action and observation where that is possible."""
    states: NDArray[Any] = field(init=False)
    """``[N, D]`` (plain Python: ``[N]`` objects)."""
    weights: NDArray[np.float64] = field(init=False)
    """``[N]``, summing to 1."""

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.rng)
        self._random: np.random.Generator = self.rng
        self._dynamics = dynamics_of(self.model, self.likelihood)
        self._names = action_names(self.model)
        self._log = EventLog()
        self._history = RecentHistory(self.prior, self.options.memory)
        self._take(self._dynamics.draw(self.prior, self.options.count, self._random))

    def sample(self, count: int, rng: np.random.Generator) -> NDArray[Any]:
        """``[count, D]`` states, each used as often as its weight says; hand this method to a planner as its belief."""
        return self.states[draw_particles(count, len(self.states), self.weights, rng)]

    @property
    def particles(self) -> Particles:
        """The belief as a planner takes it, without drawing."""
        return Particles(self.states, self.weights)

    @property
    def effective(self) -> float:
        """The effective sample size 1 / sum of squared weights (Kong, Liu and Wong, JASA 1994)."""
        return float(1.0 / (self.weights**2).sum())

    def update(self, action: int, observation: Any) -> ParticleFilter:
        """Takes the step in which `action` was done, `observation` seen, and the process did not end. Returns itself."""
        if not 0 <= action < self.model.actions:
            raise ValueError(f"action is {action}, must be in 0..{self.model.actions - 1}")
        reached = (self._weighed if self._dynamics.weighs else self._matching)(action, observation)
        self._log.updates += 1  # not before: input that is refused has not been seen
        self._history.append(action, observation)
        if reached is None:
            self._recover(action, observation)
        else:
            self._take(*reached)
        self._log.least_effective = min(self._log.least_effective, self.effective)
        if self.effective < self.options.resample_below * self.options.count:
            self._take(self.sample(self.options.count, self._random))
        self._history.keep(self.particles)
        return self

    def report(self) -> FilterReport:
        """What happened so far: updates, effective sample size, and every loss of track."""
        return self._log.report()

    def _take(self, states: NDArray[Any], weights: NDArray[np.float64] | None = None) -> None:
        self.states = states
        self.weights = np.full(len(states), 1 / len(states)) if weights is None else weights / weights.sum()

    def _refreshed(self, states: NDArray[Any]) -> NDArray[Any]:
        """The states, a share of them replaced by neighbours: those that cannot be will not explain what is seen next."""
        share = round(self.options.reinvigorated * len(states))
        if self.reinvigorate is None or share == 0:
            return states
        chosen = self._random.choice(len(states), size=share, replace=False)
        states = states.copy()
        states[chosen] = self.reinvigorate(states[chosen], self._random)
        self._dynamics.check(states[chosen])
        return states

    def _weighed(self, action: int, observation: Any) -> tuple[NDArray[Any], NDArray[np.float64]] | None:
        """Every particle stepped once, weighed by the likelihood; None if none explains the observation."""
        after, likelihood = self._dynamics.advance(self._refreshed(self.states), action, observation, self._random)
        weights = self.weights * np.maximum(likelihood, 0.0)
        return (after, weights) if weights.sum() > 0 else None

    def _matching(self, action: int, observation: Any) -> tuple[NDArray[Any], None] | None:
        """Particles stepped until enough gave the very observation; those found are repeated if too few; None if none."""
        count, found, tried = self.options.count, list[NDArray[Any]](), 0
        while sum(map(len, found)) < count and tried < self.options.tries * count:
            states = self._refreshed(self.sample(count, self._random))
            after, matches = self._dynamics.advance(states, action, observation, self._random)
            found.append(after[matches > 0])
            tried += count
        states = np.concatenate(found)
        if len(states) == 0:
            return None
        return (
            states[:count] if len(states) >= count else states[draw_particles(count, len(states), None, self._random)]
        ), None

    def _recover(self, action: int, observation: Any) -> None:
        # Strictly first; forgiving only when no course of events explains everything that was seen.
        states = self._replayed(doubt=0.0)
        if states is None:
            states = self._replayed(self.options.doubt)
        tried = len(self.states) * (1 if self._dynamics.weighs else self.options.tries)
        detail = f"none of {tried} particles explains it"
        if states is not None:
            event = Deprivation(self._log.updates, named(self._names, action), observation, "replay", detail)
        else:
            states, explained = self._fallen_back(action, observation)
            detail += f", nor does a replay of {len(self._history)} steps" if self.options.replay else ""
            detail += explained
            event = Deprivation(self._log.updates, named(self._names, action), observation, "fallback", detail)
            self._history.restart(Particles(states))
        self._take(states)
        self._log.lost(event)

    def _replayed(self, doubt: float) -> NDArray[Any] | None:
        """The history again from where it is remembered, forgiving what a particle does not explain; None if the last
        observation is explained by none."""
        count = self.options.replay * self.options.count
        if count == 0:
            return None
        states = self._dynamics.draw(self._history.origin, count, self._random)
        weights = np.full(count, 1 / count)
        best, starts = 0.0, list[Particles]()
        for stretch in self._history:
            starts.append(Particles(states, weights))
            for action, observation in stretch.steps:
                states, likelihood = self._dynamics.advance(states, action, observation, self._random)
                best = likelihood.max()
                if best > 0:
                    weights = weights * np.where(likelihood < 0, 0.0, np.maximum(likelihood, doubt * best))
                else:  # seen by no particle: if that is forgiven, the observation teaches nothing
                    weights = weights * (likelihood >= 0) * (doubt > 0)
                if not weights.sum() > 0:
                    return None
                weights /= weights.sum()
                if 1.0 / (weights**2).sum() < 0.5 * count:
                    drawn = draw_particles(count, count, weights, self._random)
                    states, weights = states[drawn], np.full(count, 1 / count)
        if not best > 0:
            return None
        self._history.mend(starts)
        return states[draw_particles(self.options.count, count, weights, self._random)]

    def _fallen_back(self, action: int, observation: Any) -> tuple[NDArray[Any], str]:
        """(states of the fallback, what to say about them)."""
        count = self.options.count
        if self.fallback is not None:
            given = self.fallback(action, observation, count, self._random)
            return self._dynamics.draw(given, count, self._random), "; the given fallback is believed"
        states = self._dynamics.draw(self.prior, count, self._random)
        after, likelihood = self._dynamics.advance(states, action, observation, self._random)
        weights = np.maximum(likelihood, 0.0)
        if weights.sum() > 0:
            return after[
                draw_particles(count, count, weights, self._random)
            ], "; the prior, led through it, is believed"
        return states, "; the prior does not explain it either and is believed as it was"
