"""What the zoo's policies do, side by side: tables and figures of the same tasks, the scripted follower and the field beside."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tab_marl.agents.adversaries import ScriptedAdversary
from tab_marl.agents.measures.diversity import SPREAD, Behaviour, field_samples, occupancy_distance
from tab_marl.agents.measures.measuring import MEASURED, TIME_USED, Sheet, gap, worlds_gap
from tab_marl.agents.measures.validation import wilson
from tab_marl.agents.policies.cards import CLAIM, PolicyCard
from tab_marl.agents.policies.zoo import ZooPolicy

FIELD_SEED = 1
RESAMPLES = 2000
OnDone = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Study:
    """Policies with what they did, and the two baselines."""

    policies: tuple[ZooPolicy, ...]
    behaviours: tuple[Behaviour, ...]
    """Of the policies, in order."""
    scripted: Behaviour
    field: Behaviour
    sheet: Sheet

    @property
    def everybody(self) -> tuple[Behaviour, ...]:
        return (*self.behaviours, self.scripted, self.field)

    def counted_styles(self) -> list[str]:
        """Names of styles of which at least one policy's own figure moved beyond doubt at the success asked for."""
        return sorted(
            {p.style.name for p in self.policies if p.card.style_test is not None and p.card.style_test.counts}
        )


def conduct(policies: Sequence[ZooPolicy], tasks: int = 150, on_done: OnDone | None = None) -> Study:
    """Let everybody play the same held-out tasks."""
    tell = on_done or (lambda what: None)
    sheet = Sheet.draw(tasks, 0, tasks)
    tell("tasks")
    behaviours = []
    for policy in policies:
        behaviours.append(sheet.behaviour(policy))
        tell(policy.name)
    scripted = sheet.behaviour(ScriptedAdversary())
    tell("scripted")
    field = field_samples(sheet.yardsticks, FIELD_SEED)
    tell("TAB-Field")
    return Study(tuple(policies), tuple(behaviours), scripted, field, sheet)


def success_table(policies: Sequence[ZooPolicy]) -> str:
    """Success in pymunk per mission type, from the cards."""
    head = ["policy", "split", "algorithm", "style", *MEASURED, "gap to sampled", "gap to batched"]
    rows = []
    for policy in policies:
        card = policy.card
        rows.append(
            [
                f"`{card.name}`", card.split, card.algorithm.split(" (")[0], card.style.name,
                *(_share(card, mission) for mission in MEASURED), _points(gap(card.success)), _points(worlds_gap(card.success)),
            ]
        )  # fmt: skip
    return markdown(head, rows)


def style_table(policies: Sequence[ZooPolicy]) -> str:
    """Each style's own figure beside the controls', from the cards."""
    head = ["policy", "own figure", "value", "controls", "moved [95 %]", "needed", "success", "counts"]
    rows = []
    for policy in policies:
        test = policy.card.style_test
        if test is None:
            rows.append([f"`{policy.name}`", "none", "", "", "", "", "", ""])
            continue
        controls = ", ".join(f"{value:.2f}" for value in test.controls)
        rows.append(
            [
                f"`{policy.name}`", test.figure, f"{test.value:.2f}", controls,
                f"{test.moved:.2f} [{test.low:.2f}, {test.high:.2f}]", f"{test.needed:.2f}", f"{100 * test.success:.0f} %",
                "**yes**" if test.counts else "no",
            ]
        )  # fmt: skip
    return markdown(head, rows)


def behaviour_table(study: Study) -> str:
    """The same figures of everybody, on the same tasks."""
    head = [
        "", "shortest path's side, %", "length / shortest", "time used, q10 / 50 / 90", "s in cameras", "s in other cameras",
        "nearest place first, %", "places of the shortest way, %", "spread, m", "JS to scripted",
    ]  # fmt: skip
    rows = []
    for b in study.everybody:
        used = " / ".join(f"{q:.2f}" for q in b.quantiles(TIME_USED))
        js = occupancy_distance(b, study.scripted, study.sheet.yardsticks)
        spread = b.figure(SPREAD)
        own = b in study.behaviours
        rows.append(
            [
                f"`{b.name}`" if own else f"*{b.name}*", _percent(b.mean("shortest side")), f"{b.mean('length / shortest'):.2f}", used,
                f"{b.mean('seconds in cameras'):.1f}", f"{b.mean('seconds in other cameras'):.1f}",
                _percent(b.mean("nearest place first")), _percent(b.mean("places of the shortest way")),
                f"{np.nanmean(spread):.2f}", f"{js:.2f}",
            ]
        )  # fmt: skip
    return markdown(head, rows)


