"""Pictures of a field: the occupancy over time on the map. The only file of the field that imports matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tab_marl.field.tab_field import TabField
    from tab_marl.world.regions import Region
    from tab_marl.world.scenario import Scenario

INK, WALL, CAMERA, ZONE, PATH = "#1b1b1b", "#8a8f98", "#2a6fbb", "#b03a2e", "#1b1b1b"


def draw_field(field: TabField, path: str | Path | None, panels: int) -> Figure:
    """Small multiples: `panels` moments of the occupancy up to the last likely completion, then sampled trajectories."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    problem = field.problem
    grid, scenario = problem.grid, problem.scenario
    if grid is None or scenario is None:
        raise ValueError("plot needs a field made by FieldProblem.from_mission: this one has no map")
    if panels < 2:
        raise ValueError(f"panels is {panels}, must be >= 2")
    complete = field.completion_probability
    last = int(np.searchsorted(complete, 0.999 * complete[-1])) if complete[-1] > 0 else problem.horizon
    ticks = np.unique(np.linspace(0, max(last, 1), panels).round().astype(int))
    columns = min(5, len(ticks) + 1)
    rows = -(-(len(ticks) + 1) // columns)
    figure = Figure(figsize=(2.5 * columns, 2.75 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    extent = (0.0, grid.cell_at.shape[1] * grid.cell_metres, 0.0, grid.cell_at.shape[0] * grid.cell_metres)
    for axis, t in zip(axes, ticks, strict=False):
        # Square root: ten times the probability looks about three times as dark, so that the spread stays visible.
        shade = np.sqrt(grid.image(field.occupancy[t], blocked=0.0))
        axis.imshow(shade, origin="lower", extent=extent, cmap="Oranges", vmin=0.0, vmax=max(shade.max(), 1e-12))
        _draw_map(axis, scenario)
        seconds = t * scenario.step_seconds
        axis.set_title(f"{seconds:g} s, complete {complete[t]:.0%}", fontsize=8)
    paths = field.sample(np.random.default_rng(0), 40, last)
    axis = axes[len(ticks)]
    _draw_map(axis, scenario)
    for line, done in zip(paths.positions, paths.completed_tick, strict=True):
        until = done + 1 if done >= 0 else len(line)
        axis.plot(*line[:until].T, color=PATH, linewidth=0.5, alpha=0.45)
    axis.set_title("40 sampled trajectories", fontsize=8)
    for axis in axes[len(ticks) + 1 :]:
        axis.set_axis_off()
    if path is not None:
        figure.savefig(path, dpi=130)
    return figure


def _draw_map(axis: Axes, scenario: Scenario) -> None:
    from matplotlib.patches import Circle
    from matplotlib.patches import Polygon as Patch

    from tab_marl.world.regions import Disc

    styled: tuple[tuple[Region, dict[str, Any]], ...] = (
        *((obstacle, {"facecolor": WALL, "edgecolor": "none"}) for obstacle in scenario.obstacles),
        (scenario.adversary_start, {"facecolor": "none", "edgecolor": INK, "linewidth": 0.8}),
        (scenario.region("central zone"), {"facecolor": "none", "edgecolor": ZONE, "linewidth": 0.7, "linestyle": ":"}),
    )
    for region, style in styled:
        if isinstance(region, Disc):
            axis.add_patch(Circle((region.x, region.y), region.radius, **style))
        else:
            axis.add_patch(Patch(region.vertices(), **style))
    for checkpoint in scenario.checkpoints:
        centre = (checkpoint.x, checkpoint.y)
        axis.add_patch(Circle(centre, checkpoint.camera_metres, fill=False, edgecolor=CAMERA, linewidth=0.5, alpha=0.6))
        axis.add_patch(Circle(centre, checkpoint.radius_metres, fill=False, edgecolor=CAMERA, linewidth=1.0))
        short = checkpoint.name.removeprefix("Checkpoint ")
        axis.annotate(short, centre, ha="center", va="center", fontsize=7, color=CAMERA)
    axis.set_xlim(0, scenario.width_metres)
    axis.set_ylim(0, scenario.height_metres)
    axis.set_aspect("equal")
    axis.set_xticks([])
    axis.set_yticks([])
