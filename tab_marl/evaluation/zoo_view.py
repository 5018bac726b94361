"""The zoo for the command line and the report: what each policy is, and whether it still does what its card claims."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from tab_marl.agents.adversaries import AdversaryPolicy
from tab_marl.agents.measures.measuring import MEASURED, OnPlayed, gap, sampled_tasks, success, worlds_gap
from tab_marl.agents.measures.validation import PHYSICS, HeldOut
from tab_marl.agents.policies.cards import CLAIM, MissionRecord, PolicyCard, Split, StyleTest
from tab_marl.agents.policies.joining import Joining, join
from tab_marl.agents.policies.zoo import SHIPPED, all_policies, find_policy, load_policy, user_zoo
from tab_marl.envs.styles import Style
from tab_marl.mission.compositions import SAMPLED
from tab_marl.mission.tasks import MISSION_IDS

LIST_WIDTH = 132
VERIFY_SEED = 7_301
"""Of tasks that neither training nor the measurement on a card uses."""


def describe(policy: AdversaryPolicy) -> str:
    """A line about a policy: its card's words, or its style in numbers."""
    card = getattr(policy, "card", None)
    if isinstance(card, PolicyCard) and card.description:
        return card.description
    return _style_text(policy.style)


def _style_text(style: Style) -> str:
    if style.mixture:
        return "style: one habit per episode of " + ", ".join(
            f"{h.style.name} {100 * h.weight:.0f} % ({100 * h.open_weight:.0f} % where the goal is open)"
            for h in style.mixture
        )
    plain = Style()
    changed = [
        f"{f.name.replace('_', ' ')} {value:g}" if isinstance(value, float) else f"{f.name.replace('_', ' ')} {value}"
        for f in dataclasses.fields(style)
        if f.name != "name" and (value := getattr(style, f.name)) != getattr(plain, f.name)
    ]
    return "style: " + (", ".join(changed) if changed else "none, the shortest way")


def zoo_table(split: Split | None = None, console: Console | None = None) -> None:
    """Print every policy, those that ship and the user's: algorithm, style, split, success, and what its style moved."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    table.add_column("policy", no_wrap=True)
    table.add_column("split", no_wrap=True)
    table.add_column("algorithm", no_wrap=True)
    table.add_column("style", no_wrap=True)
    for mission in MEASURED:
        table.add_column(mission, justify="right", no_wrap=True)
    table.add_column("its style's own figure (controls), and whether it counts", ratio=1)
    found = all_policies(split)
    for policy, path in found:
        card = policy.card
        own = path.parent != SHIPPED
        table.add_row(
            Text(card.name + (" *" if own else ""), style="bold" if own else ""),
            Text(card.split, style="yellow" if card.split == "final" else "cyan"),
            Text(_short(card.algorithm)),
            Text(card.style.name),
            *(_share(card, mission) for mission in MEASURED),
            _tested(card.style_test, card),
        )
    out = console or Console(highlight=False)
    if not out.is_terminal:
        out = Console(file=out.file, width=LIST_WIDTH, highlight=False)
    out.print(table)
    out.print(
        Text(
            f"% completed unopposed in pymunk on held-out tasks; {SAMPLED}: compositions that are no M1 to M5; in brackets: not "
            f"claimed. Own policies (*) lie in {user_zoo()}.",
            style="dim",
        )
    )


def _short(algorithm: str) -> str:
    return algorithm.split(" (")[0]


def _share(card: PolicyCard, mission: str) -> Text:
    record = card.record(mission)
    if record is None:
        return Text("claimed" if mission in card.missions else "-", style="dim")
    text = f"{100 * record.share:.0f}"
    return Text(text, style="green") if mission in card.missions else Text(f"({text})", style="red")


def _tested(test: StyleTest | None, card: PolicyCard) -> Text:
    mark = Text("  in spite of: " + "; ".join(card.exceptions), style="red") if card.exceptions else Text("")
    if test is None:
        return Text("-", style="dim") + mark
    controls = ", ".join(f"{value:.2f}" for value in test.controls)
    verdict = Text("counts", style="green") if test.counts else Text("does not count", style="red")
    return Text(f"{test.figure} {test.value:.2f} ({controls}) ") + verdict + mark


def zoo_card(name: str) -> str:
    """A policy's card as text. Raises UnknownName."""
    card = find_policy(name).card
    network = card.network
    kind = f"LSTM of {network.lstm_units}, then " if network.lstm_units else ""
    bounded = "squashed" if network.squashed else "clipped"
    lines = [
        f"policy      {card.name} ({card.split})" + (f", by {card.author}" if card.author else ""),
        f"what it is  {card.description or _style_text(card.style)}",
        f"style       {card.style.name}; {_style_text(card.style)}",
        f"trained by  {card.algorithm}, {card.steps} steps: {card.command or 'command not given'}",
        *_trained_on(card),
        f"network     {kind}{' - '.join(str(width) for width in network.layers)}, {network.activation}, {bounded}"
        + (f", observations normalised and clipped at {network.observation_clip:g}" if network.observation_clip else "")
        + f"; observation layout {card.layout_version}",
        f"weights     sha256 {card.sha256}",
        f"claims      {', '.join(card.missions) or 'nothing'}",
    ]
    for record in card.success:
        lines.append(f"unopposed   {record.mission} ({record.world}): {_interval(record)}")
    for label, value in (
        ("M1 to M5 less sampled compositions", gap(card.success)),
        ("batched world less pymunk", worlds_gap(card.success)),
    ):
        if not math.isnan(value):
            lines.append(f"gap         {label}: {100 * value:+.1f} points")
    if card.style_test is not None:
        test = card.style_test
        lines.append(
            f"own figure  {test.figure}: {test.value:.3g}, controls {', '.join(f'{c:.3g}' for c in test.controls)}; moved "
            f"{test.moved:.3g} [{test.low:.3g}, {test.high:.3g}], needed more than {test.needed:.3g} at a success of "
            f"{100 * CLAIM:.0f} % (has {100 * test.success:.0f} %): {'counts' if test.counts else 'does not count'}"
        )
    lines += [f"figure      {what}: {value:.3g}" for what, value in card.statistics.items()]
    lines += [f"in spite of {what}" for what in card.exceptions]
    return "\n".join(lines)


