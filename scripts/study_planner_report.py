"""Tables and the figure of the planner study, from its rows alone: ``python scripts/study_planner_report.py rows.csv``."""

from __future__ import annotations

import csv
from collections import defaultdict
from pathlib import Path
from typing import Annotated

import matplotlib
import numpy as np
import typer

from tab_marl.evaluation.statistics import paired_shares, paired_steps, share, stars

matplotlib.use("Agg")
import matplotlib.pyplot as plt

Row = dict[str, str]
Cell = dict[str, dict[int, Row]]
"""Rows by variant and seed."""
PARTS = ("belief_ms", "sampling_ms", "valuation_ms", "search_ms")
LINES = {"population": "#2a9d8f", "oracle": "#6c757d"}
DASHES = {"population": "-", "oracle": "--"}
MARKS = {
    "er": ("er", "#e07a1f", "s"),
    "routes": ("routes", "#8e5bb5", "D"),
    "TAB-POMCP": ("TAB-POMCP: drawn ways beside the field", "#c0392b", "P"),
}


def read(rows: Path) -> dict[tuple[str, str], Cell]:
    """(family, mission) -> its rows."""
    cells: dict[tuple[str, str], Cell] = defaultdict(lambda: defaultdict(dict))
    with rows.open(newline="") as file:
        for row in csv.DictReader(file):
            cells[row["family"], row["mission"]][row["variant"]][int(row["seed"])] = row
    return cells


def pooled(cells: list[Cell]) -> Cell:
    """Missions side by side, as one cell."""
    together: Cell = defaultdict(dict)
    for number, cell in enumerate(cells):
        for variant, rows in cell.items():
            together[variant].update({(number << 32) + seed: row for seed, row in rows.items()})
    return together


def column(rows: dict[int, Row], name: str, seeds: list[int] | None = None) -> np.ndarray:
    return np.array([float(rows[seed][name]) for seed in (seeds or sorted(rows))])


def milliseconds(rows: dict[int, Row]) -> np.ndarray:
    """``[4]`` mean parts of a decision, each decision counted once."""
    weights = column(rows, "decisions")
    return np.array([np.average(column(rows, part), weights=weights) for part in PARTS])


def lines_of(title: str, cell: Cell, against: str) -> list[str]:
    """The table of one cell."""
    names = " ".join(f"{name:>6}" for name in ("StI", "ms", "belief", "paths", "values", "tree"))
    differences = f"{'ATCR - reference, points':>31} {'StI - reference':>29}"
    lines = [title, f"  {'variant':<32} {'n':>4} {'ATCR % [95 %]':>19} {names} {differences}"]
    reference = cell.get(against, {})
    for variant, rows in cell.items():
        atcr, spent = share(column(rows, "completed")), milliseconds(rows)
        text = (
            f"  {variant:<32} {len(rows):>4} {100 * atcr.value:>6.1f} [{100 * atcr.low:>4.1f}, {100 * atcr.high:>4.1f}] "
            f"{column(rows, 'physics_steps').mean():>6.0f} {spent.sum():>6.1f} "
            + " ".join(f"{part:>6.1f}" for part in spent)
        )
        both = sorted(set(rows) & set(reference))
        if variant != against and both:
            missed = paired_shares(column(rows, "completed", both), column(reference, "completed", both))
            steps = paired_steps(column(rows, "physics_steps", both), column(reference, "physics_steps", both))
            d, s = missed.difference, steps.difference
            text += (
                f"   {100 * d.value:>+5.1f} [{100 * d.low:>+5.1f}, {100 * d.high:>+5.1f}] p {stars(missed.p_value):>6}"
                f"  {s.value:>+5.0f} [{s.low:>+5.0f}, {s.high:>+5.0f}] p {stars(steps.p_value):>6}"
            )
        lines.append(text)
    return lines


def draw(panels: list[tuple[str, Cell]], out: Path) -> None:
    """ATCR against the milliseconds of a decision, over the seeds that all of a panel's variants played."""
    plt.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "tab_marl", "font.size": 9})
    figure, axes = plt.subplots(1, len(panels), figsize=(3.3 * len(panels), 3.1), sharey=True, layout="constrained")
    for axis, (title, cell) in zip(np.atleast_1d(axes), panels, strict=True):
        trees = sorted(
            (v for v in cell if v.startswith("tree ") and v.endswith("ms")), key=lambda v: float(v.split()[1])
        )
        shown = [v for v in (*trees, *LINES, *MARKS) if v in cell]
        seeds = sorted(set.intersection(*(set(cell[v]) for v in shown)))
        missed = {v: share(column(cell[v], "completed", seeds)) for v in shown}
        for variant, colour in LINES.items():
            if variant in missed:
                axis.axhline(100 * missed[variant].value, color=colour, lw=1.5, ls=DASHES[variant], label=variant)
        x = [milliseconds(cell[v]).sum() for v in trees]
        y = [100 * missed[v].value for v in trees]
        bars = [
            [100 * (missed[v].value - missed[v].low) for v in trees],
            [100 * (missed[v].high - missed[v].value) for v in trees],
        ]
        axis.errorbar(
            x, y, yerr=bars, color="#1d5fa8", marker="o", ms=4, lw=1.5, capsize=2, label="tree, the field alone"
        )
        for variant, (name, colour, marker) in MARKS.items():
            if variant in missed:
                spent = milliseconds(cell[variant]).sum()
                axis.plot(spent, 100 * missed[variant].value, marker, color=colour, ms=6, ls="none", label=name)
        axis.set(xscale="log", title=f"{title}, n = {len(seeds)}", xlabel="milliseconds a decision")
        axis.set(xlim=(1, 1500), ylim=(-2, 45), xticks=[1, 10, 100, 1000], xticklabels=["1", "10", "100", "1,000"])
        axis.grid(alpha=0.25)
    handles, labels = np.atleast_1d(axes)[0].get_legend_handles_labels()
    np.atleast_1d(axes)[-1].legend(handles, labels, fontsize=8, frameon=False, loc="upper left")
    np.atleast_1d(axes)[0].set_ylabel("ATCR, % (lower is better)")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, metadata={"Date": None} if out.suffix == ".svg" else None, dpi=130)


def main(
    rows: Annotated[Path, typer.Argument()] = Path("docs/studies/planner.csv"),
    figure: Annotated[Path | None, typer.Option(help="to draw; none without")] = None,
    reference: Annotated[str, typer.Option(help="variant that the others are compared with")] = "tree 20 ms",
) -> None:
    cells = read(rows)
    families = sorted({family for family, _ in cells})
    panels = [(f"{f} {m}", cells[f, m]) for f, m in sorted(cells) if f == "ambiguous"]
    panels += [
        (
            f"{f}, {len([c for c in cells if c[0] == f])} missions",
            pooled([cells[c] for c in sorted(cells) if c[0] == f]),
        )
        for f in families
        if f != "ambiguous"
    ]
    print(f"reference: {reference}; differences are over the seeds both played")
    for title, cell in [(f"{f} {m}", cells[f, m]) for f, m in sorted(cells)] + [
        (f"{f}, all", pooled([cells[c] for c in sorted(cells) if c[0] == f])) for f in families
    ]:
        print("\n".join(lines_of(title, cell, reference)))
    if figure is not None:
        draw(panels, figure)


if __name__ == "__main__":
    typer.run(main)
