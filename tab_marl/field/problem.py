"""What a TAB-Field is solved for: a reference process, a mission automaton, labels, a start and constraints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from tab_marl.field.chain import check_nonnegative
from tab_marl.field.options import FieldOptions
from tab_marl.field.reference import Reference, from_matrices
from tab_marl.mission.finite import FiniteAutomaton
from tab_marl.world.grid import GridMap
from tab_marl.world.scenario import Scenario
from tab_marl.world.volume import Volume
from tab_marl.world.voxels import VoxelMap

if TYPE_CHECKING:
    from tab_marl.field.constraints.events import SoftConstraint, TimingPrior
    from tab_marl.field.constraints.tracking import Tracking
    from tab_marl.field.from_mission import Process
    from tab_marl.field.sizing import FieldSize
    from tab_marl.mission.model import Mission
    from tab_marl.mission.unroll import TickAutomaton

__all__ = ["COMPLETE", "FAILED", "UNDER_WAY", "FieldOptions", "FieldProblem", "Transitions"]

Transitions = Reference | sparse.sparray | sparse.spmatrix | NDArray[np.float64] | Sequence[object]

UNDER_WAY, COMPLETE, FAILED = 0, 1, 2
"""How a mission stands: values of `FieldProblem.status`."""


@dataclass(frozen=True, eq=False)
class FieldProblem:
    """min KL(P || Q) subject to P(s0) = start, the mission, and the constraints in `options` (paper, eq. 1).

    Raises ValueError when shapes do not fit or something is not a distribution.
    """

    transitions: Transitions
    """The reference process: a `Reference`, or ``[S, S]`` rows >= 0 with sum <= 1 (dense or sparse, one or several)."""
    labels: ArrayLike
    """``[C]`` symbol of each cell, 0..L-1: a column of the automaton's table."""
    automaton: TickAutomaton
    """Acyclic but for its two absorbing states: `unroll` makes one of a mission, `from_arrays` of any automaton."""
    start: ArrayLike
    """``[C]`` distribution of the first cell."""
    horizon: int
    """Ticks shown by `TabField.occupancy` and sampled by default."""
    options: FieldOptions = field(
        default_factory=lambda: FieldOptions(precision="double", marginal_tolerance=1e-10, constraint_tolerance=1e-10)
    )
    reference_of: ArrayLike | None = None
    """``[Q]`` which of several references holds in each automaton state."""
    grid: GridMap | VoxelMap | None = None
    """Where the cells lie; None: one metre apart on a line."""
    scenario: Scenario | Volume | None = None
    branch_places: tuple[str, ...] = ()
    """Names of the automaton's branches, for people."""
    earliest_tick: ArrayLike = 0
    """``[C]`` or one number: no completion before this tick, from this start cell, is feasible for the timing prior."""
    rough: FieldProblem | None = None
    """The same on coarser cells, on which the weights of goal marginals are fitted first; None to do without."""
    stage: ArrayLike | None = None
    """``[Q]`` stages of the mission completed in each automaton state; default: one stage, completed by acceptance."""
    stage_names: tuple[str, ...] = ("mission",)
    status: ArrayLike | None = None
    """``[Q]`` UNDER_WAY, COMPLETE or FAILED: how the mission stands; default: by the absorbing states."""
    mission: Mission | None = None
    constraints: tuple[SoftConstraint | TimingPrior, ...] = ()
    """Set by `constrained`."""
    tracking: Tracking | None = None
    """Which other events the automaton watches; set by `constrained` and `TabField.track`."""

    def __post_init__(self) -> None:
        motion = self.transitions if isinstance(self.transitions, Reference) else from_matrices(self.transitions)
        object.__setattr__(self, "transitions", motion)
        labels = np.ascontiguousarray(self.labels, dtype=np.int32)
        cells = motion.states // motion.modes
        if labels.shape != (cells,):
            raise ValueError(f"FieldProblem.labels has shape {labels.shape}, must be [{cells}], one symbol per cell")
        if self.horizon < 0:
            raise ValueError(f"FieldProblem.horizon is {self.horizon}, must be >= 0 ticks")
        automaton = self.automaton
        states, symbols = automaton.delta.shape
        if labels.min() < 0 or labels.max() >= symbols:
            raise ValueError(
                f"FieldProblem.labels lie in {labels.min()}..{labels.max()}, must lie in 0..{symbols - 1}: "
                "they index the automaton's symbols (TickAutomaton.symbols gives them)"
            )
        start = np.ascontiguousarray(self.start, dtype=np.float64)
        check_nonnegative("FieldProblem.start", start, (cells,))
        if abs(start.sum() - 1) > 1e-9:
            raise ValueError(f"FieldProblem.start sums to {start.sum():.12g}, must sum to 1")
        which = np.zeros(states, dtype=np.int32) if self.reference_of is None else np.asarray(self.reference_of)
        if which.shape != (states,) or which.min() < 0 or which.max() >= motion.count:
            raise ValueError(f"FieldProblem.reference_of must be [{states}] with entries in 0..{motion.count - 1}")
        transient = np.ones(states, dtype=bool)
        transient[[automaton.accepting, automaton.rejecting]] = False
        following = automaton.delta
        rank = automaton.rank
        backwards = transient[:, None] & transient[following] & (rank[following] <= rank[:, None])
        if backwards.any():
            q, symbol = np.argwhere(backwards)[0]
            raise ValueError(
                f"FieldProblem.automaton is not acyclic: state {q} (rank {rank[q]}) leads to {following[q, symbol]} "
                f"(rank {rank[following[q, symbol]]}): unbounded, it would need up to {states} x {self.horizon + 1} ticks = "
                f"{states * (self.horizon + 1):,} states; give it as a FiniteAutomaton to FieldProblem.from_arrays"
            )
        object.__setattr__(self, "labels", labels)
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "reference_of", which.astype(np.int32))
        standing = np.full(states, UNDER_WAY, dtype=np.int8)
        standing[automaton.accepting], standing[automaton.rejecting] = COMPLETE, FAILED
        status = standing if self.status is None else np.asarray(self.status, dtype=np.int8)
        stage = (status == COMPLETE).astype(np.int32) if self.stage is None else np.asarray(self.stage, dtype=np.int32)
        for name, array in (("status", status), ("stage", stage)):
            if array.shape != (states,):
                raise ValueError(f"FieldProblem.{name} has shape {array.shape}, must be [{states}]")
        object.__setattr__(self, "status", status)
        object.__setattr__(self, "stage", stage)

    @property
    def reference(self) -> Reference:
        assert isinstance(self.transitions, Reference)
        return self.transitions

    @property
    def cells(self) -> int:
        """C."""
        return len(np.asarray(self.labels))

    @property
    def step_seconds(self) -> float:
        """One tick; 1 if there is no scenario to say."""
        return 1.0 if self.scenario is None else self.scenario.step_seconds

    def earliest_of_stage(self, stage: int) -> NDArray[np.int64]:
        """``[C]``: no start cell can have completed this stage before this tick (0 where nothing is known)."""
        nothing = np.zeros(self.cells, dtype=np.int64)
        if self.mission is None or self.grid is None or self.scenario is None:
            given = np.broadcast_to(np.asarray(self.earliest_tick, dtype=np.int64), nothing.shape)
            return given if stage == len(self.stage_names) - 1 else nothing
        from tab_marl.field.answers.stages import earliest_of_stage

        return earliest_of_stage(self.mission, self.scenario, self.grid, stage)

    def constrained(self, *constraints: SoftConstraint | TimingPrior) -> FieldProblem:
        """The same problem with these constraints beside those it has.

        The automaton grows by what the events need to be watched. Raises ValueError for an event that cannot be.
        """
        from tab_marl.field.constraints.tracking import with_constraints

        return with_constraints(self, constraints)

    @classmethod
    def from_arrays(
        cls,
        transitions: Transitions,
        labels: ArrayLike,
        automaton: FiniteAutomaton | TickAutomaton,
        start: ArrayLike,
        horizon: int,
        options: FieldOptions | None = None,
        *,
        reference_of: ArrayLike | None = None,
        branch_places: Sequence[str] = (),
        grid: GridMap | VoxelMap | None = None,
    ) -> FieldProblem:
        """A field of any Markov chain and any deterministic finite automaton, which may have cycles.

        Args:
            transitions: ``[S, S]`` rows >= 0 with sum <= 1, dense or SciPy sparse, one or several; or a `Reference`.
            labels: ``[C]`` what the automaton reads in each cell, at every tick from 0.
            automaton: cycles are unrolled over the horizon; states that no word of these labels reaches, and those
                from which it cannot be completed in time, are pruned.
            start: ``[C]`` distribution of the first cell.
            horizon: the last tick at which the automaton may accept.
            options: default: nothing beyond the automaton, double precision.
            reference_of: ``[Q]`` which of several references holds in each state of the automaton as given.
            branch_places: names of the automaton's branches.
            grid: where the cells lie.
        Raises:
            ValueError: shapes do not fit, something is not a distribution, or the automaton is too large to unroll.
        """
        which = reference_of
        if isinstance(automaton, FiniteAutomaton):
            finite = automaton
            cells, first = np.asarray(labels, dtype=np.int32), np.asarray(start, dtype=np.float64)
            fits = cells.ndim == 1 and first.shape == cells.shape and (first > 0).any()  # else refused below
            automaton = finite.unrolled(horizon, cells, cells[first > 0] if fits else None)
            which = None if which is None else finite.of_states(which, automaton.location, "reference_of")
        settings: dict[str, Any] = {} if options is None else {"options": options}
        return cls(
            transitions, labels, automaton, start, horizon,
            reference_of=which, grid=grid, branch_places=tuple(branch_places), **settings,
        )  # fmt: skip

    @classmethod
    def from_mission(
        cls,
        mission: Mission | str | Sequence[Mission | str],
        scenario: Scenario | Volume,
        options: FieldOptions | None = None,
        horizon_ticks: int | None = None,
        constraints: Sequence[SoftConstraint | TimingPrior] = (),
        process: Process | None = None,
    ) -> FieldProblem:
        """The field of a mission (or its English text) in a scenario, under soft constraints beside it.

        The start is uniform over the free cells in `scenario.adversary_start` (the nearest free cell if there is none).

        Args:
            mission: several are all to be completed (their conjunction).
            process: builds the reference on the map, in place of `options.reference`.
        """
        from tab_marl.field.from_mission import problem_of

        problem = problem_of(mission, scenario, options or FieldOptions(), horizon_ticks, process)
        return problem.constrained(*constraints) if constraints else problem

    def size(self) -> FieldSize:
        """What solving takes, known before it starts: states, bytes, and seconds at a rate measured on this problem."""
        from tab_marl.field.sizing import size_of

        return size_of(self)

    def pruned(self) -> FieldProblem:
        """The same problem without automaton states that no feasible motion from the start visits on a way to completion.

        Exact for the field. A filter that sees the adversary do what the reference cannot has no state left for it.
        """
        from tab_marl.field.messages.pruning import pruned

        return pruned(self)
