"""What being hunted does: completion against live planners on held-out tasks, of policies under the habits that they learned,
under even ones, and under none.

    python scripts/study_hunted.py --episodes 120 hunted-fp hunted-tab

Writes a row per episode to docs/adversaries/hunted.csv (rows that are there already are kept), and draws
docs/images/hunted.svg. Every row depends on its task, policy, habits and ego alone.
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
from rich.table import Table

from tab_marl.agents.hunted_study import HuntedRow, entropy_bits, shares, study, styles_of, unhunted
from tab_marl.agents.zoo import find_policy, load_policy

ROOT = Path(__file__).resolve().parent.parent
ROWS = ROOT / "docs" / "adversaries" / "hunted.csv"
FIGURE = ROOT / "docs" / "images" / "hunted.svg"
COLOURS = {"direct": "#7f7f7f", "even": "#9ecae1", "learned": "#d62728"}


def main(
    policies: Annotated[list[str], typer.Argument(help="Zoo names, or folders of policies.")],
    episodes: Annotated[int, typer.Option(help="Per policy, habits and ego.")] = 120,
    egos: Annotated[str, typer.Option(help="Comma-separated.")] = "FP-POMCP,TAB-POMCP",
    family: str = "ambiguous",
    seed: int = 4242,
    seen_metres: Annotated[float, typer.Option(help="Range in which the adversary sees the ego; 0: blind.")] = 0.0,
    rows: Annotated[Path, typer.Option(help="CSV file.")] = ROWS,
) -> None:
    console = Console()
    players = {}
    for i, given in enumerate(policies):
        policy = load_policy(given) if Path(given).is_dir() else find_policy(given)
        for kind, style in styles_of(policy).items():
            # The others' weights differ from the first one's by their seed alone.
            if i == 0 or kind == "learned":
                players[f"{policy.name}, {kind}"] = (policy, style)
    for name, (policy, style) in players.items():
        console.print(f"{name}: {entropy_bits(style):.2f} bits; unopposed {unhunted(policy, style, family, 100, seed)}")

    def keep(block: list[HuntedRow]) -> None:
        _append(block, rows)
        console.print(f"task {block[-1].task + 1} of {episodes}")

    study(players, family, episodes, egos.split(","), seed, seen_metres, on_block=keep)
    everything = _read(rows)
    console.print(_table(everything))
    _draw(everything)


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


def _table(rows: list[HuntedRow]) -> Table:
    table = Table("policy", "ego", "family", "sees the ego", "completed", "episodes", "95 %")
    groups = sorted({(row.family, row.sees_ego) for row in rows})
    for family, sees in groups:
        mine = [row for row in rows if (row.family, row.sees_ego) == (family, sees)]
        for (policy, ego), (done, n, low, high) in sorted(shares(mine).items()):
            table.add_row(
                policy, ego, family, "yes" if sees else "no", f"{100 * done / n:.1f} %", str(n),
                f"{100 * low:.1f} to {100 * high:.1f}",
            )  # fmt: skip
    return table


def _draw(rows: list[HuntedRow]) -> None:
    """Completed missions by policy, habits and ego, blind adversaries, where the goal is open."""
    cells = shares([row for row in rows if row.family == "ambiguous" and not row.sees_ego])
    egos = sorted({ego for _, ego in cells})
    names = sorted({policy.split(", ")[0] for policy, _ in cells})
    figure, axes = plt.subplots(1, len(egos), figsize=(4.2 * len(egos), 3.0), sharey=True, squeeze=False)
    for axis, ego in zip(axes[0], egos, strict=True):
        for j, (kind, colour) in enumerate(COLOURS.items()):
            for i, name in enumerate(names):
                if (f"{name}, {kind}", ego) not in cells:
                    continue
                done, n, low, high = cells[f"{name}, {kind}", ego]
                share, x = done / n, i + 0.26 * (j - 1)
                axis.bar(x, 100 * share, 0.24, color=colour, label=kind if i == 0 else None)
                axis.errorbar(
                    x, 100 * share, 100 * np.array([[share - low], [high - share]]), color="black", lw=1, capsize=2
                )  # fmt: skip
        axis.set_xticks(range(len(names)), names)
        axis.set_title(f"hunted by {ego}", fontsize=10)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0][0].set_ylabel("missions completed, %")
    axes[0][-1].legend(title="habits", frameon=False, fontsize=8, title_fontsize=8)
    figure.tight_layout()
    FIGURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(FIGURE, metadata={"Date": None})
    plt.close(figure)


if __name__ == "__main__":
    typer.run(main)
