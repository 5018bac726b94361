"""What being hunted does: completion against live planners on held-out tasks, habit by habit, and under learned mixtures.

    python scripts/study_hunted.py --episodes 60 runs/population/hunted-fp/policy runs/population/hunted-tab/policy

The first policy plays every habit; the mixtures are those of all policies named. Rows go to docs/adversaries/hunted.csv (what
stands there is kept), the table into docs/adversaries/hunted.md, the figure to docs/images/hunted.svg.
"""

from __future__ import annotations

import csv
from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
import numpy as np
import typer
from rich.console import Console

from tab_marl.agents.hunted.study import HuntedRow, Unhunted, entropy_bits, habits_of, study, unhunted, values
from tab_marl.agents.policies.zoo import find_policy, load_policy
from tab_marl.envs.styles import STYLES, Style

ROOT = Path(__file__).resolve().parent.parent
ROWS = ROOT / "docs" / "adversaries" / "hunted.csv"
PAGE = ROOT / "docs" / "adversaries" / "hunted.md"
BEGIN, END = "<!-- study_hunted.py writes from here -->", "<!-- to here -->"
UNOPPOSED_TASKS = 30
FIGURE = ROOT / "docs" / "images" / "hunted.svg"
COLOURS = ("#1f77b4", "#d62728", "#7f7f7f")


def main(
    policies: Annotated[list[str], typer.Argument(help="Zoo names, or folders of policies.")],
    episodes: Annotated[int, typer.Option(help="Tasks: one episode per habit and ego on each.")] = 60,
    egos: Annotated[str, typer.Option(help="Comma-separated.")] = "FP-POMCP,TAB-POMCP",
    family: str = "ambiguous",
    seed: int = 4242,
    seen_metres: Annotated[float, typer.Option(help="Range in which the adversary sees the ego; 0: blind.")] = 0.0,
    rows: Annotated[Path, typer.Option(help="CSV file.")] = ROWS,
) -> None:
    console = Console()
    found = [load_policy(given) if Path(given).is_dir() else find_policy(given) for given in policies]

    def keep(block: list[HuntedRow]) -> None:
        _append(block, rows)
        console.print(f"{block[-1].ego}: task {block[-1].task + 1} of {episodes}")

    before = [row for row in _read(rows) if (row.family, row.sees_ego) == (family, seen_metres > 0)]
    for ego in egos.split(","):
        first = 1 + max((row.task for row in before if row.ego == ego), default=-1)
        study(habits_of(found[0]), family, episodes, [ego], seed, seen_metres, on_block=keep, first=first)
    mixtures = {"direct": STYLES["direct"], "even": STYLES["habits"]} | {policy.name: policy.style for policy in found}
    played = [row for row in _read(rows) if (row.family, row.sees_ego) == (family, seen_metres > 0)]
    alone = {name: unhunted(found[0], style, family, UNOPPOSED_TASKS, seed) for name, style in mixtures.items()}
    table = _table(played, mixtures, alone)
    console.print(table)
    _write(table)
    _draw(played, mixtures)


def _append(rows: list[HuntedRow], path: Path) -> None:
    known = {_key(row) for row in _read(path)}
    path.parent.mkdir(parents=True, exist_ok=True)
    new = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(HuntedRow)], lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerows(asdict(row) for row in rows if _key(row) not in known)


def _key(row: HuntedRow) -> tuple[str, str, str, int, bool]:
    return row.policy, row.ego, row.family, row.task, row.sees_ego


def _read(path: Path) -> list[HuntedRow]:
    if not path.exists():
        return []
    with path.open(encoding="utf-8") as file:
        return [
            HuntedRow(
                row["policy"], row["style"], row["ego"], row["mission"], row["family"], int(row["task"]),
                *(row[name] == "True" for name in ("sees_ego", "completed", "caught")), float(row["seconds"]),
            )
            for row in csv.DictReader(file)
        ]  # fmt: skip


def _table(rows: list[HuntedRow], mixtures: dict[str, Style], alone: dict[str, Unhunted]) -> str:
    """The results as Markdown."""
    found = values(rows, mixtures)
    egos = sorted({row.ego for row in rows})
    tasks = {ego: len({row.task for row in rows if row.ego == ego}) for ego in egos}
    head = ["habits", "entropy, bits", *(f"hunted by {ego}: completed, % (gain over even)" for ego in egos)]
    head += ["unopposed, %", "shortest way's side, %", "nearest last goal, %", "length / shortest"]
    lines = [" | ".join(head), " | ".join("---" for _ in head)]
    for name, style in mixtures.items():
        cells = [name, f"{entropy_bits(style):.2f}"]
        for ego in egos:
            v = found[name, ego]
            gain = (
                "" if name == "even" else f" ({100 * v.gain:+.1f}; {100 * v.gain_low:+.1f} to {100 * v.gain_high:+.1f})"
            )
            cells.append(f"{100 * v.share:.1f} [{100 * v.low:.1f}, {100 * v.high:.1f}]{gain}")
        a = alone[name]
        cells += [
            f"{100 * a.completed:.0f}",
            f"{100 * a.same_side:.0f}",
            f"{100 * a.same_last_goal:.0f}",
            f"{a.stretch:.2f}",
        ]
        lines.append(" | ".join(cells))
    played = ", ".join(f"{tasks[ego]} tasks against {ego}" for ego in egos)
    note = (
        f"{played}; {len(STYLES['habits'].mixture)} episodes on each, one per habit. In square brackets and after the semicolon: "
        "95 % intervals, bootstrapped over tasks."
    )
    return "\n".join(f"| {line} |" for line in lines) + f"\n\n{note}\n"


def _write(table: str) -> None:
    """Replace the page's table."""
    text = PAGE.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    PAGE.write_text(f"{before}{BEGIN}\n\n{table}\n{END}{after}", encoding="utf-8")


def _draw(rows: list[HuntedRow], mixtures: dict[str, Style]) -> None:
    """Completed missions habit by habit, and under the mixtures."""
    egos = sorted({row.ego for row in rows})
    names = [habit.style.name for habit in STYLES["habits"].mixture]
    single = values(rows, {name: habit.style for name, habit in zip(names, STYLES["habits"].mixture, strict=True)})
    mixed = values(rows, mixtures)
    figure, axes = plt.subplots(1, 2, figsize=(9.6, 3.6), sharex=True, gridspec_kw={"width_ratios": [1.2, 1]})
    for axis, labels, cells, title in (
        (axes[0], names, single, "one habit"),
        (axes[1], list(mixtures), mixed, "mixtures"),
    ):
        for i, ego in enumerate(egos):
            y = np.arange(len(labels)) + 0.36 * (i - 0.5 * (len(egos) - 1))
            shares = np.array([100 * cells[label, ego].share for label in labels])
            ends = np.array([[100 * cells[label, ego].low, 100 * cells[label, ego].high] for label in labels]).T
            axis.barh(y, shares, 0.34, color=COLOURS[i % len(COLOURS)], label=f"hunted by {ego}")
            axis.hlines(y, ends[0], ends[1], color="black", lw=1)
        axis.set_yticks(range(len(labels)), labels)
        axis.invert_yaxis()
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("missions completed before being caught, %")
        axis.spines[["top", "right"]].set_visible(False)
    axes[1].legend(frameon=False, fontsize=8)
    figure.tight_layout()
    FIGURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(FIGURE, metadata={"Date": None})
    plt.close(figure)


if __name__ == "__main__":
    typer.run(main)
