"""DESPOT: search over scenarios with bounds (Somani et al., NeurIPS 2013; Ye et al., JAIR 58, 2017), for any generative model.

A scenario is a start state and a stream of random numbers, so that a model's step becomes a function; K of them stand for the
belief. The tree holds, for every history that some scenario meets, a lower bound (what the default policy earns there, or what
was found better) and an upper bound; trials go where they are furthest apart. ``Despot(model, DespotOptions(...)).plan(belief,
rng)`` returns the same `Plan` as `tab_marl.planning.search.pomcp.Pomcp`.

The default policy is the model's ``rollout`` (it must go by the history alone), or uniformly random actions. The upper bound is
the model's ``upper``, which may hold for one discount only, or the greatest reward at every step, from ``reward_bounds``.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any, Literal

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.planning.model import (
    CompiledModel,
    belief_states,
    check_model,
    check_numbered,
    draw_particles,
    warn_of_plain_python,
)
from tab_marl.planning.search import despot_kernels as kernels
from tab_marl.planning.search.bounds import Depths, check_horizon, check_kinds, require
from tab_marl.planning.search.despot_interpreted import search_in_python
from tab_marl.planning.search.despot_rewards import check_met, check_promises, trivial_rewards
from tab_marl.planning.search.growing import Chunks, grown, table_size
from tab_marl.planning.search.kernels import UNEXPANDED
from tab_marl.planning.search.plan import Plan, Search, Stopped, action_numbers, decided
from tab_marl.planning.search.tree import EDGE, NODE, ROOT, SearchTree

_FIRST_EXPANSIONS = 8
"""Room allocated at first, in expansions of the root."""

DESPOT_NODE = np.dtype(
    [
        ("observation", np.int64),
        ("lower", np.float64),  # totals: see despot_kernels
        ("upper", np.float64),
        ("raw", np.float64),  # upper bound of the return, not counting the penalty
        ("default", np.float64),  # the default policy's return
        ("first_row", np.int64),
        ("scenarios", np.int32),
        ("filled", np.int32),
        ("depth", np.int32),
        ("edge", np.int32),
        ("sibling", np.int32),
        ("first_edge", np.int32),
        ("edge_count", np.int32),
    ]
)
DESPOT_EDGE = np.dtype(
    [("reward", np.float64), ("lower", np.float64), ("upper", np.float64), ("child", np.int64)]  # totals
)


@dataclass(frozen=True)
class DespotOptions(Depths):
    """How to search. Raises ValueError naming the field, its value and its bounds."""

    scenarios: int = 500
    """K: more stand for the belief better; time per expansion grows with K."""
    trials: int = 10_000
    """The most trials a plan (each goes from the root to where the bounds are close enough)."""
    seconds: float | None = None
    """Stop after this long even if trials remain (the clock is read between expansions). The root is expanded in any case."""
    discount: float = 0.95
    """In (0, 1]; 1 needs `max_depth`."""
    max_depth: int | None = None
    """Steps from the root at which a scenario ends; None: where discount^depth falls below 0.01."""
    tree_depth: int | None = None
    """Steps from the root down to which nodes are expanded (the root always is); beyond, the default policy. None: `max_depth`."""
    regularisation: float = 0.0
    """lambda: what a node of the policy costs, in units of return. Keeps the plan from learning the luck of few scenarios."""
    share: float = 0.95
    """xi in [0, 1): each trial aims at bringing the root's gap down to this share of it."""
    gap: float = 1e-3
    """The search is done when the root's bounds are this close."""
    reward_bounds: tuple[float, float] | None = None
    """(least, greatest) reward of a step: trivial bounds. The greatest is needed where the model has no ``upper``. A reward
    outside is an error (one of 0 never is): said at once of tables, after the search of other models."""
    lower: Literal["rollout", "trivial"] = "rollout"
    """The first lower bound: the default policy simulated, or the least reward for ever."""
    max_nodes: int = 1_000_000
    """Nodes at most, and ten times as many scenario rows; a search that might exceed either stops, and its plan is `full`.
    At most ``max_nodes * (76 + 20 A + 10 (8 D + 4))`` bytes, D numbers in a state."""
    compiled: bool = True
    """False: a `CompiledModel` runs interpreted, with the same random numbers and the same tree, for debugging its functions."""

    def __post_init__(self) -> None:
        check_kinds(self)
        require(self.scenarios >= 1, "scenarios", self.scenarios, ">= 1")
        require(self.trials >= 1, "trials", self.trials, ">= 1")
        require(self.seconds is None or self.seconds > 0, "seconds", self.seconds, "> 0")
        check_horizon(self.discount, self.max_depth, self.tree_depth)
        require(
            math.isfinite(self.regularisation) and self.regularisation >= 0,
            "regularisation",
            self.regularisation,
            "finite, >= 0",
        )
        require(0 <= self.share < 1, "share", self.share, "in [0, 1)")
        require(self.gap >= 0, "gap", self.gap, ">= 0")
        require(self.lower in ("rollout", "trivial"), "lower", self.lower, "'rollout' or 'trivial'")
        require(1 <= self.max_nodes <= 2**27, "max_nodes", self.max_nodes, "in [1, 2^27]")
        if self.reward_bounds is not None:
            least, greatest = self.reward_bounds
            require(
                math.isfinite(least) and math.isfinite(greatest) and least <= greatest,
                "reward_bounds",
                self.reward_bounds,
                "finite, (least, greatest)",
            )
        if self.lower == "trivial" and self.reward_bounds is None:
            raise ValueError(
                "lower is 'trivial' and reward_bounds is None: give the (least, greatest) reward of a step"
            )

    @property
    def max_rows(self) -> int:
        """Scenario rows that may be stored."""
        return 10 * self.max_nodes


