"""``tab-marl train``: a policy, or a whole population, with progress and time left."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from tab_marl.evaluation.errors import UserError, user_input

if TYPE_CHECKING:
    from tab_marl.agents.population.run import MemberStand
    from tab_marl.agents.training.train import Progress as Stand

TENTHS = 10


def train_one(
    style: str | None,
    algorithm: str | None,
    config: Path | None,
    changes: Mapping[str, Any],
    out: Path | None,
    console: Console,
) -> None:
    """Train, or continue, a policy with a progress bar; exports it when done."""
    from tab_marl.agents.policies.zoo import export_policy
    from tab_marl.agents.training.settings import TrainingSettings
    from tab_marl.agents.training.train import train

    if config is not None and (style is not None or algorithm is not None):
        raise UserError("give --config, or --style and --algorithm, not both: the file holds them")
    given = {name: value for name, value in changes.items() if value is not None}
    _check_steps(given.get("steps"))
    with user_input():
        if config is not None:
            settings = replace(TrainingSettings.from_toml(config), **given)
        else:
            settings = TrainingSettings.for_style(style or "direct", algorithm=algorithm or "ppo", **given)
    folder = out if out is not None else Path("runs/train") / settings.name
    with Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"), TimeElapsedColumn(),
        TextColumn("left"), TimeRemainingColumn(), TextColumn("{task.fields[note]}"), console=console,
    ) as bar:  # fmt: skip
        tasks = bar.add_task("tasks   ", total=settings.tasks, note="")
        steps = bar.add_task("training", total=settings.steps, note="", start=False)

        def show(stand: Stand) -> None:
            if stand.phase == "tasks":
                bar.update(tasks, completed=stand.done, total=stand.total)
                return
            bar.start_task(steps)
            if stand.phase == "habits":
                bar.update(steps, completed=settings.steps, note=f"hunted, round {stand.done} of {stand.total}")
                return
            bar.update(
                steps, completed=stand.done, note=f"{stand.steps_per_second:.0f} steps/s  {shares(stand.success)}"
            )

        try:
            model = train(settings, folder, show)
        except KeyboardInterrupt:
            raise UserError(f"interrupted: the same command continues the run in {folder}") from None
    path = export_policy(model, settings, folder)
    console.print(
        f"policy: {path}; learning curve: {folder / 'log.csv'}; tensorboard --logdir {folder}", highlight=False
    )


def train_many(
    file: Path, only: Sequence[str] | None, workers: int | None, steps: int | None, out: Path | None, console: Console
) -> bool:
    """Train, or continue, the population of a file and write its page; returns whether every member succeeded."""
    from tab_marl.agents.population.members import Population
    from tab_marl.agents.population.report import write_report
    from tab_marl.agents.population.run import DONE, FAILED, stand_of, train_population

    _check_steps(steps)
    whole = Population.load(file)
    population = whole.only(only) if only else whole
    if steps is not None:
        with user_input():
            population = replace(population, members=tuple(replace(m, steps=steps) for m in population.members))
    population.check()
    folder = out if out is not None else Path("runs/train") / population.name
    count = workers if workers is not None else min(os.cpu_count() or 1, len(population.members))
    began = time.monotonic()
    shown = _Bars(console, count) if console.is_terminal else _Lines(console, count)
    try:
        with shown:
            stands = train_population(population, folder, count, shown)
    except KeyboardInterrupt:
        raise UserError(f"interrupted: the same command continues the runs in {folder}") from None
    # The page shows the members that were not asked for, too, as far as they have come.
    page = write_report(population, {m.name: stands.get(m.name) or stand_of(m, folder) for m in whole.members}, folder)
    failed = [stand for stand in stands.values() if stand.status == FAILED]
    for stand in failed:
        console.print(f"{stand.name} failed: {stand.error} (more in {stand.folder / 'error.txt'})", style="red")
    done = sum(stand.status == DONE for stand in stands.values())
    console.print(
        f"{done} of {len(stands)} policies trained in {clock(time.monotonic() - began)}; learning curves: {page}; "
        f"tensorboard --logdir {folder}",
        highlight=False,
    )
    return not failed


def _check_steps(steps: int | None) -> None:
    # In settings 0 means "as the hyperparameters say"; who types it means something else.
    if steps is not None and steps < 1:
        raise UserError(f"steps is {steps}, must be >= 1")


def shares(success: Mapping[str, float] | None) -> str:
    """ "M1 99 % M2 80 %", what is not known yet left out."""
    known = {mission: share for mission, share in (success or {}).items() if math.isfinite(share)}
    return " ".join(f"{mission} {100 * share:.0f} %" for mission, share in known.items())


def clock(seconds: float) -> str:
    """ "1:02:03" or "2:03"."""
    whole = int(seconds + 0.5)
    hours, minutes = whole // 3600, whole // 60 % 60
    return f"{hours}:{minutes:02d}:{whole % 60:02d}" if hours else f"{minutes}:{whole % 60:02d}"


class _Lines:
    """Where nobody watches: a line for every tenth of a member, and one when it ends."""

    def __init__(self, console: Console, workers: int) -> None:
        self._console, self._workers = console, workers
        self._tenths: dict[str, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *ending: object) -> None: ...

    def __call__(self, stand: MemberStand, stands: dict[str, MemberStand]) -> None:
        from tab_marl.agents.population.run import FAILED, HABITS, TRAINING, seconds_left, share_done

        ended = sum(s.ended for s in stands.values())
        tenth = int(TENTHS * share_done(stand))
        if stand.status in (TRAINING, HABITS) and tenth == self._tenths.get(stand.name, 0):
            return
        self._tenths[stand.name] = tenth
        said = stand.error if stand.status == FAILED else shares(stand.success)
        self._console.print(
            f"{stand.name}: {stand.status}, {stand.steps} of {stand.settings.steps} steps"
            f"{', ' + said if said else ''}; {ended} of {len(stands)} ended, "
            f"{clock(seconds_left(stands, self._workers))} left",
            highlight=False,
        )


class _Bars:
    """In a terminal: a bar for the population, and one for every member at work."""

    def __init__(self, console: Console, workers: int) -> None:
        self._workers = workers
        self._progress = Progress(
            TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"), TimeElapsedColumn(),
            TextColumn("{task.fields[note]}"), console=console,
        )  # fmt: skip
        self._whole = self._progress.add_task("population", total=1.0, note="")
        self._bars: dict[str, TaskID] = {}

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *ending: object) -> None:
        self._progress.stop()

    def __call__(self, stand: MemberStand, stands: dict[str, MemberStand]) -> None:
        from tab_marl.agents.population.run import DONE, FAILED, expected_seconds, seconds_left, share_done

        if stand.ended:
            bar = self._bars.pop(stand.name, None)
            if bar is not None:
                self._progress.remove_task(bar)
                said = shares(stand.success) if stand.status == DONE else f"failed: {stand.error}"
                self._progress.console.print(f"{stand.name}: {said}", highlight=False)
        else:
            if stand.name not in self._bars:
                self._bars[stand.name] = self._progress.add_task(stand.name, total=stand.settings.steps, note="")
            self._progress.update(
                self._bars[stand.name], completed=stand.steps, note=f"{stand.status}  {shares(stand.success)}"
            )
        weight = {name: expected_seconds(s.settings) for name, s in stands.items()}
        done = sum(weight[name] * share_done(s) for name, s in stands.items())
        ended = sum(s.ended for s in stands.values())
        failed = sum(s.status == FAILED for s in stands.values())
        self._progress.update(
            self._whole,
            completed=done / sum(weight.values()),
            note=f"{ended} of {len(stands)} ended{f', {failed} failed' if failed else ''}, "
            f"{clock(seconds_left(stands, self._workers))} left",
        )
