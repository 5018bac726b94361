"""A picture of a plan's tree. The only file of the planner that imports matplotlib."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from tab_marl.planning.search.explanation import NameOf, brief
from tab_marl.planning.search.tree import ROOT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tab_marl.planning.search.plan import Plan

INK, SOFT, BEST, ACTION, HISTORY = "#1b1b1b", "#9aa1ab", "#c8553d", "#eef1f5", "#ffffff"


@dataclass
class _Box:
    """A node of the picture: the root, an action, or what was seen after it."""

    label: str
    share: float
    """Of the root's visits that came through."""
    best: bool
    """Whether it lies on the most likely line."""
    action: bool
    children: list[_Box] = field(default_factory=list)
    row: float = 0.0


def draw_plan(
    plan: Plan,
    path: str | Path | None = None,
    *,
    steps: int = 2,
    actions: int = 4,
    observations: int = 3,
    least_share: float = 0.02,
    name_of: NameOf = brief,
) -> Figure:
    """The plan's tree from left to right, `steps` actions deep; written to `path` (.svg, .png, .pdf) if given.

    Of every node the `actions` most visited actions are drawn, of every action the `observations` commonest, of both only those
    that `least_share` of all simulations went through (the best action always); what is left out is counted. Boxes are actions with their mean return and visits, circles histories that end in the observation named. A line
    is as thick as its share of the simulations; the most likely line is red.
    """
    for name, number in (("steps", steps), ("actions", actions), ("observations", observations)):
        if number < 1:
            raise ValueError(f"{name} is {number}, must be >= 1")
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    total = max(1, int(plan.visits.sum()))
    root = _Box(f"now\n{total:,}", 1.0, True, action=False)
    _grow(plan, root, ROOT, steps, _Limits(actions, observations, least_share * total), name_of)
    rows = _place(root, 0.0)
    columns = _depth(root)
    figure = Figure(figsize=(1.1 + 1.75 * columns, 0.5 + 0.42 * max(rows, 3.0)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    _draw(axes, root, 0)
    axes.set_xlim(-0.35, columns + 0.45)
    axes.set_ylim(rows - 0.3, -0.7)
    axes.set_axis_off()
    if path is not None:
        with mpl.rc_context({"svg.fonttype": "none"}):  # text as text: a tenth of the size, and it can be searched
            figure.savefig(path, dpi=130)
    return figure


@dataclass(frozen=True)
class _Limits:
    actions: int
    observations: int
    visits: float


def _grow(plan: Plan, box: _Box, node: int, steps: int, limits: _Limits, name_of: NameOf) -> None:
    """Adds the boxes of a node's actions and, below them, of what is seen."""
    tree, total = plan.tree, max(1, int(plan.visits.sum()))
    tried = sorted(
        (e for e in tree.edges_of(node) if tree.edges["visits"][e] > 0), key=lambda e: -tree.edges["visits"][e]
    )
    best = tree.edge(ROOT, plan.action) if node == ROOT else tree.best_edge(node)
    shown = [e for e in tried[: limits.actions] if tree.edges["visits"][e] >= limits.visits]
    if best is not None and best not in shown:
        shown = [best, *shown[: limits.actions - 1]]
    for edge in sorted(shown, key=lambda e: -tree.edges["value"][e]):
        visits = int(tree.edges["visits"][edge])
        name = plan.names[int(tree.edge_actions[edge])]
        on_line = box.best and edge == best
        below = _Box(f"{name}\n{tree.edges['value'][edge]:.2f} · {visits:,}", visits / total, on_line, action=True)
        box.children.append(below)
        children = sorted(tree.children(edge), key=lambda n: -int(tree.nodes["visits"][n]))
        drawn = [c for c in children[: limits.observations] if tree.nodes["visits"][c] >= limits.visits]
        for child in drawn:
            count = int(tree.nodes["visits"][child])
            label = f"{name_of(tree.observation(child))}\n{count:,}"
            history = _Box(label, count / total, on_line and child == children[0], action=False)
            below.children.append(history)
            if steps > 1:
                _grow(plan, history, child, steps - 1, limits, name_of)
        _count_rest(below, [int(tree.nodes["visits"][c]) for c in children if c not in drawn], total, action=False)
    _count_rest(box, [int(tree.edges["visits"][e]) for e in tried if e not in shown], total, action=True)


def _count_rest(box: _Box, visits: list[int], total: int, action: bool) -> None:
    """A box for what is not drawn."""
    if visits:
        what = f"+{len(visits)} action{'s' * (len(visits) > 1)}" if action else f"+{len(visits)}"
        box.children.append(_Box(f"{what}\n{sum(visits):,}", sum(visits) / total, False, action))


def _place(box: _Box, row: float) -> float:
    """Gives every box its row, leaves one below the other and parents amid their children; returns the next free row."""
    if not box.children:
        box.row = row
        return row + 1.0
    for child in box.children:
        row = _place(child, row)
    box.row = (box.children[0].row + box.children[-1].row) / 2
    return row


def _depth(box: _Box) -> int:
    return 1 + max(map(_depth, box.children)) if box.children else 0


def _draw(axes: Axes, box: _Box, column: int) -> None:
    for child in box.children:
        colour = BEST if child.best else SOFT
        width = 0.5 + 5.5 * math.sqrt(child.share)
        along = [i / 24 for i in range(25)]
        axes.plot(
            [column + s for s in along],
            [box.row + (child.row - box.row) * s * s * (3 - 2 * s) for s in along],
            color=colour, linewidth=width, alpha=1.0 if child.best else 0.55, zorder=1, solid_capstyle="round",
        )  # fmt: skip
        _draw(axes, child, column + 1)
    shape = {"boxstyle": "round,pad=0.25" if box.action else "round,pad=0.3,rounding_size=0.9"}
    axes.text(
        column, box.row, box.label, ha="center", va="center", fontsize=6.5, color=INK, zorder=2, linespacing=1.15,
        bbox=shape | {
            "facecolor": ACTION if box.action else HISTORY,
            "edgecolor": BEST if box.best else SOFT,
            "linewidth": 1.3 if box.best else 0.7,
        },
    )  # fmt: skip
