"""The whole evaluation: settings to rows, tables and report, with progress for the person who waits."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from tab_marl.evaluation.engines.interface import Engine, Result
from tab_marl.evaluation.errors import Interrupted, UserError
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
    for *chain, seed in failed:
        if chain[2] in LEARNS_ACROSS_EPISODES:
            first[tuple(chain)] = min(seed, first.get(tuple(chain), seed))
    later = [r.key for r in rows if r.error is None and r.seed > first.get(r.key[:3], r.seed)]
    return failed + later


def first_use(part: str = "planning") -> bool:
    """Whether no compiled kernel of this part of the package lies in the usual cache yet."""
    import os

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
