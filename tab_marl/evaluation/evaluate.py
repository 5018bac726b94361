"""The whole evaluation: settings to rows, tables and report, with progress for the person who waits."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from tab_marl.evaluation.engines.interface import Engine, Result
from tab_marl.evaluation.errors import Interrupted, UserError, require_known
from tab_marl.evaluation.runner import Watch, run
from tab_marl.evaluation.settings import EvaluationSettings, settings_key
from tab_marl.evaluation.store import Store
from tab_marl.evaluation.units import Key

REPORT_NAME = "report.html"
FIRST_USE = "First use: compiling the numerical kernels takes a minute or two; later runs skip this."


@dataclasses.dataclass(frozen=True)
class Experiment:
    """Settings together with what this machine's code and zoo make of them."""

    settings: EvaluationSettings
    adversaries: tuple[str, ...]
    code: str

    @property
    def content(self) -> dict[str, object]:
        return self.settings.content(self.code, self.adversaries)

    @property
    def key(self) -> str:
        return settings_key(self.content)


def prepare(settings: EvaluationSettings) -> Experiment:
    """Resolve the adversaries and the code's fingerprint. Raises UserError for a policy that the zoo lacks."""
    from tab_marl.evaluation.adversaries import resolve_opponents
    from tab_marl.evaluation.settings import code_fingerprint

    found = resolve_opponents(settings.adversaries, settings.mix_splits)
    code = code_fingerprint()
    digests = [digest for digest in found.values() if digest]
    return Experiment(settings, tuple(found), "-".join([code, *digests]))


def zoo_checksums(adversaries: tuple[str, ...]) -> dict[str, str]:
    """Policy name -> SHA-256 of its weights; the scripted follower has none."""
    from tab_marl.evaluation.adversaries import opponent
    from tab_marl.evaluation.provenance import last_part

    cards = {last_part(name): getattr(opponent(name), "card", None) for name in adversaries}
    return {name: card.sha256 for name, card in cards.items() if card is not None}


@dataclasses.dataclass(frozen=True)
class Manner:
    """How to run an evaluation: nothing in here changes a row."""

    engine: str = "local"
    """`local` or `ray`."""
    address: str | None = None
    """Of a Ray cluster; None: a Ray instance of this run's own."""
    half_width: float = 5.0
    """Points: the interval whose price in episodes is printed."""
    dry_run: bool = False
    retry_failed: bool = False

    def __post_init__(self) -> None:
        require_known("engine", (self.engine,), ENGINES)
        if self.address is not None and self.engine != "ray":
            raise UserError("--address is of a Ray cluster: add --engine ray")
        if not 0.0 < self.half_width < 50.0:
            raise UserError(f"half-width is {self.half_width:g}, must lie in (0, 50) points")


ENGINES = ("local", "ray")


def evaluate_and_present(settings: EvaluationSettings, out: Path, manner: Manner, hint: str) -> None:
    """Say what it will take, play what the store in `out` lacks, print the tables and write the report.

    `hint`: the command that continues it. Raises UserError.
    """
    from tab_marl.evaluation.console import notes_console
    from tab_marl.evaluation.decision_times import summary
    from tab_marl.evaluation.report.present import present, requested_rows

    notes = notes_console()
    experiment = prepare(settings)
    with Store.create(out) as store:
        if _announce(experiment, store, manner, notes):
            return
        play_missing(experiment, store, make_engine(experiment, manner, notes), notes, hint, manner.retry_failed)
        stored = next(s for s in store.settings() if s.key == experiment.key)
        present(store, stored, out, settings.replays, notes)
        wanted = {r.key for r in requested_rows(store.rows(stored.key), stored.requested)}
        for line in summary({k: t for k, t in store.timings(stored.key).items() if k in wanted}):
            print(line)


def make_engine(experiment: Experiment, manner: Manner, notes: Console) -> Engine:
    """What plays the episodes. Raises UserError: Ray is not installed, or answers nowhere."""
    from tab_marl.evaluation.engines.local import LocalEngine
    from tab_marl.evaluation.episode import play_job

    workers = experiment.settings.workers
    if manner.engine == "local":
        return LocalEngine(play_job, workers)
    from tab_marl.evaluation.engines.cluster import RayEngine
    from tab_marl.evaluation.engines.cluster_worker import pack
    from tab_marl.evaluation.provenance import identity
    from tab_marl.evaluation.settings import code_fingerprint

    return RayEngine(
        play_job, identity(code_fingerprint()), manner.address, workers, pack(experiment.adversaries), notes.print
    )


CALIBRATION_SECONDS = 120.0
"""An estimate above this, with nothing stored, is worth a few seconds of measuring."""


def _announce(experiment: Experiment, store: Store, manner: Manner, notes: Console) -> bool:
    """Print the size, time and intervals of what is about to be played; True if that was all that was wanted."""
    from tab_marl.evaluation import planning_ahead

    settings = experiment.settings
    done = store.keys(experiment.key)
    missing = [
        (m, f, p, seed)
        for m in settings.missions
        for f in settings.families
        for p in settings.planners
        for seed in range(settings.episodes)
        if (m, f, p, seed) not in done
    ]
    if missing:
        # Timings of other settings tell what an episode costs nearly as well as our own.
        keys = [s.key for s in store.settings() if s.rows]
        key = experiment.key if experiment.key in keys else (keys[0] if keys else None)
        timings = {} if key is None else store.timings(key)
        cost = planning_ahead.estimate(missing, timings)
        if not timings and cost.processor_seconds > CALIBRATION_SECONDS:
            if first_use():
                notes.print(FIRST_USE, highlight=False)
            speed = planning_ahead.speed_of(measured_decision_milliseconds())
            cost = planning_ahead.estimate(missing, {}, speed)
        workers = (settings.workers or os.cpu_count() or 1) if manner.engine == "local" else (settings.workers or 0)
        for line in planning_ahead.forecast(
            settings.episodes, manner.half_width / 100, store.rows(experiment.key), cost, workers
        ):
            notes.print(line, highlight=False)
    elif manner.dry_run:
        notes.print(f"nothing to play: all {settings.total} episodes are stored in {store.path}", highlight=False)
    return manner.dry_run


