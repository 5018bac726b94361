"""Trains the members of a population in processes of their own, one thread each.

The process that calls `train_population` only watches. A member that fails, or whose process dies, is reported and the
others go on; whatever is killed, the same call continues every member from its last checkpoint.
"""

from __future__ import annotations

import multiprocessing as mp
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from tab_marl.agents.population.members import Population
from tab_marl.agents.processes import SINGLE_THREADED, environment
from tab_marl.agents.training.algorithms import ALGORITHMS
from tab_marl.agents.training.settings import UNOPPOSED, TrainingError, TrainingSettings

WAITING, TASKS, TRAINING, HABITS, DONE, FAILED = "waiting", "tasks", "training", "habits", "done", "failed"
ERROR_FILE = "error.txt"
"""In a member's folder: the traceback of what ended it."""
START_SECONDS = 20.0
"""CPU seconds before a member's first step (imports, tasks), for the estimate of what is left."""
HUNTED_FACTOR = 20.0
"""A guess of how much longer a hunted member's step takes, until one has been seen."""
EPISODE_SECONDS = 1.5
"""CPU seconds of an episode in which a planner hunts."""
POLL_SECONDS = 1.0


@dataclass(frozen=True)
class MemberStand:
    """Where a member stands."""

    settings: TrainingSettings
    folder: Path
    status: str = WAITING
    steps: int = 0
    cpu_seconds: float = 0.0
    steps_per_second: float = 0.0
    success: dict[str, float] | None = None
    habit_share: float = 0.0
    """Of the hunted episodes in which habits are learned."""
    error: str = ""
    """One line, if it failed."""

    @property
    def name(self) -> str:
        return self.settings.name

    @property
    def ended(self) -> bool:
        return self.status in (DONE, FAILED)


Stands = dict[str, MemberStand]
OnStand = Callable[[MemberStand, Stands], None]


def train_population(
    population: Population, out_dir: Path | str, workers: int = 1, on_stand: OnStand | None = None
) -> Stands:
    """Train, or continue, every member in ``out_dir/<name>``; returns how each ended, by name.

    on_stand: told of every change, with the stands of all. Raises TrainingError for fewer than one worker; OSError if
    `out_dir` cannot be written. KeyboardInterrupt ends the workers; they lose what came after their last checkpoint.
    """
    if workers < 1:
        raise TrainingError(f"workers is {workers}, must be >= 1")
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    stands = {m.name: stand_of(m, out) for m in population.members}

    def tell(name: str, **changes: Any) -> None:
        stands[name] = replace(stands[name], **changes)
        if on_stand is not None:
            on_stand(stands[name], stands)

    for name, stand in stands.items():
        if stand.ended:
            tell(name)
    # The longest first: else the last worker is left alone with one of them.
    queue = sorted((s for s in stands.values() if not s.ended), key=lambda s: -expected_seconds(s.settings))
    running: dict[Any, tuple[str, Any]] = {}
    context = mp.get_context("spawn")
    try:
        with environment(SINGLE_THREADED):
            while queue or running:
                while queue and len(running) < workers:
                    stand = queue.pop(0)
                    receive, send = context.Pipe(duplex=False)
                    arguments = (stand.settings, stand.folder, population.command(stand.settings), send)
                    process = context.Process(target=_work, args=arguments, daemon=True, name=stand.name)
                    process.start()
                    send.close()
                    running[receive] = (stand.name, process)
                    tell(stand.name, status=TASKS)
                for ready in wait(list(running), timeout=POLL_SECONDS):
                    assert isinstance(ready, Connection)
                    name, process = running[ready]
                    try:
                        tell(name, **ready.recv())
                    except EOFError:
                        del running[ready]
                        ready.close()
                        process.join()
                        if not stands[name].ended:
                            tell(name, status=FAILED, error=f"its process ended with status {process.exitcode}")
    finally:
        for receive, (_, process) in running.items():
            process.terminate()
            process.join()
            receive.close()
    return stands


