"""The zoo for the command line and the report: what each policy is, and whether it still does what its card claims."""

from __future__ import annotations

import dataclasses

from rich.console import Console
from rich.progress import track
from rich.table import Table

from tab_marl.agents.adversaries import AdversaryPolicy
from tab_marl.agents.validation import PHYSICS, measure_success
from tab_marl.agents.zoo import PolicyCard, ZooPolicy, find_policy, load_zoo
from tab_marl.envs.styles import Style
from tab_marl.evaluation.console import WIDTH

REQUIRED = 0.8
"""Share of held-out missions, per type claimed, that a policy of the zoo must complete when nobody hunts it."""


def describe(policy: AdversaryPolicy) -> str:
    """A line about a policy: its card's words, or its style in numbers."""
    card = getattr(policy, "card", None)
    if isinstance(card, PolicyCard) and card.description:
        return card.description
    return _style_text(policy.style)


def _style_text(style: Style) -> str:
    plain = Style()
    changed = [
        f"{f.name.replace('_', ' ')} {value:g}" if isinstance(value, float) else f"{f.name.replace('_', ' ')} {value}"
        for f in dataclasses.fields(style)
        if f.name != "name" and (value := getattr(style, f.name)) != getattr(plain, f.name)
    ]
    return "style: " + (", ".join(changed) if changed else "none, the shortest way")


def zoo_table() -> None:
    """Print every policy with its unopposed success per mission type."""
    policies = load_zoo()
    missions = sorted({m for policy in policies for m in policy.card.missions})
    table = Table(box=None, pad_edge=False, title="unopposed success, %", title_justify="right")
    for heading in ("policy", "what it is", *missions):
        table.add_column(heading, justify="right" if heading in missions else "left", no_wrap=heading != "what it is")
    for policy in policies:
        table.add_row(policy.name, describe(policy), *(_share(policy, mission) for mission in missions))
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(width=WIDTH, highlight=False)
    console.print(table)


def _share(policy: ZooPolicy, mission: str) -> str:
    records = [r for r in policy.card.success if r.mission == mission]
    records = [r for r in records if r.world == PHYSICS] or records
    return f"{100 * records[0].share:.0f}" if records else ("claimed" if mission in policy.card.missions else "-")


def zoo_card(name: str) -> str:
    """A policy's card as text. Raises UnknownName."""
    card = find_policy(name).card
    lines = [
        f"policy      {card.name}",
        f"what it is  {card.description or _style_text(card.style)}",
        f"trained by  {card.algorithm}, {card.steps} steps: {card.command}",
        f"network     {' - '.join(str(width) for width in card.network.layers)}, observation layout {card.layout_version}",
        f"weights     sha256 {card.sha256}",
    ]
    for record in card.success:
        lines.append(
            f"unopposed   {record.mission} ({record.world}): {record.completed} of {record.episodes} "
            f"[{100 * record.low:.0f}, {100 * record.high:.0f}] %"
        )
    lines += [f"figure      {what}: {value:.3g}" for what, value in card.statistics.items()]
    return "\n".join(lines)


def verify_zoo(name: str | None, episodes: int) -> bool:
    """Play held-out missions unopposed and print the success; whether every policy completes REQUIRED of each type.

    A policy fails only if the upper end of its 95 % interval lies below the bar, so that few episodes do not condemn it.
    """
    policies = load_zoo() if name is None else [find_policy(name)]
    notes = Console(stderr=True)
    good = True
    for policy in policies:
        records = []
        for mission in track(policy.card.missions, policy.name, console=notes, disable=not notes.is_terminal):
            records += measure_success(policy, episodes, missions=(mission,))
        for record in records:
            passed = record.high >= REQUIRED
            good &= passed
            print(
                f"{policy.name:12} {record.mission}  {record.completed:4} of {record.episodes} "
                f"[{100 * record.low:.0f}, {100 * record.high:.0f}] %  {'ok' if passed else 'BELOW 80 %'}",
                flush=True,
            )
    return good
