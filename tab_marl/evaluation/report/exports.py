"""The report's tables as Markdown and as LaTeX (booktabs), from the same results as the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tab_marl.evaluation import tables
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.report import numbers
from tab_marl.evaluation.report.numbers import Shown
from tab_marl.evaluation.report.paper import PAPER
from tab_marl.evaluation.report.results import Results
from tab_marl.evaluation.settings import HEADLINE, MISSIONS, PAPER_PLANNERS, short
from tab_marl.evaluation.tables import Share

KINDS = ("md", "tex")
PART_CAPTION = {
    "adversary": "by adversary",
    "style": "by style of adversary",
    "split": "by split of the zoo",
    "slack_bin": "by slack (allowed over shortest time)",
}


@dataclass(frozen=True)
class Table:
    """A table as text: the first `left` columns are words, the others figures."""

    name: str
    """Of the file, without its ending."""
    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    bold: frozenset[int] = frozenset()
    """Rows of TAB-POMCP."""
    breaks: frozenset[int] = frozenset()
    """Rows that begin a group."""
    left: int = 1


def export_tables(results: Results, folder: Path, kinds: Sequence[str]) -> list[Path]:
    """Write every table in every kind ("md", "tex"); returns the files. Raises UserError if one cannot be written."""
    writers = {"md": markdown, "tex": latex}
    written = []
    for table in all_tables(results):
        for kind in kinds:
            path = folder / f"{table.name}.{kind}"
            try:
                folder.mkdir(parents=True, exist_ok=True)
                path.write_text(writers[kind](table), encoding="utf-8")
            except OSError as error:
                raise UserError(f"{path}: the table cannot be written: {error.strerror}") from None
            written.append(path)
    return written


def all_tables(results: Results) -> list[Table]:
    """Results, the paper's beside ours, aggregates, seconds, parts and decision times."""
    found = []
    for family in dict.fromkeys(line.family for line in results.lines):
        found.append(_results(results, family))
        found.append(_aggregates(results, family))
    beside = _beside(results)
    if beside.rows:
        found.append(beside)
    for column, shares in results.by.items():
        found += [_parts(column, family, shares) for family in dict.fromkeys(s.family for s in shares)]
    paces = tables.paces(results.timings)
    if paces:
        found.append(
            Table(
                "decision-times",
                "Milliseconds per decision: mean, the slowest of an episode below which 95 % of episodes stay, the slowest of "
                "all, and the mean relative to S-POMCP.",
                ("Planner", "decisions", "mean", "95 %", "slowest", "ratio"),
                tuple(
                    (p.planner, str(p.decisions), f"{p.mean_milliseconds:.1f}", f"{p.p95_milliseconds:.0f}",
                     f"{p.worst_milliseconds:.0f}", f"{p.ratio:.2f}" if p.ratio else "")
                    for p in paces
                ),
                frozenset(i for i, p in enumerate(paces) if p.planner == HEADLINE),
            )
        )  # fmt: skip
    return found


def _text(shown: Shown | None) -> str:
    if shown is None:
        return ""
    p = f", p {shown.p if shown.p.startswith('<') else '= ' + shown.p}" if shown.p else ""
    return f"{shown.value} {shown.interval}{p}"


def _results(results: Results, family: str) -> Table:
    lines = [x for x in results.lines if x.family == family]
    rows = [
        (
            x.mission, x.planner, str(x.episodes), _text(numbers.percent(x.atcr)), _text(numbers.steps(x.steps)),
            _text(numbers.difference(x.atcr_against_headline, 100.0)), _text(numbers.difference(x.steps_against_headline)),
        )
        for x in lines
    ]  # fmt: skip
    return Table(
        f"results-{family}",
        f"Family {family}: ATCR (share of missions completed before interception) and StI (steps of 10 ms to interception, "
        "censored at the horizon) with 95 % bootstrap intervals, and paired differences against TAB-POMCP (positive: "
        "TAB-POMCP is better) with exact McNemar and Wilcoxon signed-rank p-values after Holm's correction. "
        "† all episodes alike: exact binomial interval.",
        ("Mission", "Planner", "n", "ATCR %", "StI", "ATCR − TAB, points", "StI − TAB, steps"),
        tuple(rows),
        frozenset(i for i, x in enumerate(lines) if x.planner == HEADLINE),
        frozenset(i for i, x in enumerate(lines) if i and x.mission != lines[i - 1].mission),
        2,
    )


def _beside(results: Results) -> Table:
    ours = {(x.mission, x.planner): x for x in results.lines if x.family == "point"}
    missions = [m for m in MISSIONS if any((m, p) in ours for p in PAPER_PLANNERS)]
    rows = []
    for m in missions:
        lines = [ours.get((m, p)) for p in PAPER_PLANNERS]
        rows.append(
            (m, "here", *(f"{100 * x.atcr.value:.1f}" if x else "" for x in lines), *(f"{x.steps.value:.0f}" if x else "" for x in lines))
        )  # fmt: skip
        rows.append(("", "paper", *(f"{PAPER[m, p].atcr_percent}" for p in PAPER_PLANNERS), *(f"{PAPER[m, p].steps}" for p in PAPER_PLANNERS)))  # fmt: skip
        rows.append(
            ("", "paper, underwater", *(f"{PAPER[m, p].underwater_atcr_percent}" for p in PAPER_PLANNERS), *("",) * 4)
        )
    names = [short(p) for p in PAPER_PLANNERS]
    return Table(
        "beside-the-paper",
        "The paper's tables (L4DC 2025, its own unpublished arena) and what was measured here (family point): compare the "
        "order of the planners, not the size of the figures.",
        ("Mission", "Source", *(f"ATCR {n}" for n in names), *(f"StI {n}" for n in names)),
        tuple(rows),
        breaks=frozenset(range(3, len(rows), 3)),
        left=2,
    )


