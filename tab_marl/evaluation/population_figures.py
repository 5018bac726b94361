"""Pictures of a population: everybody's ways on the same map, and the spread of what they do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.patches import Circle, Polygon, Rectangle
from numpy.typing import NDArray

from tab_marl.agents.adversaries import AdversaryPolicy, ScriptedAdversary
from tab_marl.agents.measures.diversity import Behaviour, Yardstick
from tab_marl.agents.measures.measuring import TIME_USED
from tab_marl.agents.measures.rollouts import run_bank
from tab_marl.envs.adversary_observation import AdversaryTask
from tab_marl.envs.batched import Bank
from tab_marl.evaluation.population_study import Study, side_interval
from tab_marl.field.problem import FieldProblem
from tab_marl.field.solve import solve
from tab_marl.mission import to_english
from tab_marl.mission.tasks import Task
from tab_marl.planning.models.drawn_ways import WaysOptions, draw_ways
from tab_marl.world.regions import Box, Disc, Region
from tab_marl.world.regions import Polygon as Outline

PATHS = 12
"""Drawn per policy."""
COLUMNS = 6
PAPER, INK, FAINT, WALL = "#ffffff", "#222222", "#9a9a9a", "#b9bec6"
TIMES = plt.get_cmap("viridis_r")
Array = NDArray[np.float64]


def draw_paths(study: Study, y: Yardstick, target: Path, seed: int = 5) -> None:
    """Small multiples: every policy, the scripted follower and what TAB-POMCP expects on one task; colour is the time used."""
    players: list[AdversaryPolicy] = [*study.policies, ScriptedAdversary()]
    panels = [(p.name, _ways(p, y, seed)) for p in players]
    panels += [("TAB-Field", _sampled(y, seed)), ("drawn ways", _drawn(y, seed))]
    rows = -(-len(panels) // COLUMNS)
    figure, axes = plt.subplots(rows, COLUMNS, figsize=(1.75 * COLUMNS, 1.84 * rows + 0.75), dpi=110, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, (name, ways) in zip(axes.flat, panels, strict=False):
        draw_map(axis, y.task)
        for path, share in ways:
            axis.plot(path[:, 0], path[:, 1], color=TIMES(min(share, 1.0)), lw=1.1, alpha=0.85, solid_capstyle="round")
        baseline = name in ("scripted", "TAB-Field", "drawn ways")
        axis.set_title(
            name, fontsize=8.5, color=FAINT if baseline else INK, style="italic" if baseline else "normal", pad=2
        )
    figure.suptitle(to_english(y.task.mission, y.task.scenario), fontsize=9, y=0.995)
    figure.subplots_adjust(
        left=0.01, right=0.925, bottom=0.01, top=1 - 0.5 / (1.84 * rows + 0.75), wspace=0.06, hspace=0.16
    )
    bar = figure.colorbar(
        ScalarMappable(norm=Normalize(0, 1), cmap=TIMES), cax=figure.add_axes((0.94, 0.2, 0.012, 0.6))
    )
    bar.set_label("time used / allowed", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    _save(figure, target)


def draw_map(axis: Any, task: Task) -> None:
    """Walls, obstacles, cameras, checkpoints and goals of a task."""
    scenario = task.scenario
    axis.set_xlim(-0.03, scenario.width_metres + 0.03)
    axis.set_ylim(-0.03, scenario.height_metres + 0.03)
    axis.set_aspect("equal")
    axis.add_patch(Rectangle((0, 0), scenario.width_metres, scenario.height_metres, fc="#fbfbf9", ec=INK, lw=0.8))
    for constraint in task.mission.beside:
        for place in constraint.places if constraint.avoid else ():
            axis.add_patch(_patch(scenario.place(place), fc="#f3d5d5", ec="#c77", lw=0.5, hatch="////"))
    for obstacle in scenario.obstacles:
        axis.add_patch(_patch(obstacle, fc=WALL, ec="#8a8f98", lw=0.5))
    goals = {place for goal in task.mission.goals for place in goal.places}
    for checkpoint in scenario.checkpoints:
        axis.add_patch(
            Circle(
                (checkpoint.x, checkpoint.y), checkpoint.camera_metres, fc="none", ec="#8fb3d9", lw=0.6, ls=(0, (2, 2))
            )
        )
        wanted = checkpoint.name in goals
        axis.add_patch(
            Circle(
                (checkpoint.x, checkpoint.y),
                checkpoint.radius_metres,
                fc="#cfe8cf" if wanted else "none",
                ec="#5a8f5a",
                lw=0.7,
            )
        )
        axis.text(checkpoint.x, checkpoint.y, checkpoint.name[-1], fontsize=6, ha="center", va="center", color=INK)
    for place in goals:
        if not isinstance(place, str):
            axis.add_patch(_patch(scenario.place(place), fc="#cfe8cf", ec="#5a8f5a", lw=0.7))
    axis.plot(*scenario.adversary_start.centre, marker="o", ms=3.5, color="#c0392b", zorder=5)


def _patch(region: Region, **how: Any) -> Any:
    if isinstance(region, Disc):
        return Circle((region.x, region.y), region.radius, **how)
    if isinstance(region, Box):
        x0, y0, x1, y1 = region.bounds()
        return Rectangle((x0, y0), x1 - x0, y1 - y0, **how)
    assert isinstance(region, Outline)
    return Polygon(np.asarray(region.corners), closed=True, **how)


def _ways(policy: AdversaryPolicy, y: Yardstick, seed: int) -> list[tuple[Array, float]]:
    rng = np.random.default_rng(seed)
    built = AdversaryTask.draw(y.task.scenario, y.task.mission, policy.style, rng, PATHS if policy.style.varies else 1)
    bank = Bank.of(built)
    rollouts = run_bank(policy, bank, np.arange(PATHS) % len(bank), np.random.default_rng(seed), with_places=False)
    hertz = y.task.scenario.control_hertz
    return [
        (rollouts.positions[i, : end + 1].astype(np.float64), end / hertz / y.allowed_seconds)
        for i, end in enumerate(rollouts.end.tolist())
    ]


def _sampled(y: Yardstick, seed: int) -> list[tuple[Array, float]]:
    scenario = y.task.scenario
    field = solve(FieldProblem.from_mission(y.task.mission, scenario))
    paths = field.sample(np.random.default_rng(seed), PATHS)
    return [
        (path[: end + 1], end * scenario.step_seconds / y.allowed_seconds)
        for path, end in zip(paths.positions, paths.completed_tick.tolist(), strict=True)
    ]


def _drawn(y: Yardstick, seed: int) -> list[tuple[Array, float]]:
    scenario, options = y.task.scenario, WaysOptions(drivers=PATHS, starts_each=1)
    positions, completed = draw_ways(scenario, y.task.mission, np.random.default_rng(seed), options)
    return [
        (path[: end + 1], end * scenario.step_seconds / y.allowed_seconds)
        for path, end in zip(positions, completed.tolist(), strict=True)
        if end >= 0
    ]


def draw_figures(study: Study, target: Path) -> None:
    """Per policy, on the same tasks: time used, side taken, length, seconds in cameras."""
    rows = list(study.everybody)
    order = sorted(range(len(study.policies)), key=lambda i: (study.policies[i].style.name, study.policies[i].name))
    rows = [*(study.behaviours[i] for i in order), study.scripted, study.field]
    names = [*(f"{study.policies[i].name}" for i in order), "scripted", "TAB-Field"]
    at = np.arange(len(rows))[::-1]
    figure, axes = plt.subplots(1, 4, figsize=(10.2, 0.27 * len(rows) + 1.1), sharey=True, width_ratios=(1.2, 1, 1, 1))
    panels = (
        (TIME_USED, "time used / allowed"),
        ("shortest side", "took the shortest path's side"),
        ("length / shortest", "length / shortest"),
        ("seconds in other cameras", "s in avoidable cameras"),
    )
    for axis, (figure_name, label) in zip(axes, panels, strict=True):
        for row, b in zip(at, rows, strict=True):
            colour = "#9a9a9a" if b in (study.scripted, study.field) else "#2b6cb0"
            low, middle, high = _spread_of(b, figure_name)
            axis.plot([low, high], [row, row], color=colour, lw=2.6, alpha=0.45, solid_capstyle="round")
            axis.plot(middle, row, "o", color=colour, ms=4.5)
        axis.set_xlabel(label, fontsize=8.5)
        axis.tick_params(labelsize=8, length=2)
        axis.grid(axis="x", color="#e6e6e6", lw=0.6)
        axis.set_axisbelow(True)
        for side in ("top", "right", "left"):
            axis.spines[side].set_visible(False)
    axes[0].set_yticks(at, names)
    axes[0].set_xlim(0, 1.05)
    axes[1].set_xlim(0, 1.02)
    axes[1].axvline(0.6, color="#c0392b", lw=0.8, ls=(0, (4, 3)))
    figure.tight_layout(pad=0.4, w_pad=1.0)
    _save(figure, target)


def _spread_of(b: Behaviour, name: str) -> tuple[float, float, float]:
    """Low, middle, high: an interval of the share for sides, tenths of episodes for the rest."""
    if name == "shortest side":
        share, low, high = side_interval(b)
        return low, share, high
    low, middle, high = b.quantiles(name)
    return low, middle, high


def _save(figure: Any, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with plt.rc_context({"svg.hashsalt": "tab-marl"}):
        figure.savefig(target, metadata={"Date": None} if target.suffix == ".svg" else None)
    plt.close(figure)
    if target.suffix == ".png":
        _fewer_colours(target)


def _fewer_colours(path: Path) -> None:
    """A palette of 256 colours: the file is a third of the size, and looks the same."""
    from PIL import Image

    with Image.open(path) as picture:
        smaller = picture.convert("RGB").quantize(256)
    smaller.save(path, optimize=True)