def measured_decision_milliseconds() -> float:
    """Processor time of a decision of TAB-POMCP, with its field alone, on M1, here and now: two short episodes, the first
    to load the kernels.
    """
    import numpy as np

    from tab_marl.agents.adversaries import ScriptedAdversary
    from tab_marl.agents.planners import PlannerOptions, make_planner
    from tab_marl.evaluation.episode import run_episode
    from tab_marl.mission.tasks import sample_task

    task = sample_task(np.random.default_rng(1), "M1", "point", None)
    timing = None
    for steps in (11, 60):
        planner = make_planner("TAB-POMCP", PlannerOptions(ways=None))
        timing = run_episode(task, planner, ScriptedAdversary(), seed=1, max_steps=steps).timing
    assert timing is not None
    return 1000 * timing.decision_processor_seconds / timing.decisions


def play_missing(
    experiment: Experiment, store: Store, engine: Engine, console: Console, hint: str, retry_failed: bool = False
) -> None:
    """Play what the store lacks. Raises UserError, saying how to continue, if interrupted."""
    from tab_marl.evaluation.provenance import run_record

    settings, key = experiment.settings, experiment.key
    store.use(key, experiment.content, dataclasses.asdict(settings))
    if retry_failed:
        again = failed_episodes(store, key)
        store.forget(key, again)
        console.print(f"{len(again)} episodes that had failed, or learned from one that had, are played again")
    done = _count_done(experiment, store)
    if done == settings.total:
        console.print(f"all {settings.total} episodes are already stored in {store.path}", highlight=False)
        return
    if done:
        console.print(f"{done} of {settings.total} episodes are already stored; playing the rest", highlight=False)
    others = [s for s in store.settings() if s.key != key and s.rows]
    if others:
        console.print(
            f"{sum(s.rows for s in others)} episodes of {len(others)} other settings lie in {store.path} and are kept apart",
            highlight=False,
        )
    if first_use():
        console.print(FIRST_USE, highlight=False)
    about = {"name": engine.name, "workers": engine.workers}
    run_id = store.begin_run(key, run_record(settings, experiment.code, zoo_checksums(experiment.adversaries), about))
    outcome = "failed"
    try:
        with _progress(console, settings.total, done) as watch:
            run(settings, experiment.adversaries, store, key, engine, run_id, watch)
        outcome = "finished"
    except Interrupted:
        outcome = "interrupted"
        stored = _count_done(experiment, store)
        raise UserError(f"interrupted: {stored} of {settings.total} episodes are stored; to continue: {hint}") from None
    finally:
        store.end_run(run_id, outcome)


def failed_episodes(store: Store, key: str) -> list[Key]:
    """Episodes stored with an error, and those after them of planners that learn across episodes."""
    from tab_marl.evaluation.settings import LEARNS_ACROSS_EPISODES

    rows = store.rows(key)
    failed = [r.key for r in rows if r.error is not None]
    first: dict[tuple[str, str, str], int] = {}
    for mission, family, planner, seed in failed:
        if planner in LEARNS_ACROSS_EPISODES:
            chain = (mission, family, planner)
            first[chain] = min(seed, first.get(chain, seed))
    later = [r.key for r in rows if r.error is None and r.seed > first.get(r.key[:3], r.seed)]
    return failed + later


def first_use(part: str = "planning") -> bool:
    """Whether no compiled kernel of this part of the package lies in the usual cache yet."""
    import tab_marl

    if os.environ.get("NUMBA_CACHE_DIR"):
        return not any(Path(os.environ["NUMBA_CACHE_DIR"]).rglob("*.nbi"))
    return not any((Path(tab_marl.__file__).parent / part).rglob("*.nbi"))


def _count_done(experiment: Experiment, store: Store) -> int:
    s = experiment.settings
    return sum(
        m in s.missions and f in s.families and p in s.planners and seed < s.episodes
        for m, f, p, seed in store.keys(experiment.key)
    )


class _progress:
    """A bar with an estimate on a terminal; elsewhere a line each tenth of the way."""

    def __init__(self, console: Console, total: int, done: int) -> None:
        self.console, self.total, self.done, self.failed = console, total, done, 0
        self.next_line = done + max(1, total // 10)
        self.bar = Progress(
            TextColumn("episodes"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
            TextColumn("left"), TimeRemainingColumn(), TextColumn("{task.fields[note]}"), console=console,
        ) if console.is_terminal else None  # fmt: skip

    def __enter__(self) -> Watch:
        if self.bar is not None:
            self.bar.start()
            self.task = self.bar.add_task("", total=self.total, completed=self.done, note="starting workers")
        return Watch(self.advance, self.add, self.note)

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.stop()

    def advance(self, results: list[Result]) -> None:
        self.failed += sum(row.error is not None for row, _ in results)
        self.add(len(results))

    def note(self, text: str) -> None:
        self.console.print(text, highlight=False)

    def add(self, count: int) -> None:
        self.done += count
        note = f"{self.failed} broke down" if self.failed else ""
        if self.bar is not None:
            self.bar.update(self.task, completed=self.done, note=note)
        elif self.done >= self.next_line or self.done == self.total:
            self.next_line = self.done + max(1, self.total // 10)
            self.console.print(f"{self.done} of {self.total} episodes {note}".rstrip(), highlight=False)
