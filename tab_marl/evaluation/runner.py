"""Plays the missing episodes on an engine and stores each as it ends. The process that calls `run` alone writes."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from tab_marl.evaluation.claims import BEAT_SECONDS
from tab_marl.evaluation.engines.interface import Engine, Outcome, Result
from tab_marl.evaluation.engines.local import pool, stop_requested
from tab_marl.evaluation.errors import Interrupted, UserError
from tab_marl.evaluation.settings import EvaluationSettings
from tab_marl.evaluation.store import Store
from tab_marl.evaluation.units import Job, Key, Schedule

__all__ = ["ATTEMPTS", "Result", "Watch", "pool", "run", "stop_requested"]

ATTEMPTS = 3
"""How many workers an episode may cost before it is recorded as failed."""
MOST_LOSSES_IN_A_ROW = 12
"""After so many lost workers without one episode played, something is wrong with the machine, not with an episode."""
POLL_SECONDS = 0.5


@dataclass(frozen=True)
class Watch:
    """Who is told what while episodes are played."""

    on_result: Callable[[list[Result]], None] = lambda results: None
    """Episodes of this run that are stored now."""
    on_elsewhere: Callable[[int], None] = lambda count: None
    """So many episodes were stored by another run on this store."""
    on_note: Callable[[str], None] = lambda text: None
    """Something that whoever waits should know: a worker died, another run holds the rest."""


@dataclass
class _Work:
    """What is left to do, and what is being done."""

    schedule: Schedule
    flight: dict[int, Job] = field(default_factory=dict)
    again: deque[Job] = field(default_factory=deque)
    """Jobs whose worker died, one planner each; claimed already."""
    held: deque[Job] = field(default_factory=deque)
    """Jobs that another run is playing."""
    deaths: Counter[Key] = field(default_factory=Counter)
    given_up: list[tuple[Job, str]] = field(default_factory=list)
    """Jobs to be recorded as failed, once it is sure that the fault is theirs and not the machine's."""
    losses_in_a_row: int = 0
    next_look: float = 0.0
    """When to ask again what became of the held jobs."""


def run(
    settings: EvaluationSettings,
    adversaries: tuple[str, ...],
    store: Store,
    key: str,
    engine: Engine,
    run_id: int,
    watch: Watch | None = None,
) -> None:
    """Play every episode of the settings that the store lacks under this key, as run `run_id` of the store.

    An episode whose worker dies is tried again on another, `ATTEMPTS` times in all, and then stored with the error.
    Raises Interrupted after Ctrl-C (everything finished is stored) and UserError if workers do nothing but die.
    """
    work = _Work(Schedule(settings, adversaries, store.keys(key)))
    _Runner(work, store, key, engine, run_id, watch or Watch()).run()


