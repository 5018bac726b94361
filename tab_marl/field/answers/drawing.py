"""Pictures of a field: occupancy over time, paths, stage times, posteriors. The only file here that imports matplotlib."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tab_marl.field.answers.evidence import Seen
from tab_marl.world.grid import GridMap
from tab_marl.world.scenario import Scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tab_marl.field.answers.posterior import Posterior
    from tab_marl.field.tab_field import TabField
    from tab_marl.world.regions import Region

INK, WALL, CAMERA, ZONE, PATH = "#1b1b1b", "#8a8f98", "#2a6fbb", "#b03a2e", "#1b1b1b"
BEST = "#7b2d8b"
STAGES = ("#d1660f", "#2a6fbb", "#2f8a57", "#7b2d8b", "#b03a2e", "#6b6f76")


def draw_field(field: TabField, path: str | Path | None = None, panels: int = 8) -> Figure:
    """Moments of the occupancy up to the last likely completion, the likeliest and sampled paths, times of the stages."""
    if panels < 2:
        raise ValueError(f"panels is {panels}, must be >= 2")
    grid, scenario = planar(field)
    complete = field.completion_probability
    last = last_likely_tick(field)
    ticks = np.unique(np.linspace(0, last, panels).round().astype(int))
    columns = min(5, len(ticks) + 1)
    rows = -(-(len(ticks) + 1) // columns)
    figure = _figure(2.5 * columns, 2.75 * rows + 2.0)
    parts: Any = figure.subfigures(2, 1, height_ratios=[2.75 * rows, 2.0])
    upper, lower = parts
    axes = np.atleast_1d(upper.subplots(rows, columns)).ravel()
    for axis, t in zip(axes, ticks, strict=False):
        _draw_shade(axis, grid, scenario, field.occupancy[t])
        axis.set_title(f"{t * scenario.step_seconds:g} s, complete {complete[t]:.0%}", fontsize=8)
    draw_paths(field, axes[len(ticks)], last)
    for axis in axes[len(ticks) + 1 :]:
        axis.set_axis_off()
    draw_stage_times(field, lower.subplots(1, 1), last)
    return _written(figure, path)


def draw_paths(field: TabField, axis: Axes, ticks: int, count: int = 40) -> None:
    """Sampled trajectories, thin, and the likeliest one that completes the mission, bold."""
    _, scenario = planar(field)
    _draw_map(axis, scenario)
    paths = field.sample(np.random.default_rng(0), count, ticks)
    for line, done in zip(paths.positions, paths.completed_tick, strict=True):
        until = done + 1 if done >= 0 else len(line)
        axis.plot(*line[:until].T, color=PATH, linewidth=0.5, alpha=0.4)
    best = field.most_likely_path()
    axis.plot(*best.positions.T, color=BEST, linewidth=1.8, marker="o", markersize=2.2)
    seconds = (len(best) - 1) * scenario.step_seconds
    axis.set_title(f"{count} samples; likeliest ({seconds:g} s)", fontsize=8)


def draw_stage_times(field: TabField, axis: Axes, last: int) -> None:
    """The probability of completing each stage at each tick."""
    step = field.problem.step_seconds
    seconds = np.arange(field.problem.horizon + 1) * step
    stages = field.stage_times
    for (name, chance), colour in zip(stages.items(), _colours(len(stages)), strict=True):
        label = f"{name} ({chance.sum():.0%})" if len(stages) > 1 or chance.sum() < 0.9995 else name
        axis.fill_between(seconds, chance, step="mid", color=colour, alpha=0.25, linewidth=0)
        axis.step(seconds, chance, where="mid", color=colour, linewidth=1.2, label=label)
    axis.set_xlim(0, max(last, 1) * step)
    axis.set_ylim(0, None)
    axis.set_xlabel("seconds", fontsize=8)
    axis.set_ylabel("completed at this tick", fontsize=8)
    axis.tick_params(labelsize=7)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(fontsize=7, frameon=False, loc="upper left", ncols=3)


def draw_posterior(posterior: Posterior, path: str | Path | None = None, panels: int = 6) -> Figure:
    """Two rows: what was known at the time (filter), and what is known from all observations (smoother)."""
    if panels < 2:
        raise ValueError(f"panels is {panels}, must be >= 2")
    grid, scenario = planar(posterior.field)
    latest = max((o.tick for o in posterior.observations), default=0)
    ticks = np.unique(np.linspace(0, max(latest, last_likely_tick(posterior.field)), panels).round().astype(int))
    figure = _figure(2.3 * len(ticks), 5.3)
    axes = figure.subplots(2, len(ticks))
    seen = [o for o in posterior.observations if isinstance(o, Seen)]
    for row, (name, law) in enumerate((("filtered", posterior.filtered), ("smoothed", posterior.occupancy))):
        for axis, t in zip(axes[row], ticks, strict=True):
            _draw_shade(axis, grid, scenario, law[t])
            axis.set_title(f"{name}, {t * scenario.step_seconds:g} s", fontsize=8)
            for o in seen:
                known = o.tick <= t or row == 1
                axis.plot(*o.point, marker="x", color=BEST if known else WALL, markersize=6, mew=1.6)
    return _written(figure, path)


def occupancy_frames(field: TabField) -> Iterator[NDArray[np.uint8]]:
    """``[height, width, 3]`` pictures of the occupancy, one per tick up to the last likely completion."""
    grid, scenario = planar(field)
    complete, last = field.completion_probability, last_likely_tick(field)
    width, height = scenario.width_metres, scenario.height_metres
    scale = 4.8 / max(width, height)
    figure = _figure(width * scale, height * scale + 0.4)
    axis = figure.subplots()
    _draw_shade(axis, grid, scenario, field.occupancy[0])
    picture = axis.images[0]
    title = axis.set_title("0 s", fontsize=10)
    for t in range(last + 1):
        shade = np.sqrt(grid.image(field.occupancy[t], blocked=0.0))
        picture.set_data(shade)
        picture.set_clim(0.0, max(shade.max(), 1e-12))
        title.set_text(f"{t * scenario.step_seconds:4.1f} s   complete {complete[t]:4.0%}")
        figure.canvas.draw()
        if t == 0:
            figure.set_layout_engine("none")  # laid out once; the pictures then keep their place
        yield np.asarray(figure.canvas.buffer_rgba())[:, :, :3].copy()  # type: ignore[attr-defined]


def planar(field: TabField) -> tuple[GridMap, Scenario]:
    """The map to draw on. Raises ValueError if there is none, or it is not planar."""
    grid, scenario = field.problem.grid, field.problem.scenario
    if not isinstance(grid, GridMap) or not isinstance(scenario, Scenario):
        raise ValueError(  # noqa: TRY004 (of the problem, not of an argument)
            "pictures need a field made by FieldProblem.from_mission on a planar Scenario: this one has no planar map"
        )
    return grid, scenario


def last_likely_tick(field: TabField) -> int:
    """The tick by which 99.9 % of what is ever completed is complete; at least 1."""
    complete = field.completion_probability
    if complete[-1] <= 0:
        return max(field.problem.horizon, 1)
    return max(int(np.searchsorted(complete, 0.999 * complete[-1])), 1)


def _figure(width: float, height: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _written(figure: Figure, path: str | Path | None) -> Figure:
    if path is not None:
        figure.savefig(path, dpi=130)
    return figure


def _colours(count: int) -> list[str]:
    return [STAGES[i % len(STAGES)] for i in range(count)]


def _draw_shade(axis: Axes, grid: GridMap, scenario: Scenario, law: NDArray[np.float64]) -> None:
    rows, columns = grid.cell_at.shape
    extent = (0.0, columns * grid.cell_metres, 0.0, rows * grid.cell_metres)
    # Square root: ten times the probability looks about three times as dark, so that the spread stays visible.
    shade = np.sqrt(grid.image(law, blocked=0.0))
    axis.imshow(shade, origin="lower", extent=extent, cmap="Oranges", vmin=0.0, vmax=max(shade.max(), 1e-12))
    _draw_map(axis, scenario)


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
