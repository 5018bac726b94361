"""A solved TAB-Field and the questions it answers."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tab_marl.field import kernels
from tab_marl.field.answers.evidence import Observation
from tab_marl.field.answers.paths import MostLikelyPath, most_likely_path, path_entropy
from tab_marl.field.answers.posterior import Posterior, posterior
from tab_marl.field.belief import EXACT, BeliefOptions, ProductBelief
from tab_marl.field.chain import ProductChain, Table
from tab_marl.field.constraints.events import Completes, Event
from tab_marl.field.constraints.tilt import Tilt
from tab_marl.field.constraints.tracking import HAPPENED, track
from tab_marl.field.messages.sweep import Sweep, moments, sweep
from tab_marl.field.messages.tables import zeros
from tab_marl.field.sampling import Trajectories, sample_paths

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.figure import Figure

    from tab_marl.field.constraints.report import FitReport
    from tab_marl.field.problem import FieldProblem

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TabField:
    """The maximum-entropy distribution over trajectories that complete the mission: a Markov chain on (q, s)."""

    problem: FieldProblem
    bridge: ProductChain
    """The field's own law: P*(s'|s, q) = Q(s'|s) w h[q', s'] / h[q, s] (design, section 4)."""
    tilt: Tilt
    """The weights of the constraints beyond the mission."""
    fitted_transitions: Floats | None
    """``[Q, L]`` expected transitions, where the fit computed them."""
    marginal_error: float
    """Largest relative error of a constrained expectation; 0 if there was nothing to fit."""
    rounds: int
    """Backward passes made."""
    report: FitReport | None = None
    """How well soft constraints hold; None without any."""

    @property
    def chain(self) -> ProductChain:
        """What a planner filters and samples."""
        return self.bridge

    @property
    def backward(self) -> tuple[Table, Floats]:
        """(value ``[Q, S]``, log_scale ``[Q]``): h = value * exp(log_scale)."""
        return self.bridge.value, self.bridge.log_scale - np.log(float(self.bridge.value[self.bridge.accepting, 0]))

    @cached_property
    def log_partition(self) -> float:
        """sum over s0 of mu0(s0) log Z(s0), Z the tilted reference's mass of completing trajectories from s0.

        With the mission alone, the mean log-probability that the reference process completes it.
        """
        log_z = start_log_partition(self.bridge)
        used = self.bridge.start > 0
        return float(self.bridge.start[used] @ log_z[used])

    @cached_property
    def transitions(self) -> Floats:
        """``[Q, L]``: how often each transition of the automaton is taken, in expectation, until the mission ends."""
        if self.fitted_transitions is not None:
            return self.fitted_transitions
        return expected_transitions(self.bridge, self.problem.automaton.rank)

    @cached_property
    def kl_to_reference(self) -> float:
        """KL(P || Q) in nats over trajectories up to completion or failure, Q started from the same cells."""
        weights = self.tilt.log_weight()
        flux = self.transitions
        used = flux > 0
        tilted = float((flux[used] * weights[used]).sum())
        if np.isfinite(self.tilt.log_failure):
            tilted += self.tilt.log_failure * (1.0 - self.completes)
        return tilted - self.log_partition

    @property
    def completes(self) -> float:
        """Probability that the mission is ever completed: 1, or the c asked for."""
        return self.tilt.completed(self.transitions)

    @cached_property
    def branch_visits(self) -> dict[str, float]:
        """Place -> expected number of counted visits."""
        visits = self.tilt.visits(self.transitions)
        names = self.problem.branch_places or tuple(str(b) for b in range(len(visits)))
        return {names[b]: float(visits[b]) for b in range(len(visits))}

    @cached_property
    def branch_shares(self) -> dict[str, float]:
        """Place -> share of all counted visits at places that can stand for one another (1 where nothing can)."""
        from tab_marl.field.constraints.goals import alternatives

        visits = self.tilt.visits(self.transitions)
        total = visits.copy()
        for group in alternatives(self.problem):
            total[group] = visits[group].sum()
        names = list(self.branch_visits)
        return {name: float(v / t) if t > 0 else 0.0 for name, v, t in zip(names, visits, total, strict=True)}

    @cached_property
    def _sweep(self) -> Sweep:
        return sweep(self.problem, self.bridge, self._exactness)

    @property
    def _exactness(self) -> BeliefOptions:
        """Small masses are dropped where single precision blurs them anyway."""
        return EXACT if self.problem.options.precision == "double" else BeliefOptions()

    @property
    def occupancy_by_status(self) -> Floats:
        """``[T + 1, 2, C]``: probability of each cell at each tick with the mission not complete (0) or complete (1)."""
        return self._sweep.by_status

    @cached_property
    def occupancy(self) -> Floats:
        """``[T + 1, C]``: probability of each cell at each tick; after completion the reference process goes on."""
        return self.occupancy_by_status.sum(axis=1)

    @property
    def automaton_occupancy(self) -> Floats:
        """``[T + 1, Q]``: probability of each automaton state at each tick."""
        return self._sweep.automaton

    def occupancy_by_state(self, tick: int) -> tuple[NDArray[np.int32], Floats]:
        """(``[n]`` automaton states with mass at this tick, ``[n, C]`` probability of each with each cell)."""
        if not 0 <= tick <= self.problem.horizon:
            raise ValueError(f"tick is {tick}, must lie in 0..{self.problem.horizon}, the field's horizon")
        (moment,) = deque(moments(self.bridge, tick, self._exactness), maxlen=1)
        by_cell = moment.masses.reshape(len(moment.masses), self.bridge.cells, -1).sum(axis=2)
        return moment.automaton_states, by_cell

    @cached_property
    def completion_probability(self) -> Floats:
        """``[T + 1]``: probability that the mission is complete by each tick."""
        return self.occupancy_by_status[:, 1].sum(axis=1)

    @property
    def stage_times(self) -> dict[str, Floats]:
        """Stage -> ``[T + 1]`` probability that it is completed at exactly that tick. A stage is one counted visit."""
        return dict(zip(self.problem.stage_names, self._sweep.stage_done, strict=True))

    @cached_property
    def path_entropy(self) -> float:
        """Entropy in nats of the trajectory (start, cells, modes) up to the tick at which the mission ends."""
        visits, _ = expected_visits(self.bridge, self.problem.automaton.rank)
        return path_entropy(self, visits)

    def most_likely_path(self, completing: bool = True) -> MostLikelyPath:
        """The trajectory of largest probability, up to the mission's end; by default among those that complete it."""
        return most_likely_path(self, completing)

    def track(self, *events: Event) -> TabField:
        """The same law, on an automaton that also watches these events (see `event_probabilities`)."""
        tracked = track(self.problem, events)
        tracking = tracked.tracking
        assert tracking is not None
        weight = self.tilt.log_weight()[tracking.parent_state][:, tracking.parent_symbol]
        return self._lifted(tracked, weight)

    def _lifted(self, problem: FieldProblem, log_weight: Floats) -> TabField:
        from tab_marl.field.sizing import refuse_beyond_memory
        from tab_marl.field.solve import message

        refuse_beyond_memory(problem)
        tilt = Tilt.given(problem, log_weight, self.tilt.log_failure)
        return TabField(problem, message(problem, tilt), tilt, None, self.marginal_error, self.rounds, self.report)

    @property
    def event_probabilities(self) -> tuple[float, ...]:
        """Of the events that the field's automaton watches: those of soft constraints, then those of `track`."""
        tracking = self.problem.tracking
        if tracking is None:
            return ()
        return tuple(float(self.transitions[happens].sum()) for happens in tracking.happens)

    def probability(self, event: Event) -> float:
        """Of an event: ``field.probability(Passes("Checkpoint B"))``."""
        if isinstance(event, Completes) and event.mission is None:
            return self.completes
        return self.track(event).event_probabilities[-1]

    def given_latest_event(self) -> TabField:
        """The law given that the event tracked last happens. Raises InfeasibleField if it cannot."""
        tracking, automaton = self.problem.tracking, self.problem.automaton
        if tracking is None:
            raise ValueError("no event is tracked: use field.track(event).given_latest_event()")
        ending = np.isin(automaton.delta, [automaton.accepting, automaton.rejecting])
        ending[[automaton.accepting, automaton.rejecting]] = False
        happened = (tracking.decided[-1] == HAPPENED)[:, None] | tracking.happens[-1]
        given = self._lifted(self.problem, np.where(ending & ~happened, -np.inf, self.tilt.log_weight()))
        # P(s0) is bound no longer: starts from which the event is likelier gain.
        used = given.bridge.start > 0
        gain = start_log_partition(given.bridge)[used] - start_log_partition(self.bridge)[used]
        start = np.zeros(self.bridge.cells)
        start[used] = self.bridge.start[used] * np.exp(gain)
        return replace(given, bridge=given.bridge._replace(start=start / start.sum()))

    def condition(self, *observations: Observation, options: BeliefOptions | None = None) -> Posterior:
        """What the field says given sightings and non-sightings at any ticks (filter and smoother).

        Raises ImpossibleEvidence where an observation has probability 0; warns NearZeroEvidence where it nearly has.
        """
        return posterior(self, observations, self._exactness if options is None else options)

    def save(self, path: str | Path) -> None:
        """Write it to one ``.npz`` file: arrays and JSON, no code. `TabField.load` reads it back."""
        from tab_marl.field.answers.storage import save_field

        save_field(self, path)

    @classmethod
    def load(cls, path: str | Path) -> TabField:
        """Read what `save` wrote; nothing in the file is executed. Raises FieldFormatError, OSError."""
        from tab_marl.field.answers.storage import load_field

        return load_field(path)

    def belief(self) -> ProductBelief:
        """A fresh filter at tick 0."""
        if self.problem.options.kernel == "marginal":
            from tab_marl.field.marginal import MarginalBelief

            return MarginalBelief(self)
        return ProductBelief(self.chain)

    def sample(self, rng: np.random.Generator, count: int, ticks: int | None = None) -> Trajectories:
        """Draw trajectories from the start."""
        return sample_paths(self.chain, self.belief(), rng, count, self.problem.horizon if ticks is None else ticks)

    def plot(self, path: str | Path | None = None, panels: int = 8) -> Figure:
        """Small multiples of the occupancy over time, the likeliest and sampled paths, and when the stages are completed.

        Written to `path` if given. Needs matplotlib; more pictures: `tab_marl.field.answers.drawing`.
        """
        from tab_marl.field.answers.drawing import draw_field

        return draw_field(self, path, panels)

    def animate(self, path: str | Path, frames_per_second: int = 8) -> int:
        """The occupancy over time as a .gif, or .mp4 where ffmpeg is installed; returns the number of frames."""
        from tab_marl.field.answers.animation import animate_field

        return animate_field(self, path, frames_per_second)


def start_log_partition(chain: ProductChain) -> Floats:
    """``[C]``: log Z(s0) of each start cell, -inf elsewhere: the tilted reference's mass of completions from there."""
    out = np.full(chain.cells, -np.inf)
    first = chain.delta[chain.initial, chain.labels]
    table = chain.value.reshape(len(chain.value), chain.cells, chain.modes)
    peak = float(chain.value[chain.accepting, 0])
    for cell in np.flatnonzero(chain.start > 0):
        total = float(table[first[cell], cell].astype(np.float64) @ chain.first_mode_shares)
        factor = chain.factor[chain.initial, chain.labels[cell]]
        if total > 0 and factor > 0:
            out[cell] = np.log(total) - np.log(peak) + np.log(factor) + chain.log_scale[chain.initial]
    return out


def expected_transitions(chain: ProductChain, rank: NDArray[np.int32]) -> Floats:
    """``[Q, L]``: expected number of times each transition is taken until acceptance or rejection (forward pass).

    `rank` ``[Q]`` rises along transitions between transient states, so each of them is visited at most once.
    """
    flux, belief, order = _forward_start(chain, rank)
    kernels.forward_flux(order, chain, belief.automaton_states, belief.masses, flux)
    return flux


def expected_visits(chain: ProductChain, rank: NDArray[np.int32]) -> tuple[Table, Floats]:
    """(``[Q, S]`` probability of ever visiting each transient state, ``[Q, L]`` of ever taking each transition)."""
    flux, belief, order = _forward_start(chain, rank)
    mass = zeros(chain.value.shape, chain.value.dtype)
    mass[belief.automaton_states] = belief.masses
    slot = np.arange(len(chain.delta))
    slot[[chain.accepting, chain.rejecting]] = -1
    kernels.forward(order, chain, slot, mass, flux)
    return mass, flux


def _forward_start(chain: ProductChain, rank: NDArray[np.int32]) -> tuple[Floats, ProductBelief, NDArray[np.int32]]:
    """The transitions read at tick 0, the law there, and the transient states by rising rank."""
    count, symbols = chain.delta.shape
    belief = ProductBelief(chain, EXACT)
    flux = np.zeros((count, symbols))
    flux[chain.initial] = np.bincount(chain.labels, belief.cell_marginal(), minlength=symbols)
    order = np.argsort(rank, kind="stable").astype(np.int32)
    return flux, belief, order[~np.isin(order, [chain.initial, chain.accepting, chain.rejecting])]