def population_lines(study: Study) -> str:
    """What is asked of the population as a whole, and whether it holds."""
    cards = [policy.card for policy in study.policies]
    claims = [card for card in cards if set(MEASURED[:5]) <= set(card.missions)]
    styles = study.counted_styles()
    used = np.concatenate([b.figures[TIME_USED][~np.isnan(b.figures[TIME_USED])] for b in study.behaviours])
    share, low, high, n = shortest_side(study.behaviours)
    early, late = np.quantile(used, (0.05, 0.95))
    rows = [
        ["policies", f"{len(cards)}, of {len({_algorithm(c) for c in cards})} algorithms", ">= 12", _held(len(cards) >= 12)],
        [f"claim M1 to M5 (>= {100 * CLAIM:.0f} % each, both worlds)", f"{len(claims)}", "all", _held(len(claims) == len(cards))],
        ["styles that count", f"{len(styles)}: {', '.join(styles)}", ">= 5", _held(len(styles) >= 5)],
        ["time used / allowed, q05 and q95", f"{early:.2f}, {late:.2f}", "near the shortest to near the deadline", ""],
        ["take the shortest path's side where two exist",
         f"{100 * share:.0f} % [{100 * low:.0f}, {100 * high:.0f}] of {n} episodes", "< 60 %", _held(share < 0.6)],
    ]  # fmt: skip
    return markdown(["asked of the population", "measured", "bar", ""], rows)


def shortest_side(behaviours: Sequence[Behaviour], seed: int = 0) -> tuple[float, float, float, int]:
    """Share of all episodes where two sides exist that took the shortest path's, its 95 % bootstrap interval over tasks, and
    the number of episodes."""
    values = np.array([b.figures["shortest side"] for b in behaviours])
    known = ~np.isnan(values)
    took, count = np.where(known, values, 0.0).sum(axis=(0, 1)), known.sum(axis=(0, 1))
    if count.sum() == 0:
        return math.nan, math.nan, math.nan, 0
    draws = np.random.default_rng(seed).integers(len(took), size=(RESAMPLES, len(took)))
    shares = took[draws].sum(axis=1) / np.maximum(count[draws].sum(axis=1), 1)
    low, high = np.quantile(shares, (0.025, 0.975))
    return float(took.sum() / count.sum()), float(low), float(high), int(count.sum())


def side_interval(behaviour: Behaviour) -> tuple[float, float, float]:
    """One policy's share, with Wilson's interval over its episodes."""
    values = behaviour.figures["shortest side"]
    values = values[~np.isnan(values)]
    if len(values) == 0:
        return math.nan, math.nan, math.nan
    return (float(values.mean()), *wilson(int(values.sum()), len(values)))


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def put_tables(text: str, tables: dict[str, str]) -> str:
    """The page with the tables between its marks ``<!-- begin NAME -->`` and ``<!-- end NAME -->``. Raises ValueError."""
    for name, table in tables.items():
        begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
        if text.count(begin) != 1 or text.count(end) != 1:
            raise ValueError(f"the page must hold {begin} and {end} once each")
        before, rest = text.split(begin)
        _, after = rest.split(end)
        text = f"{before}{begin}\n\n{table}\n\n{end}{after}"
    return text


def _algorithm(card: PolicyCard) -> str:
    return card.algorithm.split(" (")[0]


def _share(card: PolicyCard, mission: str) -> str:
    record = card.record(mission)
    if record is None:
        return "-"
    low = f"{100 * record.share:.0f} [{100 * record.low:.0f}, {100 * record.high:.0f}]"
    return low if mission in card.missions else f"({low})"


def _points(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:+.1f}"


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:.0f}"


def _held(holds: bool) -> str:
    return "held" if holds else "**not held**"
