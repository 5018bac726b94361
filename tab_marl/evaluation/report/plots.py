"""Figures for papers, as SVG, PDF or PNG, drawn with matplotlib from the same results as the page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tab_marl.evaluation import tables
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.report.results import Results
from tab_marl.evaluation.settings import COMPETING_PLANNERS, PLANNERS, short
from tab_marl.evaluation.tables import ALL

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

KINDS = ("svg", "pdf", "png")
COLUMN_INCHES = 3.3
"""Width of a column of a two-column paper."""
DOTS_PER_INCH = 300

LOOK: dict[str, tuple[str, str, str]] = {
    "S-POMCP": ("#b45309", "s", "-"),
    "FP-POMCP": ("#0f7a4d", "^", "-"),
    "MLE-POMCP": ("#b0368a", "v", "-"),
    "TAB-POMCP": ("#1b5cc4", "o", "-"),
    "TAB-POMCP+precedents": ("#0b7d94", "P", "-"),
    "population-POMCP": ("#6b7483", "s", "--"),
    "oracle": ("#6b7483", "o", ":"),
    "random": ("#6b7483", "x", ":"),
}
"""Colour, mark and line of each planner: those of the page. A figure can be read from marks alone."""
UNKNOWN = ("#333333", "d", "-.")

STYLE: dict[Any, Any] = {
    "font.size": 7.5, "axes.titlesize": 8, "axes.labelsize": 7.5, "legend.fontsize": 7, "xtick.labelsize": 7,
    "ytick.labelsize": 7, "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.6,
    "lines.linewidth": 1.2, "lines.markersize": 3.5, "pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "tab-marl",
    "legend.frameon": False, "axes.grid": True, "grid.color": "#e8ecf1", "grid.linewidth": 0.6, "axes.axisbelow": True,
}  # fmt: skip


def export_figures(results: Results, folder: Path, kinds: Sequence[str]) -> list[Path]:
    """Draw every figure in every kind ("svg", "pdf", "png"); returns the files. Raises UserError if one cannot be written."""
    import matplotlib

    dates: dict[str, dict[str, Any]] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {}}
    written = []
    with matplotlib.rc_context(STYLE):
        for name, draw in figures(results).items():
            figure = draw()
            for kind in kinds:
                path = folder / f"{name}.{kind}"
                try:
                    folder.mkdir(parents=True, exist_ok=True)
                    figure.savefig(path, metadata=dates[kind], dpi=DOTS_PER_INCH, bbox_inches="tight")
                except OSError as error:
                    raise UserError(f"{path}: the figure cannot be written: {error.strerror}") from None
                written.append(path)
    return written


def figures(results: Results) -> dict[str, Callable[[], Figure]]:
    """What draws each figure, by name."""
    found: dict[str, Callable[[], Figure]] = {}
    for family in dict.fromkeys(line.family for line in results.lines):
        found[f"measures-{family}"] = lambda family=family: _measures(results, family)  # type: ignore[misc]
        found[f"over-time-{family}"] = lambda family=family: _over_time(results, family)  # type: ignore[misc]
        found[f"profile-{family}"] = lambda family=family: _profile(results, family)  # type: ignore[misc]
        if any(s.family == family for s in results.by.get("adversary", [])):
            found[f"adversaries-{family}"] = lambda family=family: _adversaries(results, family)  # type: ignore[misc]
    return found


def _new(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Figure, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _measures(results: Results, family: str) -> Figure:
    """ATCR and StI per mission, intervals as lines."""
    lines = [x for x in results.lines if x.family == family]
    missions = list(dict.fromkeys(x.mission for x in lines))
    figure, axes = _new(2 * COLUMN_INCHES, 2.4, 1, 2)
    planners = tables.order([x.planner for x in lines], PLANNERS)
    for i, planner in enumerate(planners):
        colour, mark, _ = LOOK.get(planner, UNKNOWN)
        for axis, pick, scale in ((axes[0, 0], "atcr", 100.0), (axes[0, 1], "steps", 0.01)):
            part = [(missions.index(x.mission), getattr(x, pick)) for x in lines if x.planner == planner]
            at = np.array([m for m, _ in part]) + 0.72 / len(planners) * (i - (len(planners) - 1) / 2)
            value = scale * np.array([v.value for _, v in part])
            spread = scale * np.array([[v.value - v.low for _, v in part], [v.high - v.value for _, v in part]])
            hollow = {"markerfacecolor": "white"} if planner not in COMPETING_PLANNERS else {}
            axis.errorbar(
                at, value, spread, fmt=mark, color=colour, label=short(planner), elinewidth=1, clip_on=False, **hollow
            )
    for axis, label in ((axes[0, 0], "ATCR, %"), (axes[0, 1], "time to interception, s")):
        axis.set_xticks(range(len(missions)), ["all" if m == ALL else m for m in missions])
        axis.set_ylabel(label)
        axis.set_ylim(bottom=0)
        axis.grid(axis="x", visible=False)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), ncols=len(planners), loc="outside upper center")
    return figure


def _curve(axis: Axes, planner: str, x: Any, value: Any, low: Any, high: Any, number: int) -> None:
    colour, mark, line = LOOK.get(planner, UNKNOWN)
    every = (4 * number % max(len(x) // 4, 1), max(len(x) // 4, 1))  # marks of different lines do not meet
    hollow: dict[str, Any] = {"markerfacecolor": "white"} if planner not in COMPETING_PLANNERS else {}
    axis.plot(
        x, 100 * value, line, color=colour, marker=mark, markevery=every, label=short(planner), clip_on=False, **hollow
    )
    if planner in COMPETING_PLANNERS:
        axis.fill_between(x, 100 * low, 100 * high, color=colour, alpha=0.13, linewidth=0)


def _over_time(results: Results, family: str) -> Figure:
    """Completed first and met over time: the mean over missions, or the only mission."""
    figure, axes = _new(2 * COLUMN_INCHES, 2.4, 1, 2)
    for axis, curves, label in (
        (axes[0, 0], results.completed, "mission completed first, %"),
        (axes[0, 1], results.met, "adversary met, %"),
    ):
        missions = [m for f, m, _ in curves if f == family]
        mission = ALL if ALL in missions else missions[0]
        part = {p: c for (f, m, p), c in curves.items() if (f, m) == (family, mission)}
        end = 100.0 if mission == ALL else max(float(c.times[-1]) for c in part.values())
        for number, (planner, curve) in enumerate(part.items()):
            grid = np.linspace(0, end, 121)
            _curve(axis, planner, grid, *curve.at(grid), number)
        axis.set_xlabel("% of the episode's time" if mission == ALL else "seconds")
        axis.set_ylabel(label)
        axis.set_ylim(bottom=0)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=len(labels), loc="outside upper center")
    return figure


def _profile(results: Results, family: str) -> Figure:
    """The share of episodes above each score."""
    figure, axes = _new(COLUMN_INCHES, 2.7)
    part = results.profiles[results.profiles["family"] == family]
    for number, planner in enumerate(tables.order(part["planner"], PLANNERS)):
        one = part[part["planner"] == planner]
        x, value, low, high = (one[c].to_numpy() for c in ("threshold", "value", "low", "high"))
        _curve(axes[0, 0], planner, x, value, low, high, number)
    axes[0, 0].set(xlabel="score τ = 1 − StI / horizon", ylabel="episodes above τ, %", xlim=(0, 1), ylim=(0, 101))
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=4, loc="outside upper center")
    return figure


def _adversaries(results: Results, family: str) -> Figure:
    """ATCR per adversary and planner as a heat map with its figures."""
    part = [s for s in results.by["adversary"] if s.family == family]
    names = list(dict.fromkeys(s.part for s in part))
    planners = tables.order([s.planner for s in part], PLANNERS)
    image = np.full((len(names), len(planners)), np.nan)
    for s in part:
        image[names.index(s.part), planners.index(s.planner)] = 100 * s.atcr.value
    figure, axes = _new(COLUMN_INCHES, 0.7 + 0.17 * len(names))
    axis = axes[0, 0]
    drawn = axis.imshow(image, cmap="Oranges", vmin=0, vmax=100, aspect="auto")
    for (row, column), value in np.ndenumerate(image):
        if np.isfinite(value):
            ink = "white" if value > 60 else "black"
            axis.text(column, row, f"{value:.0f}", ha="center", va="center", color=ink, fontsize=6.5)
    axis.set_xticks(range(len(planners)), [short(p) for p in planners], rotation=30, ha="right")
    axis.set_yticks(range(len(names)), names)
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)
    axis.tick_params(length=0)
    figure.colorbar(drawn, ax=axis, label="ATCR, %", shrink=0.9)
    return figure
