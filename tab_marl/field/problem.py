"""What a TAB-Field is solved for: a reference process, a mission automaton, labels, a start and constraints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from tab_marl.field import processes
from tab_marl.field.chain import check_nonnegative
from tab_marl.field.reference import Reference, from_matrices
from tab_marl.field.stages import stages_of
from tab_marl.world.grid import GridMap
from tab_marl.world.scenario import Scenario, UnknownName
from tab_marl.world.volume import Volume
from tab_marl.world.voxels import VoxelMap

if TYPE_CHECKING:
    from tab_marl.field.events import SoftConstraint, TimingPrior
    from tab_marl.field.tracking import Tracking
    from tab_marl.mission.automaton import MissionAutomaton
    from tab_marl.mission.model import Mission
    from tab_marl.mission.unroll import TickAutomaton

Transitions = Reference | sparse.sparray | sparse.spmatrix | NDArray[np.float64] | Sequence[object]

CELL_SIZES_METRES = (0.05, 0.1)
"""Tried in this order when `FieldOptions.cell_metres` is None."""
UNDER_WAY, COMPLETE, FAILED = 0, 1, 2
"""How a mission stands: values of `FieldProblem.status`."""
ROUGH_CELL_METRES = 0.15
ROUGH_FROM = 1_500_000
"""Automaton states x base states from which a first fit on rough cells saves time."""


@dataclass(frozen=True)
class FieldOptions:
    """How motion is modelled and which constraints beyond the mission hold."""

    reference: Literal["run_and_tumble", "walk", "paper_walk"] = "run_and_tumble"
    """`walk`: memoryless, displacements up to full speed. `paper_walk`: memoryless, all cells within one tick's reach."""
    cell_metres: float | None = None
    """None: the finest of CELL_SIZES_METRES within `state_budget`."""
    headings: int = 16
    """Directions of run-and-tumble; halved when even the coarsest cells exceed the budget."""
    mean_run_metres: float = 1.0
    goal_marginals: bool = True
    """Where several places can serve, each is visited equally often."""
    timing_prior: bool = False
    """The completion tick is uniform over the feasible ticks."""
    completion_probability: float = 1.0
    """c of the paper's eq. 1: how likely the adversary completes its mission; below 1 it may fail."""
    kernel: Literal["bridge", "marginal"] = "bridge"
    """`bridge`: the field's own transition law. `marginal`: each next state is drawn from the field's marginal at that
    tick, whatever the present state (the letter of the paper); such trajectories jump."""
    precision: Literal["single", "double"] = "single"
    """Of the stored messages; the work is always done in double precision."""
    state_budget: int = 8_000_000
    """Automaton states x cells x modes up to which finer cells are preferred."""
    marginal_tolerance: float = 0.05
    """Relative error at which goal marginals, timing priors and completion probability are met."""
    constraint_tolerance: float = 1e-4
    """Error of a probability at which a soft constraint is met."""
    max_iterations: int = 60
    """Of the fit of their weights."""
    least_share: float = 1e-9
    """A place or tick that the reference reaches less often than this share is not feasible and gets no equal share."""

    def __post_init__(self) -> None:
        for name, known in (
            ("reference", ("run_and_tumble", "walk", "paper_walk")),
            ("kernel", ("bridge", "marginal")),
            ("precision", ("single", "double")),
        ):
            if getattr(self, name) not in known:
                raise UnknownName(f"FieldOptions.{name}", str(getattr(self, name)), known)
        for name in ("cell_metres", "mean_run_metres", "marginal_tolerance", "constraint_tolerance", "state_budget"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"FieldOptions.{name} is {value}, must be > 0")
        if not 0 < self.completion_probability <= 1:
            raise ValueError(
                f"FieldOptions.completion_probability is {self.completion_probability}, must lie in (0, 1]"
            )
        if self.headings < 4:
            raise ValueError(f"FieldOptions.headings is {self.headings}, must be >= 4")
        if self.max_iterations < 1:
            raise ValueError(f"FieldOptions.max_iterations is {self.max_iterations}, must be >= 1")

    @classmethod
    def preset(cls, name: str) -> FieldOptions:
        """`default`, or `paper`: the literal field (memoryless, the mission alone) with displacements repaired."""
        presets = {"default": cls(), "paper": cls(reference="walk", goal_marginals=False)}
        if name not in presets:
            raise UnknownName("field preset", name, presets)
        return presets[name]


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
    start: ArrayLike
    """``[C]`` distribution of the first cell."""
    horizon: int
    """Ticks shown by `TabField.occupancy` and sampled by default."""
    options: FieldOptions = field(default_factory=lambda: FieldOptions(precision="double", marginal_tolerance=1e-10, constraint_tolerance=1e-10)
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
        states, symbols = self.automaton.delta.shape
        if labels.min() < 0 or labels.max() >= symbols:
            raise ValueError(
                f"FieldProblem.labels lie in {labels.min()}..{labels.max()}, must lie in 0..{symbols - 1}: "
                "they index the automaton's symbols (TickAutomaton.symbols gives them)"
            )
        start = np.ascontiguousarray(self.start, dtype=np.float64)
        check_nonnegative("FieldProblem.start", start, (cells,))
        if abs(start.sum() - 1) > 1e-9:
            raise ValueError(f"FieldProblem.start sums to {start.sum():.12g}, must sum to 1")
        if self.horizon < 0:
            raise ValueError(f"FieldProblem.horizon is {self.horizon}, must be >= 0 ticks")
        which = np.zeros(states, dtype=np.int32) if self.reference_of is None else np.asarray(self.reference_of)
        if which.shape != (states,) or which.min() < 0 or which.max() >= motion.count:
            raise ValueError(f"FieldProblem.reference_of must be [{states}] with entries in 0..{motion.count - 1}")
        transient = np.ones(states, dtype=bool)
        transient[[self.automaton.accepting, self.automaton.rejecting]] = False
        following = self.automaton.delta
        rank = self.automaton.rank
        backwards = transient[:, None] & transient[following] & (rank[following] <= rank[:, None])
        if backwards.any():
            q, symbol = np.argwhere(backwards)[0]
            raise ValueError(
                f"FieldProblem.automaton is not acyclic: state {q} (rank {rank[q]}) leads to {following[q, symbol]} "
                f"(rank {rank[following[q, symbol]]}); unroll its clocks first"
            )
        object.__setattr__(self, "labels", labels)
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "reference_of", which.astype(np.int32))
        standing = np.full(states, UNDER_WAY, dtype=np.int8)
        standing[self.automaton.accepting], standing[self.automaton.rejecting] = COMPLETE, FAILED
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
        from tab_marl.field.stages import earliest_of_stage

        return earliest_of_stage(self.mission, self.scenario, self.grid, stage)

    def constrained(self, *constraints: SoftConstraint | TimingPrior) -> FieldProblem:
        """The same problem with these constraints beside those it has.

        The automaton grows by what the events need to be watched. Raises ValueError for an event that cannot be.
        """
        from tab_marl.field.tracking import with_constraints

        return with_constraints(self, constraints)

    @classmethod
    def from_mission(
        cls,
        mission: Mission | str,
        scenario: Scenario | Volume,
        options: FieldOptions | None = None,
        horizon_ticks: int | None = None,
        constraints: Sequence[SoftConstraint | TimingPrior] = (),
    ) -> FieldProblem:
        """The field of a mission (or its English text) in a scenario, under soft constraints beside it.

        The start is uniform over the free cells in `scenario.adversary_start` (the nearest free cell if there is none).
        """
        from tab_marl.mission.compile import compile_mission
        from tab_marl.mission.unroll import unroll

        if isinstance(mission, str):
            from tab_marl.mission.parse import parse_mission

            mission = parse_mission(mission, scenario)
        options = options or FieldOptions()
        horizon = scenario.horizon_ticks if horizon_ticks is None else horizon_ticks
        compiled = compile_mission(mission, scenario, scenario.step_seconds)
        tumbling = options.reference == "run_and_tumble"
        sizes = CELL_SIZES_METRES if options.cell_metres is None else (options.cell_metres,)
        for size in sizes:
            grid = map_of(scenario, size)
            automaton = unroll(compiled, horizon, compiled.masks(grid.centres))
            entries = len(automaton.delta) * grid.cells
            if entries * (options.headings + 1 if tumbling else 1) <= options.state_budget:
                break
        while options.cell_metres is None and tumbling and options.headings >= 16:
            if entries * (options.headings + 1) <= options.state_budget:
                break
            options = replace(options, headings=options.headings // 2)
        problem = cls._on_grid(compiled, grid, automaton, scenario, options, horizon)
        worth_it = entries * (options.headings + 1) > ROUGH_FROM and grid.cell_metres < ROUGH_CELL_METRES
        if worth_it and tumbling and options.goal_marginals and len(compiled.branch_places) > 1:
            rough = map_of(scenario, ROUGH_CELL_METRES)
            automaton = unroll(compiled, horizon, compiled.masks(rough.centres))
            coarse = replace(options, headings=8)
            problem = replace(problem, rough=cls._on_grid(compiled, rough, automaton, scenario, coarse, horizon))
        problem = replace(problem, mission=mission)
        return problem.constrained(*constraints) if constraints else problem

    @classmethod
    def _on_grid(
        cls,
        compiled: MissionAutomaton,
        grid: GridMap | VoxelMap,
        automaton: TickAutomaton,
        scenario: Scenario | Volume,
        options: FieldOptions,
        horizon: int,
    ) -> FieldProblem:
        motion, which = _motion(grid, scenario, options, automaton.speed_limit)
        return cls(
            motion,
            automaton.symbols(compiled.masks(grid.centres)),
            automaton,
            start_cells(grid, scenario),
            horizon,
            options,
            which,
            grid,
            scenario,
            tuple(compiled.branch_places),
            earliest_tick(compiled, grid, scenario) if options.timing_prior else 0,
            None,
            *stages_of(compiled, automaton),
        )


def _motion(
    grid: GridMap | VoxelMap, scenario: Scenario | Volume, options: FieldOptions, speed_limit: NDArray[np.float64]
) -> tuple[Reference, NDArray[np.int32]]:
    """One reference per speed limit in force somewhere, the fastest first, and which one holds in each state."""
    top = scenario.adversary.max_speed
    capped = np.minimum(speed_limit, top)
    speeds = np.append(top, np.unique(capped[capped < top])[::-1])
    which = np.searchsorted(-speeds, -capped).astype(np.int32)
    steps = speeds * scenario.step_seconds
    if options.reference == "run_and_tumble":
        return processes.run_and_tumble(grid, steps, options.headings, options.mean_run_metres), which
    build = processes.walk if options.reference == "walk" else processes.paper_walk
    return build(grid, steps), which


def map_of(world: Scenario | Volume, cell_metres: float) -> GridMap | VoxelMap:
    """The world cut into cells."""
    if isinstance(world, Volume):
        return VoxelMap.from_volume(world, cell_metres)
    return GridMap.from_scenario(world, cell_metres)


def start_cells(grid: GridMap | VoxelMap, scenario: Scenario | Volume) -> NDArray[np.float64]:
    """``[C]``: uniform over the free cells whose centres lie in the adversary's start region."""
    region = scenario.adversary_start
    inside = np.asarray(region.contains(grid.centres))
    if not inside.any():
        inside[grid.cells_of([region.centre])] = True
    return np.asarray(inside / inside.sum())


def earliest_tick(
    compiled: MissionAutomaton, grid: GridMap | VoxelMap, scenario: Scenario | Volume
) -> NDArray[np.int64]:
    """``[C]``: the first tick at which the shortest path at full speed from each start cell completes the mission."""
    from tab_marl.mission.route import solve_route

    inside = np.flatnonzero(start_cells(grid, scenario))
    route = solve_route(compiled, grid)
    earliest = np.zeros(grid.cells, dtype=np.int64)
    for cell, mask in zip(inside, compiled.masks(grid.centres[inside]), strict=True):
        location = compiled.first(int(mask)).location
        metres = float(route.length[location, cell]) if location >= 0 else 0.0
        if math.isfinite(metres):
            ticks = metres / (scenario.adversary.max_speed * scenario.step_seconds)
            earliest[cell] = math.ceil(ticks - 1e-9)
    return earliest
