"""The page of a trained population: what was trained, what it cost, and a learning curve per policy; and the curves as a PNG."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tab_marl.agents.population.members import Population
from tab_marl.agents.population.run import FAILED, MemberStand
from tab_marl.agents.training.algorithms import ALGORITHMS
from tab_marl.agents.training.log import LearningCurve, read_log
from tab_marl.agents.training.settings import UNOPPOSED, TrainingSettings

PAGE_FILE, PICTURE_FILE = "population.html", "learning-curves.png"
COMPETENT = 0.9
"""Of every mission type, action noise on: from where on a policy is said to be competent."""
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8a6d00")
"""Of mission types in turn: Okabe and Ito's, which most colour-blind people tell apart; the yellow is darker."""
DASHES = ("", "6 3", "2 2", "8 3 2 3", "1 2")
WIDTH, HEIGHT = 320, 190
LEFT, RIGHT, TOP, BOTTOM = 34, 8, 8, 30
POINTS = 150
"""Of a drawn curve, at most."""


@dataclass(frozen=True)
class Line:
    """One policy on the page."""

    stand: MemberStand
    curve: LearningCurve | None
    """None before its first row."""

    @property
    def minutes(self) -> float:
        return float(self.curve.cpu_seconds[-1]) / 60 if self.curve is not None else 0.0

    @property
    def last(self) -> dict[str, float]:
        """Share completed per mission type in the last row, action noise on."""
        return {m: float(v[-1]) for m, v in self.curve.success.items()} if self.curve is not None else {}

    @property
    def competent_minutes(self) -> float:
        """CPU minutes after which all mission types stayed at 90 % or more; nan if they did not."""
        if self.curve is None:
            return math.nan
        lowest = np.min(list(self.curve.success.values()), axis=0)
        below = np.flatnonzero(~(lowest >= COMPETENT))  # unknown counts as below
        first = int(below[-1]) + 1 if len(below) else 0
        return float(self.curve.cpu_seconds[first]) / 60 if first < len(lowest) else math.nan


