"""What the figures say, in sentences. Each is derived from an interval; none is written by hand."""

from __future__ import annotations

from collections.abc import Sequence

from tab_marl.evaluation.settings import HEADLINE, PAPER_PLANNERS, short
from tab_marl.evaluation.tables import ALL, Line

FEW = 30
"""Below this many episodes per line the report says that they decide little."""


def findings(lines: Sequence[Line]) -> list[tuple[str, list[str]]]:
    """(heading, sentences): per family one on ATCR and one on StI, then warnings about what the rows cannot tell."""
    found: list[tuple[str, list[str]]] = []
    for family in dict.fromkeys(line.family for line in lines):
        part = [line for line in lines if line.family == family and line.planner in PAPER_PLANNERS]
        whole = [line for line in part if line.mission == ALL] or part
        headline = next((line for line in whole if line.planner == HEADLINE), None)
        rivals = [
            line
            for line in whole
            if line.planner != HEADLINE and line.mission == (headline.mission if headline else "")
        ]
        if headline is not None and rivals:
            found.append((family.capitalize(), [_completion(headline, rivals), _interception(headline, rivals)]))
    if not found:
        found.append(
            ("No verdict", ["These rows hold no comparison with TAB-POMCP; the tables show what was measured."])
        )
    counts = [line.episodes for line in lines if line.mission != ALL]
    if counts and min(counts) < FEW:
        text = (
            f"Some lines rest on only {min(counts)} episodes: read their intervals, not their means. "
            "The full run has 150 per line (tab-marl evaluate --preset paper)."
        )
        found.append(("Few episodes", [text]))
    return found


def _completion(headline: Line, rivals: Sequence[Line]) -> str:
    others = ", ".join(f"{short(r.planner)} {_percent(r)}" for r in rivals)
    text = f"Against TAB-POMCP the adversary completed {_percent(headline)} of its missions ({others})."
    verdicts = [(r.planner, r.atcr_against_headline.verdict if r.atcr_against_headline else 0) for r in rivals]
    return f"{text} {_verdict(verdicts, 'TAB-POMCP lets fewer through than')}"


def _interception(headline: Line, rivals: Sequence[Line]) -> str:
    others = ", ".join(f"{short(r.planner)} {r.steps.value / 100:.1f}" for r in rivals)
    text = f"It met the adversary after {headline.steps.value / 100:.1f} s on average ({others})."
    verdicts = [(r.planner, r.steps_against_headline.verdict if r.steps_against_headline else 0) for r in rivals]
    return f"{text} {_verdict(verdicts, 'TAB-POMCP is faster than')}"


def _verdict(verdicts: Sequence[tuple[str, int]], verb: str) -> str:
    groups = {sign: [short(p) for p, v in verdicts if v == sign] for sign in (1, 0, -1)}
    clauses = []
    if groups[1]:
        clauses.append(f"{verb} {_join(groups[1])} by more than chance explains")
    if groups[0]:
        clauses.append(f"no clear difference to {_join(groups[0])}")
    if groups[-1]:
        clauses.append(f"{_join(groups[-1])} did better by more than chance explains")
    text = "; ".join(clauses)
    return f"{text[0].upper()}{text[1:]}."


def _percent(line: Line) -> str:
    return f"{100 * line.atcr.value:.0f} %"


def _join(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
