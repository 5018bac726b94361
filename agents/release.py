"""From settings to policies that ship: training, measuring in both worlds, and the cards."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from tab_marl.agents.rollouts import Rollouts
from tab_marl.agents.training import Progress, train
from tab_marl.agents.training_settings import TrainingSettings
from tab_marl.agents.validation import (
    BATCHED,
    PHYSICS,
    HeldOut,
    mission_records,
    other_places,
    play_physics,
    run_held_out,
    style_figures,
)
from tab_marl.agents.zoo import MissionRecord, ZooPolicy, export_policy, load_policy, save_policy
from tab_marl.envs.batched import Bank

CONTROL_SEEDS = (1, 2)
CLAIM = 0.8
"""A mission type is claimed only if at least this share of held-out tasks is completed in both worlds."""
DIRECT = "direct"

OWN_FIGURE = {
    "side": "side taken as drawn",
    "via": "via points reached",
    "camera-shy": "seconds under other cameras",
    "late": "time used / allowed",
    "wander": "spread between episodes, metres",
    "fickle": "other places than the direct policy's",
}
"""What each style is for."""

DESCRIPTIONS = {
    "direct": "Takes the shortest way to the nearest goals, as early as it may.",
    "side": "Prefers one turning sense about the arena's centre, drawn per episode.",
    "via": "Passes a random point first, if time allows.",
    "camera-shy": "Goes around the checkpoint cameras where it can.",
    "late": "Arrives when three quarters or more of the allowed time are spent.",
    "wander": "Takes a different winding way every time: its cost of moving is a random field.",
    "fickle": "Chooses among the places that will do almost at random.",
}


def release(
    styles: Sequence[str],
    runs: Path,
    zoo: Path,
    tasks: int,
    steps: int | None = None,
    on_progress: Callable[[str, Progress], None] | None = None,
) -> Iterator[str]:
    """Train every style and the controls, measure them, write the policies; yields a line per thing done."""
    changes = {} if steps is None else {"steps": steps}
    controls = []
    for seed in CONTROL_SEEDS:
        settings = TrainingSettings.for_style(DIRECT, name=f"direct-seed{seed}", seed=seed, **changes)
        controls.append(trained(settings, runs / settings.name, on_progress))
        yield f"{settings.name}: trained"
    held_out = HeldOut.draw(tasks)
    measured_controls = [_Measured.of(control, held_out) for control in controls]
    for style in styles:
        settings = TrainingSettings.for_style(style, **changes)
        policy = trained(settings, runs / settings.name, on_progress)
        policy = with_figures(policy, held_out, measured_controls)
        save_policy(policy, zoo / policy.name)
        yield summary(policy)


def trained(
    settings: TrainingSettings, folder: Path, on_progress: Callable[[str, Progress], None] | None = None
) -> ZooPolicy:
    """The policy of a run, trained to its end (a finished run is only read)."""

    def tell(stand: Progress) -> None:
        if on_progress is not None:
            on_progress(settings.name, stand)

    return load_policy(export_policy(train(settings, folder, tell), settings, folder))


@dataclasses.dataclass(frozen=True, eq=False)
class _Measured:
    """Two rounds of unopposed episodes on the held-out tasks, with different latents."""

    bank: Bank
    first: Rollouts
    second: Rollouts

    @classmethod
    def of(cls, policy: ZooPolicy, held_out: HeldOut) -> _Measured:
        bank, first = run_held_out(policy, held_out)
        return cls(bank, first, run_held_out(policy, held_out, draw=1)[1])


def with_figures(policy: ZooPolicy, held_out: HeldOut, controls: Sequence[_Measured]) -> ZooPolicy:
    """The policy with success in both worlds, its figures and the controls' on its card."""
    mine = _Measured.of(policy, held_out)
    records = mission_records(held_out.missions, mine.first.completed, BATCHED)
    records += mission_records(held_out.missions, play_physics(policy, held_out.tasks, held_out.seed), PHYSICS)
    statistics = _figures(mine, mine, controls[0])
    for number, control in enumerate(controls, start=1):
        theirs = _figures(mine, control, controls[0] if number > 1 else controls[-1])
        statistics |= {f"{name} (control {number})": value for name, value in theirs.items()}
    claimed = tuple(m for m in policy.card.missions if all(r.share >= CLAIM for r in records if r.mission == m))
    card = policy.card.model_copy(
        update={
            "description": DESCRIPTIONS.get(policy.name, ""),
            "missions": claimed,
            "success": tuple(records),
            "statistics": {name: round(value, 4) for name, value in statistics.items() if not math.isnan(value)},
        }
    )
    return dataclasses.replace(policy, card=card)


def _figures(drawn: _Measured, walked: _Measured, reference: _Measured) -> dict[str, float]:
    """Figures of the episodes walked, judged by what was drawn for the style in question."""
    figures = style_figures(drawn.bank, walked.first, walked.second)
    figures[OWN_FIGURE["fickle"]] = other_places(walked.bank, walked.first, reference.first)
    return figures


def summary(policy: ZooPolicy) -> str:
    """One line: success per mission, and the style's own figure beside the controls'."""
    physics = [r for r in policy.card.success if r.world == PHYSICS]
    success = " ".join(f"{r.mission} {100 * r.share:.0f}%" for r in physics)
    figure = OWN_FIGURE.get(policy.name)
    if figure is None or figure not in policy.card.statistics:
        return f"{policy.name}: {success}"
    controls = [policy.card.statistics.get(f"{figure} (control {n})", math.nan) for n in (1, 2)]
    own = policy.card.statistics[figure]
    return f"{policy.name}: {success}; {figure} {own:.2f} (controls {', '.join(f'{c:.2f}' for c in controls)})"


def lowest(policy: ZooPolicy) -> MissionRecord:
    """The record with the smallest share completed. Raises ValueError if nothing was measured."""
    if not policy.card.success:
        raise ValueError(f"policy {policy.name} carries no measured success")
    return min(policy.card.success, key=lambda record: record.share)
