"""Keep runs as the project's published result: ``python scripts/publish_results.py --out runs/paper --control runs/perimeter``.

Writes their rows (compressed CSV) and figures into docs/results, and fills the tables between the marks of docs/results/README.md
and of the README. What the tables mean is written there by hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

import tab_marl
from tab_marl.evaluation import decision_times, statistics
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.export import export
from tab_marl.evaluation.population_study import put_tables
from tab_marl.evaluation.provenance import describe_runs
from tab_marl.evaluation.report import exports, plots
from tab_marl.evaluation.report.present import describe_adversaries
from tab_marl.evaluation.report.results import ReportData, Results, compute
from tab_marl.evaluation.rows import EpisodeRow
from tab_marl.evaluation.settings import COMPETING_PLANNERS, HEADLINE, PLANNERS, short
from tab_marl.evaluation.store import Store, StoredSettings
from tab_marl.evaluation.tables import ALL

CEILING = "population-POMCP"
RECORDED = ("started", "ended", "episodes", "engine", "machine", "commit", "code", "versions", "zoo")


def main(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the run.")] = Path("runs/paper"),
    control: Annotated[Path, typer.Option(help="Folder of the run of family perimeter.")] = Path("runs/perimeter"),
    docs: Annotated[Path, typer.Option(help="Folder of the pages.")] = Path("docs"),
    readme: Annotated[Path, typer.Option(help="The page with the short table.")] = Path("README.md"),
) -> None:
    """Write rows, figures and tables of the latest settings that were played there."""
    folder = docs / "results"
    found = published(out, folder, "episodes")
    found |= {f"control-{name}": table for name, table in published(control, folder, "perimeter").items()}
    for path in (folder / "README.md", readme):
        text = path.read_text(encoding="utf-8")
        marked = {name: table for name, table in found.items() if f"<!-- begin {name} -->" in text}
        path.write_text(put_tables(text, marked), encoding="utf-8")
        print(f"{path}: {', '.join(marked)}")


def published(out: Path, folder: Path, rows_name: str) -> dict[str, str]:
    """The tables of a run by name, as Markdown; its rows and figures go into the folder. Raises UserError."""
    with Store.open(out) as store:
        known = [s for s in store.settings() if s.rows]
        if not known:
            raise UserError(f"{out}: no episode is stored here yet; run tab-marl evaluate")
        stored = known[0]
        rows, timings = store.rows(stored.key), store.timings(stored.key)
        count, checksum = export(store, stored.key, "csv", folder / f"{rows_name}.csv.xz")
        runs = [{key: run[key] for key in RECORDED} for run in describe_runs(store.runs(stored.key))]
    cards = describe_adversaries(stored.content["adversaries"])
    results = compute(ReportData(rows, timings, stored.content, stored.key, (), None, cards, tab_marl.__version__, {}))
    plots.export_figures(results, folder, ["svg"])
    found = {table.name: exports.markdown(table).strip() for table in exports.all_tables(results)}
    found["summary"] = summary(results)
    found["ceiling"] = ceiling(rows)
    found["record"] = record(stored, runs, count, checksum)
    found["time"] = "```text\n" + "\n".join(decision_times.summary(timings)) + "\n```"
    return found


def summary(results: Results) -> str:
    """All missions together: a line per family and measure, a column per planner."""
    lines = {(x.family, x.planner): x for x in results.lines if x.mission == ALL}
    planners = [p for p in PLANNERS if any(planner == p for _, planner in lines)]
    names = [f"**{short(p)}**" if p == HEADLINE else short(p) for p in planners]
    table = ["|  | " + " | ".join(names) + " |", "| --- |" + " ---: |" * len(names)]
    for family in dict.fromkeys(family for family, _ in lines):
        mine = [lines[family, p] for p in planners]
        shares = [f"{100 * x.atcr.value:.1f} [{100 * x.atcr.low:.0f}, {100 * x.atcr.high:.0f}]" for x in mine]
        steps = [f"{x.steps.value:.0f} [{x.steps.low:.0f}, {x.steps.high:.0f}]" for x in mine]
        table.append(f"| `{family}`, ATCR % | " + " | ".join(shares) + " |")
        table.append(f"| `{family}`, StI | " + " | ".join(steps) + " |")
    return "\n".join(table)


def ceiling(rows: Sequence[EpisodeRow]) -> str:
    """How far TAB-POMCP, alone and with precedents, is from population-POMCP: a line per family and mission."""
    table = statistics.paired_differences(statistics.frame(rows), CEILING)
    ours = [p for p in COMPETING_PLANNERS if p.startswith(HEADLINE)]
    lines = {
        key: part.set_index(["metric", "planner"]) for key, part in table.groupby(["family", "mission"], sort=False)
    }
    head = [f"{measure}, {short(p)}" for measure in ("ATCR", "StI") for p in ours]
    text = ["| Family | Mission | " + " | ".join(head) + " |", "| --- | --- |" + " ---: |" * len(head)]
    for (family, mission), part in lines.items():
        cells = []
        for measure, scale, digits in (("ATCR", 100, 1), ("StI", 1, 0)):
            for one in (part.loc[measure, p] for p in ours):
                value, low, high = (scale * one[k] for k in ("difference", "low", "high"))
                cells.append(f"{value:+.{digits}f} [{low:+.0f}, {high:+.0f}]")
        text.append(f"| `{family}` | {mission} | " + " | ".join(cells) + " |")
    return "\n".join(text)


def record(stored: StoredSettings, runs: list[dict[str, str]], count: int, checksum: str) -> str:
    """What was run, on what, and the checksum of its rows."""
    table = ["| | |", "| --- | --- |", f"| rows | {count} |", f"| sha256 of the rows | `{checksum}` |"]
    table.append(f"| settings | `{stored.key}` |")
    for run in runs:
        table += [f"| {key} | {value} |" for key, value in run.items()]
    return "\n".join(table)


if __name__ == "__main__":
    typer.run(main)