@dataclass(frozen=True, eq=False)
class Despot:
    """The planner: `model` is a `CompiledModel` or follows `PythonModel`."""

    model: Any
    options: DespotOptions = DespotOptions()

    def __post_init__(self) -> None:
        check_model(self.model)
        check_numbered(self.model)
        options, least = self.options, 1 + self.options.scenarios * self.model.actions
        if options.max_nodes < least:
            raise ValueError(
                f"max_nodes is {options.max_nodes}, must be >= 1 + scenarios * actions = {least} to hold one step"
            )
        if getattr(self.model, "upper", None) is None and options.reward_bounds is None:
            raise ValueError(
                "the model has no upper bound: give it `upper`, or give DespotOptions reward_bounds, the (least, greatest) "
                "reward of a step"
            )
        check_promises(self.model, options)

    def plan(self, belief: Any, rng: np.random.Generator | int, *, allowed: ArrayLike | None = None) -> Plan:
        """Searches from `belief` (states, `Particles`, a filter or a sampler) and returns the plan; `allowed` restricts the root.

        The same seed, model and belief give the identical tree (unless `seconds` ends the search). The tree is made of this
        plan's scenarios; it is not gone on with after a step, where few of them are left.
        """
        generator = np.random.default_rng(rng)
        actions = action_numbers(self.model.actions, allowed)
        started = time.perf_counter()
        compiled = isinstance(self.model, CompiledModel)
        if not compiled:
            warn_of_plain_python(type(self.model))
        if compiled and self.options.compiled and not getattr(numba.config, "DISABLE_JIT", 0):
            search = _search_compiled(self.model, self.options, belief, generator, actions)
        else:
            search = search_in_python(self.model, self.options, belief, generator, actions)
        return decided(search, self.model, "value", time.perf_counter() - started)


def drawn_scenarios(
    count: int, states: int, weights: NDArray[np.float64] | None, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.uint64]]:
    """(which state each scenario starts from ``[K]``, its seed ``[K]``)."""
    return draw_particles(count, states, weights, rng), rng.integers(2**64, size=count, dtype=np.uint64)


def powers_of(options: DespotOptions) -> NDArray[np.float64]:
    """``[horizon + 1]`` discount^depth."""
    powers = np.cumprod([1.0, *[options.discount] * options.horizon])
    return powers.astype(np.float64)


