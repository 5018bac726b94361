"""The work: which episodes belong together, what decides them, and in which order they are played."""

from __future__ import annotations

import hashlib
import heapq
from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np

from tab_marl.evaluation.settings import LEARNS_ACROSS_EPISODES, EvaluationSettings

Key = tuple[str, str, str, int]
"""(mission, family, planner, seed)."""


@dataclass(frozen=True)
class Unit:
    """One task, one adversary, one stream of noise; every planner plays it."""

    mission: str
    family: str
    seed: int
    """Index of the episode, from 0."""


@dataclass(frozen=True)
class Job:
    """What one worker does in one go: some planners on one unit, so that they share the task's tables."""

    unit: Unit
    planners: tuple[str, ...]
    base_seed: int
    slack: float | None
    adversaries: tuple[str, ...]
    planner_preset: str
    learned: str | None = None
    """What a planner that learns across episodes carried out of the previous one."""

    @property
    def is_link(self) -> bool:
        """Whether the next episode of this mission and family must wait for this one."""
        return self.planners[0] in LEARNS_ACROSS_EPISODES

    @property
    def adversary(self) -> str:
        """The zoo's policies take turns over the seeds."""
        return self.adversaries[self.unit.seed % len(self.adversaries)]


def stable_hash(text: str) -> int:
    """32 bits of a text, the same in every process and on every machine (unlike ``hash``)."""
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest(), "big")


def unit_seeds(base_seed: int, unit: Unit) -> tuple[np.random.SeedSequence, int, int]:
    """(sequence for the task, seed of the episode, seed of the planner): a function of the base seed and the unit."""
    root = np.random.SeedSequence([base_seed, stable_hash(f"{unit.mission}/{unit.family}"), unit.seed])
    task, episode, planner = root.spawn(3)
    return task, int(episode.generate_state(1)[0]), int(planner.generate_state(1)[0])


class Schedule:
    """Jobs in the order of their seeds, so that an unfinished run has played the same seeds with every planner.

    A planner that learns across episodes plays a chain: its next job appears when the previous one is done.
    """

    def __init__(self, settings: EvaluationSettings, adversaries: tuple[str, ...], done: Collection[Key]) -> None:
        self._settings, self._adversaries, self._done = settings, adversaries, set(done)
        self._heap: list[tuple[int, int, int, int, Job]] = []
        free = [p for p in settings.planners if p not in LEARNS_ACROSS_EPISODES]
        for m, mission in enumerate(settings.missions):
            for f, family in enumerate(settings.families):
                for seed in range(settings.episodes):
                    unit = Unit(mission, family, seed)
                    missing = tuple(p for p in free if (mission, family, p, seed) not in self._done)
                    if missing:
                        heapq.heappush(self._heap, (seed, m, f, 1, self._job(unit, missing, None)))
        self.missing = sum(
            (m, f, p, seed) not in self._done
            for m in settings.missions
            for f in settings.families
            for p in settings.planners
            for seed in range(settings.episodes)
        )

    def begin_chains(self) -> Iterator[tuple[Unit, str]]:
        """The last stored episode before each chain's first gap is needed: yields (unit, planner) to be continued."""
        for planner in self._settings.planners:
            if planner in LEARNS_ACROSS_EPISODES:
                for mission in self._settings.missions:
                    for family in self._settings.families:
                        for seed in range(self._settings.episodes):
                            if (mission, family, planner, seed) not in self._done:
                                yield Unit(mission, family, seed), planner
                                break

    def push_link(self, unit: Unit, planner: str, learned: str | None) -> None:
        """Add the chain's episode `unit`, which carries on with what was learned; nothing if it lies past the end."""
        if unit.seed >= self._settings.episodes:
            return
        m, f = self._settings.missions.index(unit.mission), self._settings.families.index(unit.family)
        heapq.heappush(self._heap, (unit.seed, m, f, 0, self._job(unit, (planner,), learned)))

    @property
    def ready(self) -> bool:
        """Whether a job can be played now."""
        return bool(self._heap)

    def pop(self) -> Job | None:
        """The next job that can be played now."""
        return heapq.heappop(self._heap)[-1] if self._heap else None

    def _job(self, unit: Unit, planners: tuple[str, ...], learned: str | None) -> Job:
        s = self._settings
        return Job(unit, planners, s.seed, s.slack, self._adversaries, s.planner_preset, learned)
