"""Measuring a policy for its card: success per mission type in both worlds, its figures, and whether its style counts."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tab_marl.agents.adversaries import AdversaryPolicy
from tab_marl.agents.measures.diversity import (
    FIGURES,
    SPREAD,
    Behaviour,
    Yardstick,
    behaviour,
    occupancy_distance,
    style_test,
)
from tab_marl.agents.measures.rollouts import run_bank
from tab_marl.agents.measures.validation import BATCHED, PHYSICS, HeldOut, mission_records, play_physics
from tab_marl.agents.policies.cards import CLAIM, MissionRecord, PolicyCard, World
from tab_marl.agents.policies.zoo import ZooPolicy
from tab_marl.agents.training.env import HELD_OUT, build_bank
from tab_marl.mission.compositions import COMPOSITIONS, SAMPLED, sample_composition
from tab_marl.mission.tasks import MISSION_IDS, Task

MEASURED = (*MISSION_IDS, SAMPLED)
TIME_USED = "time used / allowed"
SEED = 99
OnPlayed = Callable[[int, int], None]


def sampled_tasks(count: int, seed: int = SEED) -> list[Task]:
    """Held-out tasks of compositions, each in turn; task i depends on (seed, i) only."""
    return [
        sample_composition(np.random.default_rng((HELD_OUT, seed, 10_000 + i)), COMPOSITIONS[i % len(COMPOSITIONS)])
        for i in range(count)
    ]  # fmt: skip


@dataclass(frozen=True, eq=False)
class Sheet:
    """The held-out tasks on which policies are measured: the same for all."""

    held_out: HeldOut
    """M1 to M5."""
    sampled: tuple[Task, ...]
    """Compositions."""
    compared: HeldOut
    """Those of `held_out` on which behaviours are compared."""
    yardsticks: tuple[Yardstick, ...]
    """Of `compared`."""

    @classmethod
    def draw(cls, tasks: int = 300, sampled: int = 96, compared: int = 150, seed: int = SEED) -> Sheet:
        """`tasks` of M1 to M5 in turn, `sampled` compositions in turn; behaviours are compared on the first `compared`."""
        held_out = HeldOut.draw(tasks, seed)
        first = HeldOut(held_out.tasks[:compared], seed)
        yardsticks = tuple(Yardstick.of(task) for task in first.tasks)
        return cls(held_out, tuple(sampled_tasks(sampled, seed)), first, yardsticks)

    def behaviour(self, policy: AdversaryPolicy) -> Behaviour:
        """What the policy does on the compared tasks."""
        return behaviour(policy, self.compared, self.yardsticks)


def measured_policy(
    policy: ZooPolicy, sheet: Sheet, controls: Sequence[Behaviour], on_played: OnPlayed | None = None
) -> tuple[ZooPolicy, Behaviour]:
    """The policy with a card of what it was measured to do, and its behaviour.

    It claims the mission types of which it completes `CLAIM` or more in both worlds. `controls`: of two direct policies
    trained with other seeds, without whom no style is judged.
    """
    mine = sheet.behaviour(policy)
    records = success(policy, sheet.held_out.tasks, sheet.sampled, sheet.held_out.seed, on_played)
    card = policy.card.model_copy(
        update={
            "missions": claimed(records),
            "success": tuple(records),
            "style_test": style_test(mine, controls, policy.style) if len(controls) > 1 else None,
            "statistics": statistics(mine, sheet, controls),
        }
    )
    return dataclasses.replace(policy, card=PolicyCard.model_validate(card.model_dump())), mine


def success(
    policy: AdversaryPolicy,
    tasks: Sequence[Task],
    sampled: Sequence[Task],
    seed: int = SEED,
    on_played: OnPlayed | None = None,
    worlds: Sequence[World] = (BATCHED, PHYSICS),
) -> list[MissionRecord]:
    """Unopposed success per mission type, the sampled compositions together, in each world."""
    every = [*tasks, *sampled]
    missions = np.array([task.mission_id for task in every])
    found: list[MissionRecord] = []
    for world in worlds:
        if world == BATCHED:
            bank = build_bank(every, policy.style, 1000 * seed)
            completed = run_bank(policy, bank, np.arange(len(bank)), np.random.default_rng((seed, 0)), False).completed
        else:
            completed = play_physics(policy, every, seed, on_played)
        found += mission_records(missions, completed, world)
    return found


def claimed(records: Sequence[MissionRecord]) -> tuple[str, ...]:
    """Mission types of which enough was completed in every world that was measured."""
    types = [m for m in MEASURED if any(r.mission == m for r in records)]
    return tuple(m for m in types if all(r.claimable for r in records if r.mission == m))


def gap(records: Sequence[MissionRecord], world: World = PHYSICS) -> float:
    """Share completed of M1 to M5 together, less that of the sampled compositions; nan if either was not measured."""
    shares = []
    for sampled in (False, True):
        mine = [r for r in records if r.world == world and (r.mission == SAMPLED) == sampled]
        shares.append(sum(r.completed for r in mine) / sum(r.episodes for r in mine) if mine else math.nan)
    return shares[0] - shares[1]


def worlds_gap(records: Sequence[MissionRecord]) -> float:
    """Share completed in the batched world that it was trained in, less that in the physics environment."""
    shares = []
    for world in (BATCHED, PHYSICS):
        mine = [r for r in records if r.world == world]
        shares.append(sum(r.completed for r in mine) / sum(r.episodes for r in mine) if mine else math.nan)
    return shares[0] - shares[1]


def statistics(mine: Behaviour, sheet: Sheet, controls: Sequence[Behaviour] = ()) -> dict[str, float]:
    """Figures for the card; what is undefined is left out."""
    low, middle, high = mine.quantiles(TIME_USED)
    found = {figure: mine.mean(figure) for figure in FIGURES}
    found |= {f"{TIME_USED}, q10": low, f"{TIME_USED}, q50": middle, f"{TIME_USED}, q90": high}
    found[SPREAD] = _known_mean(mine.figure(SPREAD))
    if len(controls) > 1:
        found["occupancy distance from control 1"] = occupancy_distance(mine, controls[0], sheet.yardsticks)
        found["occupancy distance between controls"] = occupancy_distance(controls[1], controls[0], sheet.yardsticks)
    return {name: round(value, 4) for name, value in found.items() if not math.isnan(value)}


def _known_mean(values: NDArray[np.float64]) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else math.nan


def below_claim(records: Sequence[MissionRecord], wanted: Sequence[str]) -> list[str]:
    """What a policy does not live up to: a line per wanted mission type and world below `CLAIM`, with its interval."""
    return [
        f"{r.mission}: {r.completed} of {r.episodes} completed in {r.world} [{100 * r.low:.0f}, {100 * r.high:.0f}] %, "
        f"below {100 * CLAIM:.0f} %"
        for r in records
        if r.mission in wanted and not r.claimable
    ]