def _search_compiled(
    model: CompiledModel,
    options: DespotOptions,
    belief: Any,
    rng: np.random.Generator,
    root_actions: NDArray[np.int64],
) -> Search:
    states, weights = belief_states(model, belief, options.scenarios, rng)
    start, seeds = drawn_scenarios(options.scenarios, len(states), weights, rng)
    began = time.perf_counter()
    step, rollout, _ = model.functions
    total, actions, horizon = options.scenarios, model.actions, options.horizon
    least, greatest = trivial_rewards(model, options)
    node_cap, row_cap = options.max_nodes, max(options.max_rows, total * (actions + 1))
    room = total * actions
    nodes = np.empty(min(node_cap, 1 + _FIRST_EXPANSIONS * room), dtype=DESPOT_NODE)
    edges = np.empty(actions * len(nodes), dtype=DESPOT_EDGE)
    edge_actions = np.empty(len(edges), dtype=np.int32)
    row_states = np.empty((min(row_cap, total + _FIRST_EXPANSIONS * room), model.state_size))
    row_scenarios = np.empty(len(row_states), dtype=np.int32)
    row_states[:total], row_scenarios[:total] = states[start], np.arange(total)
    used = np.zeros(9, dtype=np.int64)
    used[kernels.ROWS], used[kernels.GREW] = total, 1
    met, path = np.array([math.inf, -math.inf]), np.zeros(horizon + 1, dtype=np.int64)
    slots = np.empty(table_size(total), dtype=np.int32)
    moved, moved_to = np.empty((total, model.state_size)), np.empty((total, 2), dtype=np.int32)
    stream, model_stream, state = np.zeros(1, np.uint64), np.zeros(1, np.uint64), np.empty(model.state_size)
    trivial, upper, powers = options.lower == "trivial", model.upper_function, powers_of(options)

    def bound_root(scenarios: int) -> None:
        nodes["first_row"][ROOT], nodes["scenarios"][ROOT] = 0, scenarios
        kernels.bound_node(
            step, rollout, upper, trivial, least, greatest, model.data, seeds, 0, -1, actions, horizon, options.discount,
            powers, options.regularisation, nodes, row_states, row_scenarios, used, met, stream, model_stream, state,
        )  # fmt: skip

    def run(trials: int, expansions: int) -> int:
        result: int = kernels.search(
            step, rollout, upper, trivial, least, greatest, model.data, seeds, root_actions, actions, horizon,
            options.deepest_node, options.discount, powers, options.regularisation, options.share, options.gap,
            trials, expansions, nodes, edges, edge_actions, row_states, row_scenarios, used, met, path, slots, moved,
            moved_to, stream, model_stream, state,
        )  # fmt: skip
        return result

    kernels.add_node(nodes, used, 0, -1, 0, -1)
    bound_root(0)  # of nothing, as is the next line: both compile, or load, before the clock runs
    run(0, 0)
    compiling = time.perf_counter() - began
    bound_root(total)
    run(1, 1)  # the root, whatever the time
    chunks = Chunks(None if options.seconds is None else time.perf_counter() + options.seconds, 1)
    stopped: Stopped = "simulations"
    while True:
        before, at = int(used[kernels.EXPANSIONS]), time.perf_counter()
        outcome = run(options.trials, chunks.within(1 << 40))
        if outcome == kernels.NO_ROOM:
            if not _can_grow(nodes, row_states, used, node_cap, row_cap, room):
                stopped = "full"
                break
            nodes = grown(nodes, min(node_cap, 2 * len(nodes)))
            edges = grown(edges, actions * len(nodes))
            edge_actions = grown(edge_actions, len(edges))
            row_states = grown(row_states, min(row_cap, 2 * len(row_states)))
            row_scenarios = grown(row_scenarios, len(row_states))
        elif outcome == kernels.CLOSED or used[kernels.TRIALS] >= options.trials:
            stopped = "closed" if outcome == kernels.CLOSED else "simulations"
            break
        if chunks.over(time.perf_counter() - at, max(1, int(used[kernels.EXPANSIONS]) - before)):
            stopped = "seconds"
            break
    check_met(model, options, *met.tolist())
    kernels.back_up_path(nodes, edges, options.regularisation, path, used)
    return finished(
        nodes[: used[kernels.NODES]], edges[: used[kernels.EDGES]], edge_actions[: used[kernels.EDGES]].copy(),
        options, powers, used, stopped, None, compiling,
    )  # fmt: skip


def _can_grow(
    nodes: NDArray[np.void], rows: NDArray[np.float64], used: NDArray[np.int64], node_cap: int, row_cap: int, room: int
) -> bool:
    """Whether doubling helps the expansion that found no room."""
    nodes_left, rows_left = len(nodes) - used[kernels.NODES], len(rows) - used[kernels.ROWS]
    return bool(
        (len(nodes) < node_cap or nodes_left >= room)
        and (len(rows) < row_cap or rows_left >= room)
        and (len(nodes) < node_cap or len(rows) < row_cap)
    )


def finished(
    nodes: NDArray[np.void],
    edges: NDArray[np.void],
    edge_actions: NDArray[np.int32],
    options: DespotOptions,
    powers: NDArray[np.float64],
    used: NDArray[np.int64],
    stopped: Stopped,
    observations: tuple[object, ...] | None,
    compiling: float = 0.0,
) -> Search:
    """The search with returns counted from each node on, in place of totals over the scenarios."""
    held = nodes["scenarios"] / options.scenarios * powers[nodes["depth"]]
    bounds = np.column_stack([nodes["lower"], nodes["upper"]]) / held[:, None]
    plain_nodes, plain_edges = np.empty(len(nodes), dtype=NODE), np.empty(len(edges), dtype=EDGE)
    for name in ("observation", "sibling", "first_edge", "edge_count"):
        plain_nodes[name] = nodes[name]
    plain_nodes["visits"] = nodes["scenarios"]
    order = np.argsort(nodes["first_edge"][nodes["first_edge"] != UNEXPANDED], kind="stable")
    expanded = np.flatnonzero(nodes["first_edge"] != UNEXPANDED)[order]
    parents = np.repeat(expanded, nodes["edge_count"][expanded])
    plain_edges["value"] = edges["lower"] / held[parents]
    plain_edges["visits"] = nodes["scenarios"][parents]
    plain_edges["child"] = edges["child"]
    tree = SearchTree(plain_nodes, plain_edges, edge_actions, observations, bounds)
    return Search(
        tree, int(used[kernels.TRIALS]), int(used[kernels.DEEPEST]), int(used[kernels.STEPS]), stopped,
        stopped == "full", (float(bounds[ROOT, 0]), float(bounds[ROOT, 1])), compiling,
    )  # fmt: skip
