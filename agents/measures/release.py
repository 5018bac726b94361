"""From trained policies to the zoo that ships: measuring them beside their controls, and writing their cards."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from tab_marl.agents.measures.measuring import Sheet, gap, measured_policy
from tab_marl.agents.measures.validation import PHYSICS
from tab_marl.agents.policies.zoo import ZooPolicy, load_zoo, save_policy
from tab_marl.agents.pretraining import count_moves, write_moves
from tab_marl.agents.training.env import TRAINING, draw_tasks
from tab_marl.mission.tasks import FAMILIES, MISSION_IDS

MOVES_SEED, MOVES_TASKS = 77, 45
OnPlayed = Callable[[str, int, int], None]


def release(
    policies: Sequence[ZooPolicy],
    controls: Sequence[ZooPolicy],
    zoo: Path,
    sheet: Sheet | None = None,
    on_played: OnPlayed | None = None,
) -> Iterator[str]:
    """Measure policies beside two or more re-seeded direct ones and write them to `zoo`; yields a line about each.

    MLE-POMCP's counts are written anew from those for development.
    """
    sheet = sheet or Sheet.draw()
    compared = [sheet.behaviour(control) for control in controls]
    for policy in policies:

        def played(done: int, total: int, name: str = policy.name) -> None:
            if on_played is not None:
                on_played(name, done, total)

        measured, _ = measured_policy(policy, sheet, compared, played)
        save_policy(measured, zoo / measured.name)
        yield summary(measured)
    development = load_zoo(zoo, split="development")
    if development:
        yield release_moves(development, zoo / "moves.json")


def release_moves(development: Sequence[ZooPolicy], path: Path) -> str:
    """Write what MLE-POMCP knows before an episode: the moves of these policies under cameras."""
    tasks = draw_tasks(TRAINING, MOVES_SEED, MOVES_TASKS, MISSION_IDS, FAMILIES)
    moves, ticks = count_moves(development, tasks, MOVES_SEED)
    write_moves(development, moves, ticks, len(tasks), path)
    return f"MLE-POMCP: {moves.counts.sum():.0f} moves of {len(development)} development policies"


def summary(policy: ZooPolicy) -> str:
    """One line: success per mission, the gap to sampled compositions, and the style's own figure beside the controls'."""
    card = policy.card
    success = " ".join(f"{r.mission} {100 * r.share:.0f}%" for r in card.success if r.world == PHYSICS)
    line = f"{policy.name} ({card.split}): {success} (gap {100 * gap(card.success):+.0f})"
    test = card.style_test
    if test is None:
        return line
    controls = ", ".join(f"{c:.2f}" for c in test.controls)
    verdict = "counts" if test.counts else "does not count"
    return f"{line}; {test.figure} {test.value:.2f} (controls {controls}) moved {test.moved:.2f} [{test.low:.2f}, {test.high:.2f}]: {verdict}"
