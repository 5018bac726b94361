"""The figure and the tables of the study of fields, from its rows alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from tab_marl.evaluation.field_study import LEVEL
from tab_marl.evaluation.statistics import share

CEILING = "knows the population"
SHOWN = {
    "walk": "#9aa3ad", "tumble + goals": "#7fa7d6", "tumble 0.5 m + goals": "#1f6feb",
    "turn, tumble + goals": "#14407f", "drive + goals": "#c98a2b",
    "particles": "#5fb0a5", "marginal kernel": "#b07cc6", "FP": "#d1495b", "MLE": "#8d6e63", CEILING: "#111111",
}  # fmt: skip
"""Models in the figure, all scored on every task, and their colours."""
RESAMPLES = 2000


def write(rows: Path, docs: Path) -> Iterator[str]:
    """Store the rows under `docs`/studies, draw the figure into `docs`/images, and yield the tables as Markdown."""
    forecasts = pd.concat([pd.read_csv(p) for p in sorted((rows / "forecasts").glob("*.csv"))], ignore_index=True)
    (docs / "studies").mkdir(parents=True, exist_ok=True)
    forecasts.to_csv(docs / "studies" / "field-forecasts.csv", index=False)
    scored = forecasts[forecasts.n > 0]
    for watched in sorted(scored.watched.unique()):
        yield f"watched {watched:g} s\n\n" + table(scored[scored.watched == watched])
    here = scored[(scored.ahead == 5.0) & (scored.watched == 0.0)]
    for by in ("mission", "family", "slack"):
        yield _wide(here, by)
    _figure(scored, docs / "images" / "field-study.svg")
    if (rows / "episodes.csv").exists():
        episodes = pd.read_csv(rows / "episodes.csv")
        episodes.to_csv(docs / "studies" / "field-episodes.csv", index=False)
        yield pursuit_table(episodes)


def table(scored: pd.DataFrame) -> str:
    """Log-score, its distance from the kernel estimate's with a 95 % interval over tasks, and coverage, by seconds ahead."""
    lines = []
    for model, own in scored.groupby("model", sort=False):
        cells: list[str] = [str(model)]
        for ahead, part in own.groupby("ahead"):
            best = scored[(scored.model == CEILING) & (scored.ahead == ahead)]
            low, mean, high = _gap(part, best)
            cells += [f"{_mean(part):.2f}", f"{mean:+.2f} [{low:+.2f}, {high:+.2f}]", f"{_mean(part, 'covered'):.2f}"]
        lines.append(cells)
    head = ["model"] + [
        f"{h} {s:g} s" for s in sorted(scored.ahead.unique()) for h in ("nats", "to ceiling", "in 90 %")
    ]
    return markdown(head, lines)


def _mean(part: pd.DataFrame, column: str = "log_score") -> float:
    return float(np.average(part[column], weights=part.n))


def _gap(part: pd.DataFrame, best: pd.DataFrame) -> tuple[float, float, float]:
    """Mean difference over the tasks that both were scored on, with a bootstrap interval."""
    key = ["mission", "family", "slack", "index"]
    both = part.merge(best, on=key, suffixes=("", "_best"))
    difference, weight = (both.log_score - both.log_score_best).to_numpy(), both.n.to_numpy(dtype=float)
    if len(both) == 0:
        return np.nan, np.nan, np.nan
    drawn = np.random.default_rng(0).integers(len(both), size=(RESAMPLES, len(both)))
    means = (difference[drawn] * weight[drawn]).sum(axis=1) / weight[drawn].sum(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(np.average(difference, weights=weight)), float(high)


def _wide(scored: pd.DataFrame, by: str) -> str:
    values = sorted(scored[by].unique())
    lines = [
        [str(model), *(f"{_mean(part):.2f}" for _, part in own.groupby(by))]
        for model, own in scored.groupby("model", sort=False)
        if own[by].nunique() == len(values)
    ]
    return markdown(["model", *(f"{by} {value}" for value in values)], lines)


def markdown(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table for a page."""
    rows = [head, ["---"] * len(head), *lines]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def pursuit_table(episodes: pd.DataFrame) -> str:
    """ATCR and StI per field, mission and family, over the episodes that every field could be solved for."""
    played = episodes[episodes.error.isna() | (episodes.error == "")]
    lines = []
    for (field, mission, family), part in played.groupby(["field", "mission", "family"], sort=False):
        missed = share(part.completed)
        lines.append(
            [
                str(field), str(mission), str(family), str(len(part)), f"{100 * missed.value:.1f} [{100 * missed.low:.0f}, {100 * missed.high:.0f}]",
                f"{part.physics_steps.mean():.0f}", f"{part.milliseconds.mean():.0f}",
            ]
        )  # fmt: skip
    return markdown(["field", "mission", "family", "episodes", "ATCR %", "StI", "ms a decision"], lines)


def _figure(scored: pd.DataFrame, path: Path) -> None:
    """Left: log-score by seconds ahead, from the start and after watching. Right: how often the 90 % set holds."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 4.4), layout="constrained")
    axes = figure.subplots(1, 3)
    for axis, watched, title in ((axes[0], 0.0, "from the start"), (axes[1], 5.0, "after 5 s of cameras")):
        for name, colour in SHOWN.items():
            own = scored[(scored.model == name) & (scored.watched == watched)]
            points = [(ahead, _mean(part)) for ahead, part in own.groupby("ahead")]
            style = "--" if name == CEILING else "-"
            axis.plot(*zip(*points, strict=True), style, marker="o", color=colour, label=name, lw=1.8, ms=4)
        axis.set(title=title, xlabel="seconds ahead", ylabel="log-likelihood, nats" if watched == 0 else "")
        axis.set_xticks([2, 5, 10])
    axes[2].axhline(LEVEL, color="#111111", lw=0.8, ls=":")
    for name, colour in SHOWN.items():
        own = scored[(scored.model == name) & (scored.watched == 0.0)]
        points = [(ahead, _mean(part, "covered")) for ahead, part in own.groupby("ahead")]
        axes[2].plot(*zip(*points, strict=True), "--" if name == CEILING else "-", marker="o", color=colour, lw=1.8, ms=4)  # fmt: skip
    axes[2].set(title="in the 90 % set, from the start", xlabel="seconds ahead", ylim=(0, 1))
    axes[2].set_xticks([2, 5, 10])
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