def _work(settings: TrainingSettings, folder: Path, command: str, send: Connection) -> None:
    """One member, in a process of its own; tells the parent what to change in its stand."""
    from tab_marl.agents.policies.zoo import export_policy
    from tab_marl.agents.training.train import Progress, train

    def tell(stand: Progress) -> None:
        if stand.phase == HABITS:
            send.send({"status": HABITS, "habit_share": stand.done / stand.total})
        elif stand.phase == TRAINING:
            send.send(
                {
                    "status": TRAINING,
                    "steps": stand.done,
                    "cpu_seconds": stand.cpu_seconds,
                    "steps_per_second": stand.steps_per_second,
                    "success": stand.success,
                }
            )

    try:
        model = train(settings, folder, tell)
        export_policy(model, settings, folder, command)
        (folder / ERROR_FILE).unlink(missing_ok=True)
        send.send({"status": DONE, "steps": int(model.num_timesteps), "cpu_seconds": _logged_seconds(folder)})
    except KeyboardInterrupt:
        pass  # the parent was told, too
    except BrokenPipeError:
        pass  # the parent is gone; whoever starts again continues from the checkpoint
    except Exception as error:  # noqa: BLE001, whatever it is, the others must go on
        if folder.is_dir():
            (folder / ERROR_FILE).write_text(traceback.format_exc(), encoding="utf-8")
        send.send({"status": FAILED, "error": " ".join(f"{type(error).__name__}: {error}".split())})
    finally:
        send.close()


def stand_of(settings: TrainingSettings, out_dir: Path) -> MemberStand:
    """Where a member stands when nobody trains it: done or waiting."""
    folder = out_dir / settings.name
    if not finished(settings, folder):
        return MemberStand(settings, folder)
    return MemberStand(settings, folder, DONE, settings.steps, _logged_seconds(folder))


def finished(settings: TrainingSettings, folder: Path) -> bool:
    """Whether the folder holds the exported policy of a run with exactly these settings."""
    from tab_marl.agents.policies.zoo import CARD_FILE, POLICY_FOLDER

    card, kept = folder / POLICY_FOLDER / CARD_FILE, folder / "settings.toml"
    try:
        if card.stat().st_mtime_ns < kept.stat().st_mtime_ns:
            return False  # continued since, under another split or description
        theirs = TrainingSettings.from_toml(kept)
    except (OSError, TrainingError):
        return False
    return replace(theirs, checkpoint_seconds=settings.checkpoint_seconds) == settings


def _logged_seconds(folder: Path) -> float:
    from tab_marl.agents.training.log import read_log

    try:
        return float(read_log(folder).cpu_seconds[-1])
    except (OSError, ValueError, IndexError):
        return 0.0


def expected_seconds(settings: TrainingSettings) -> float:
    """A guess of the CPU seconds that a member takes from its beginning to its end."""
    return _training_seconds(settings) + EPISODE_SECONDS * settings.hunted_episodes


def _training_seconds(settings: TrainingSettings) -> float:
    factor = HUNTED_FACTOR if (settings.opponent != UNOPPOSED) else 1.0
    return START_SECONDS + ALGORITHMS[settings.algorithm].seconds_per_kilostep * factor * settings.steps / 1000.0


def share_done(stand: MemberStand) -> float:
    """Of a member's expected work."""
    if stand.ended:
        return 1.0
    whole = expected_seconds(stand.settings)
    habits = EPISODE_SECONDS * stand.settings.hunted_episodes
    return ((whole - habits) * stand.steps / stand.settings.steps + habits * stand.habit_share) / whole


def seconds_left(stands: Stands, workers: int) -> float:
    """Wall seconds until all members have ended, from the rates seen so far."""
    left = []
    for stand in stands.values():
        if stand.ended:
            continue
        habits = EPISODE_SECONDS * stand.settings.hunted_episodes * (1.0 - stand.habit_share)
        if stand.steps_per_second > 0:
            left.append((stand.settings.steps - stand.steps) / stand.steps_per_second + habits)
        else:
            left.append(_training_seconds(stand.settings) * _slowness(stand.settings, stands) + habits)
    busy = min(workers, max(len(left), 1))
    return max(sum(left) / busy, max(left, default=0.0))


def _slowness(settings: TrainingSettings, stands: Stands) -> float:
    """Seconds taken over seconds expected, of members of the same kind that have run."""
    seen = [s for s in stands.values() if s.cpu_seconds > 0 and s.steps > 0]
    hunted = settings.opponent != UNOPPOSED
    alike = [s for s in seen if (s.settings.opponent != UNOPPOSED) == hunted]
    pairs = [(s.cpu_seconds, _training_seconds(replace(s.settings, steps=s.steps))) for s in alike]
    return sum(took for took, _ in pairs) / sum(expected for _, expected in pairs) if pairs else 1.0