def _aggregates(results: Results, family: str) -> Table:
    part = results.aggregates[results.aggregates["family"] == family]
    means = results.restricted[results.restricted["family"] == family]
    missions = tables.order(means["mission"], MISSIONS)
    seconds: dict[tuple[str, str], Any] = {(str(r.mission), str(r.planner)): r for r in means.itertuples()}
    rows = []
    rows_of: Any = part.itertuples()
    for r in rows_of:
        improvement = f"{r.improvement:.2f}" if r.improvement == r.improvement else ""
        cells = [f"{s.mean_seconds:.1f}" if (s := seconds.get((m, r.planner))) else "" for m in missions]
        rows.append((str(r.planner), str(r.episodes), _text(numbers.score(r.iqm, r.low, r.high)), improvement, *cells))
    return Table(
        f"aggregates-{family}",
        f"Family {family}: interquartile mean of the score 1 − StI / horizon with 95 % stratified bootstrap interval, the "
        "probability that an episode of TAB-POMCP scores higher, and mean seconds to interception per mission, restricted to "
        "its median horizon (area under the Kaplan-Meier curve).",
        ("Planner", "n", "IQM", "P(TAB higher)", *(f"{m}, s" for m in missions)),
        tuple(rows),
        frozenset(i for i, row in enumerate(rows) if row[0] == HEADLINE),
    )


def _parts(column: str, family: str, shares: Sequence[Share]) -> Table:
    part = [s for s in shares if s.family == family]
    planners = list(dict.fromkeys(s.planner for s in part))
    cells = {(s.part, s.planner): s for s in part}
    rows = []
    for name in dict.fromkeys(s.part for s in part):
        found = [cells.get((name, p)) for p in planners]
        count = max(s.atcr.count for s in found if s)
        rows.append((name, str(count), *(_text(numbers.percent(s.atcr)) if s else "" for s in found)))
    return Table(
        f"{column.replace('_bin', '')}-{family}",
        f"Family {family}, ATCR {PART_CAPTION[column]}, % with 95 % intervals; n episodes per planner.",
        (column.removesuffix("_bin").capitalize(), "n", *(short(p) for p in planners)),
        tuple(rows),
    )


def markdown(table: Table) -> str:
    """A pipe table under its caption."""

    def line(cells: Sequence[str], bold: bool = False) -> str:
        shown = [c.replace("|", "\\|") for c in cells]
        return "| " + " | ".join(f"**{c}**" if bold and c else c for c in shown) + " |"

    rule = ["---" if i < table.left else "---:" for i in range(len(table.header))]
    body = [line(row, i in table.bold) for i, row in enumerate(table.rows)]
    return "\n".join([table.caption, "", line(table.header), line(rule), *body, ""])


_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$", "−": "$-$", "†": r"$^\dagger$",
    "–": "--", "’": "'", "τ": r"$\tau$",
}  # fmt: skip


def escape_latex(text: str) -> str:
    """Text as LaTeX prints it; a minus before a digit becomes a mathematical one."""
    out = []
    for i, character in enumerate(text):
        if character == "-" and text[i + 1 : i + 2].isdigit() and (i == 0 or not text[i - 1].isalnum()):
            out.append("$-$")
        else:
            out.append(_LATEX.get(character, character))
    return "".join(out)


def latex(table: Table) -> str:
    """A booktabs table with caption and label, to be \\input into a paper."""
    columns = "l" * table.left + "r" * (len(table.header) - table.left)

    def line(cells: Sequence[str], bold: bool = False) -> str:
        # Braces in front: a cell that begins with a bracket would be read as an option of the line break before it.
        shown = [escape_latex(c) for c in cells]
        return " & ".join(f"\\textbf{{{c}}}" if bold and c else ("{}" + c if c.startswith("[") else c) for c in shown)

    body = []
    for i, row in enumerate(table.rows):
        if i in table.breaks:
            body.append("\\midrule")
        body.append(line(row, i in table.bold) + " \\\\")
    return "\n".join(
        [
            "% needs \\usepackage{booktabs}", "\\begin{table}", "\\centering\\footnotesize",
            f"\\caption{{{escape_latex(table.caption)}}}", f"\\label{{tab:{table.name}}}",
            f"\\begin{{tabular}}{{{columns}}}", "\\toprule", line(table.header) + " \\\\", "\\midrule", *body,
            "\\bottomrule", "\\end{tabular}", "\\end{table}", "",
        ]
    )  # fmt: skip