class _Runner:
    def __init__(self, work: _Work, store: Store, key: str, engine: Engine, run_id: int, watch: Watch) -> None:
        self._work = work
        self._store, self._key, self._engine, self._run, self._watch = store, key, engine, run_id, watch
        self._tickets = 0
        self._last_beat = time.monotonic()

    def run(self) -> None:
        schedule = self._work.schedule
        for unit, planner in schedule.begin_chains():
            before = unit.seed and self._store.learned(self._key, unit.mission, unit.family, planner, unit.seed - 1)
            schedule.push_link(unit, planner, before or None)
        if schedule.missing == 0:
            return
        with self._engine:
            try:
                while self._turn():
                    pass
            except KeyboardInterrupt:
                self._keep(self._engine.stop())
                raise Interrupted from None

    def _turn(self) -> bool:
        """Hand out jobs, take what ended; False when nothing is left."""
        work = self._work
        while self._engine.room > 0 and (job := self._next()) is not None:
            self._tickets += 1
            work.flight[self._tickets] = job
            self._engine.submit(self._tickets, job)
        if work.flight or work.again or work.schedule.ready:  # without room: a cluster may have lost all its nodes
            for outcome in self._engine.collect(POLL_SECONDS):
                self._finish(outcome)
        elif work.held:
            time.sleep(POLL_SECONDS)
        elif work.given_up:
            self._record_given_up()
        else:
            return False
        if time.monotonic() - self._last_beat > BEAT_SECONDS:
            self._last_beat = time.monotonic()
            self._store.stay_alive(self._run)
        return True

    def _next(self) -> Job | None:
        """The next job that this run may play."""
        work = self._work
        if work.again:
            return work.again.popleft()
        while (job := work.schedule.pop()) is not None:
            if (mine := self._claim(job)) is not None:
                return mine
        if work.held and time.monotonic() >= work.next_look:
            for _ in range(len(work.held)):
                if (mine := self._claim(work.held.popleft())) is not None:
                    return mine
            work.next_look = time.monotonic() + POLL_SECONDS
            return self._next() if not work.held else None  # a stored link may have made its successor playable
        return None

    def _claim(self, job: Job) -> Job | None:
        """That part of the job which is ours to play; the rest is stored or held by another run."""
        claimed = self._store.claim(self._key, self._run, _keys(job))
        if claimed.stored:
            self._watch.on_elsewhere(len(claimed.stored))
            if job.is_link:
                learned = self._store.learned(self._key, *claimed.stored[0])
                self._work.schedule.push_link(replace(job.unit, seed=job.unit.seed + 1), job.planners[0], learned)
        if claimed.held:
            self._work.held.append(replace(job, planners=tuple(k[2] for k in claimed.held)))
        return replace(job, planners=tuple(k[2] for k in claimed.granted)) if claimed.granted else None

    def _finish(self, outcome: Outcome) -> None:
        work = self._work
        job = work.flight.pop(outcome.ticket)
        if outcome.results is not None:
            work.losses_in_a_row = 0
            self._record(job, outcome.results)
            self._record_given_up()
            return
        work.losses_in_a_row += 1
        if work.losses_in_a_row >= MOST_LOSSES_IN_A_ROW:
            raise UserError(
                f"{work.losses_in_a_row} workers were lost one after the other, the last one {outcome.lost}; finished "
                "episodes are stored and the same command continues, with fewer --workers if memory is short"
            )
        # Which of several planners it was is not known: from now on each has a worker to itself.
        for planner in job.planners:
            alone = replace(job, planners=(planner,))
            (key,) = _keys(alone)
            work.deaths[key] += 1
            if work.deaths[key] < ATTEMPTS:
                work.again.append(alone)
            else:
                work.given_up.append((alone, outcome.lost))
        unit = job.unit
        self._watch.on_note(
            f"a worker was lost ({outcome.lost}) while playing {unit.mission} {unit.family} seed {unit.seed} with "
            f"{', '.join(job.planners)}; "
            + ("trying again" if any(work.deaths[k] < ATTEMPTS for k in _keys(job)) else "recorded as failed")
        )

    def _record(self, job: Job, results: list[Result]) -> None:
        self._store.add(self._key, results, self._run)
        if job.is_link:
            unit = replace(job.unit, seed=job.unit.seed + 1)
            self._work.schedule.push_link(unit, job.planners[0], results[-1][0].learned)
        self._watch.on_result(results)

    def _record_given_up(self) -> None:
        from tab_marl.evaluation.episode import lost_job

        while self._work.given_up:
            job, manner = self._work.given_up.pop()
            self._record(job, lost_job(job, f"the worker was lost {ATTEMPTS} times, the last one {manner}"))

    def _keep(self, outcomes: list[Outcome]) -> None:
        """Store what was finished while the workers were asked to stop."""
        for outcome in outcomes:
            if outcome.results is not None and outcome.ticket in self._work.flight:
                self._record(self._work.flight.pop(outcome.ticket), outcome.results)


def _keys(job: Job) -> list[Key]:
    return [(job.unit.mission, job.unit.family, planner, job.unit.seed) for planner in job.planners]