def write_report(population: Population, stands: Mapping[str, MemberStand], out_dir: Path | str) -> Path:
    """Write ``population.html`` and ``learning-curves.png`` into `out_dir`; returns the page. Raises OSError."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    out = Path(out_dir)
    lines = [Line(stand, _curve(stand.folder)) for stand in stands.values()]
    missions = sorted({mission for line in lines for mission in line.last})
    environment = Environment(
        loader=PackageLoader("tab_marl.agents.population"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    page = environment.get_template("population.html.j2").render(
        name=population.name,
        source=population.source,
        missions=[(m, COLOURS[i % len(COLOURS)], DASHES[i % len(DASHES)]) for i, m in enumerate(missions)],
        rows=[_row(line, missions) for line in lines],
        cards=[_card(line, missions) for line in lines],
        minutes=sum(line.minutes for line in lines),
        failed=sum(line.stand.status == FAILED for line in lines),
        picture=PICTURE_FILE,
    )
    target = out / PAGE_FILE
    target.write_text(page, encoding="utf-8")
    known = [line for line in lines if line.curve is not None]
    if known:
        draw(known, missions, out / PICTURE_FILE)
    return target


def _curve(folder: Path) -> LearningCurve | None:
    try:
        curve = read_log(folder)
    except (OSError, ValueError):
        return None
    return curve if len(curve.steps) else None


def network_of(settings: TrainingSettings) -> str:
    """ "128-128 tanh", "LSTM 64, 64 tanh"."""
    widths = "-".join(str(width) for width in settings.layers)
    return f"{f'LSTM {settings.lstm_units}, ' if settings.lstm_units else ''}{widths} {settings.activation}"


def hunters_of(settings: TrainingSettings) -> str:
    """Whom it was hunted by while networks or habits learned; "none"."""
    hunters = [names for names in (settings.opponent, settings.habits_against) if names not in ("", UNOPPOSED)]
    return ", ".join(hunters) or UNOPPOSED


def _row(line: Line, missions: Sequence[str]) -> dict[str, Any]:
    stand, settings = line.stand, line.stand.settings
    return {
        "name": stand.name,
        "algorithm": ALGORITHMS[settings.algorithm].title,
        "network": network_of(settings),
        "style": settings.style.name,
        "opponent": hunters_of(settings),
        "split": settings.split,
        "steps": f"{stand.steps / 1e6:.2f}",
        "minutes": f"{line.minutes:.1f}",
        "competent": "" if math.isnan(line.competent_minutes) else f"{line.competent_minutes:.1f}",
        "shares": [_percent(line.last.get(mission, math.nan)) for mission in missions],
        "status": stand.status,
        "error": stand.error,
    }


def _card(line: Line, missions: Sequence[str]) -> dict[str, Any]:
    settings = line.stand.settings
    note = f"{ALGORITHMS[settings.algorithm].title}, {network_of(settings)}, seed {settings.seed}"
    if settings.opponent != UNOPPOSED:
        note += f", hunted by {settings.opponent}"
    if settings.habits_against:
        note += f", then {settings.habit_episodes} episodes of learning habits against {settings.habits_against}"
    return {
        "name": settings.name,
        "note": note,
        "svg": curve_svg(line.curve, missions, settings.name) if line.curve is not None else "",
        "error": line.stand.error,
    }


def _percent(share: float) -> str:
    return "" if math.isnan(share) else f"{100 * share:.0f}"


def curve_svg(curve: LearningCurve, missions: Sequence[str], name: str) -> str:
    """Success per mission type over CPU minutes, as SVG text that takes its colours from the page."""
    minutes = curve.cpu_seconds / 60
    longest = max(float(minutes[-1]), 1e-3)
    across, down = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM

    def x(value: float) -> float:
        return LEFT + across * value / longest

    def y(share: float) -> float:
        return TOP + down * (1 - share)

    title = f"<title>Success of {escape(name)} over CPU minutes</title>"
    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="Learning curve of {escape(name)}">{title}']
    for share in (0.0, 0.5, 0.9, 1.0):
        kind = "goal" if share == COMPETENT else "grid"
        parts.append(
            f'<line class="{kind}" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y(share):.1f}" y2="{y(share):.1f}"/>'
            + (
                ""
                if share == 1.0
                else f'<text class="tick" x="{LEFT - 5}" y="{y(share) + 4:.1f}">{100 * share:.0f}</text>'
            )
        )
    for value in _ticks(longest):
        parts.append(f'<text class="tick mid" x="{x(value):.1f}" y="{HEIGHT - 16}">{value:g}</text>')
    parts.append(f'<text class="tick mid" x="{LEFT + across / 2:.0f}" y="{HEIGHT - 3}">CPU minutes</text>')
    shown = _thin(len(minutes))
    for i, mission in enumerate(missions):
        shares = curve.success.get(mission)
        if shares is None:
            continue
        points = " ".join(f"{x(minutes[k]):.1f},{y(shares[k]):.1f}" for k in shown if not math.isnan(shares[k]))
        dash = f' stroke-dasharray="{DASHES[i % len(DASHES)]}"' if DASHES[i % len(DASHES)] else ""
        parts.append(
            f'<polyline class="m{i % len(COLOURS)}"{dash} points="{points}"><title>{mission}</title></polyline>'
        )
    return "".join([*parts, "</svg>"])


def _thin(count: int) -> list[int]:
    return sorted(set(np.linspace(0, count - 1, min(count, POINTS)).round().astype(int).tolist()))


def _ticks(longest: float) -> NDArray[np.float64]:
    """Three to six round numbers from 0 on."""
    for step in (m * 10.0**e for e in range(-3, 5) for m in (1, 2, 5)):
        if longest / step <= 5:
            return np.round(np.arange(0.0, longest + 1e-9, step), 6)
    return np.array([0.0])


def draw(lines: Sequence[Line], missions: Sequence[str], target: Path) -> None:
    """The learning curves side by side as a picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(len(lines), 3 if len(lines) <= 6 else 4)
    rows = -(-len(lines) // columns)
    figure = Figure(figsize=(2.7 * columns, 1.9 * rows + 0.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, sharey=True, squeeze=False)
    handles: list[Any] = []
    for axis, line in zip(axes.flat, lines, strict=False):
        curve = line.curve
        assert curve is not None
        shown = _thin(len(curve.steps))
        handles = [
            axis.plot(
                curve.cpu_seconds[shown] / 60, 100 * curve.success.get(m, np.full(len(curve.steps), np.nan))[shown],
                color=COLOURS[i % len(COLOURS)], linewidth=1.1, label=m,
            )[0]
            for i, m in enumerate(missions)
        ]  # fmt: skip
        axis.axhline(100 * COMPETENT, color="0.6", linewidth=0.6, linestyle=":")
        settings = line.stand.settings
        axis.set_title(f"{settings.name} ({ALGORITHMS[settings.algorithm].title})", fontsize=8)
        axis.set_ylim(-3, 103)
        axis.set_xlim(left=0)
        axis.tick_params(labelsize=7)
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
    for axis in list(axes.flat)[len(lines) :]:
        axis.set_visible(False)
    figure.supxlabel("CPU minutes, one core", fontsize=8)
    figure.supylabel("missions completed, %", fontsize=8)
    figure.legend(handles=handles, loc="outside upper center", ncols=max(len(missions), 1), fontsize=8, frameon=False)
    figure.savefig(target, dpi=110)