def _trained_on(card: PolicyCard) -> list[str]:
    told = (
        "missions",
        "families",
        "tasks",
        "seed",
        "algorithm",
        "opponent",
        "habits_against",
        "initial",
        "compositions",
    )
    parts = [f"{name.replace('_', ' ')} {_plain(card.settings[name])}" for name in told if card.settings.get(name)]
    return [f"trained on  {'; '.join(parts)}"] if parts else []


def _plain(value: object) -> str:
    return ", ".join(str(v) for v in value) if isinstance(value, list) else str(value)


def _interval(record: MissionRecord) -> str:
    return f"{record.completed} of {record.episodes} [{100 * record.low:.0f}, {100 * record.high:.0f}] %"


def verify_zoo(name: str | None, episodes: int) -> bool:
    """Check files and replay the claims in pymunk on fresh held-out tasks; whether every policy completes CLAIM of each type.

    A policy fails only if the upper end of its 95 % interval lies below the bar, so that few episodes do not condemn it.
    """
    found = [(policy, path) for policy, path in all_policies() if name in (None, policy.name)]
    if name is not None and not found:
        policy = find_policy(name)
        found = [(policy, Path(name))]
    tasks = HeldOut.draw(episodes * len(MISSION_IDS), VERIFY_SEED).tasks
    sampled = sampled_tasks(episodes, VERIFY_SEED)
    good = True
    for policy, path in found:
        load_policy(path)  # the checksum, again: it is what the rest speaks about
        print(f"{policy.name:16} checksum {policy.card.sha256[:16]}...  ok", flush=True)
        claims = policy.card.missions
        mine = [task for task in tasks if task.mission_id in claims]
        with _progress(policy.name, len(mine) + (len(sampled) if SAMPLED in claims else 0)) as advance:
            records = success(
                policy, mine, sampled if SAMPLED in claims else (), VERIFY_SEED, advance, worlds=(PHYSICS,)
            )
        for record in records:
            passed = record.high >= CLAIM
            good &= passed
            print(
                f"{policy.name:16} {record.mission:8} {_interval(record)}  "
                f"{'ok' if passed else f'BELOW {100 * CLAIM:.0f} %'}",
                flush=True,
            )
    return good


def add_to_zoo(file: Path, joining: Joining, anyway: bool, episodes: int) -> str:
    """Let a model join the user's zoo; what was measured. Raises PolicyError, UnknownName."""
    with _progress(joining.name, episodes * (len(MISSION_IDS) + 1)) as advance:
        policy, folder = join(file, joining, anyway=anyway, episodes=episodes, on_played=advance)
    records: Sequence[MissionRecord] = [r for r in policy.card.success if r.world == PHYSICS]
    lines = [f"{r.mission:8} {_interval(r)}" for r in records]
    lines += [f"in spite of {what}" for what in policy.card.exceptions]
    lines.append(f"added {policy.name} ({policy.card.algorithm}) to {folder.parent}")
    return "\n".join(lines)


@contextlib.contextmanager
def _progress(name: str, total: int) -> Iterator[OnPlayed]:
    """A bar on stderr, where that is a terminal."""
    notes = Console(stderr=True)
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=notes,
        disable=not notes.is_terminal, transient=True,
    )  # fmt: skip
    with bar:
        task = bar.add_task(f"{name}, unopposed", total=total)
        yield lambda done, total: bar.update(task, completed=done, total=total)
