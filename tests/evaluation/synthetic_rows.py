"""Made-up episodes with known statistics, in place of simulated ones: a pure function of the job, like the real thing."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import time
from pathlib import Path

import numpy as np

from tab_marl.evaluation.engines.interface import Outcome
from tab_marl.evaluation.engines.local import LocalEngine
from tab_marl.evaluation.rows import EpisodeRow, Timing
from tab_marl.evaluation.runner import run
from tab_marl.evaluation.settings import EvaluationSettings, settings_key
from tab_marl.evaluation.store import Store
from tab_marl.evaluation.units import Job, unit_seeds

HORIZON = 6000
SKILL = {
    "S-POMCP": 0.2,
    "FP-POMCP": 0.4,
    "MLE-POMCP": 0.5,
    "TAB-POMCP": 0.75,
    "TAB-POMCP+precedents": 0.78,
    "population-POMCP": 0.8,
    "oracle": 1.0,
    "random": 0.05,
}


def row(
    planner="TAB-POMCP", seed=0, mission="M1", family="point", intercepted=True, completed=False, steps=300, **more
):
    return EpisodeRow(
        mission=mission,
        family=family,
        planner=planner,
        seed=seed,
        adversary=more.pop("adversary", f"policy-{seed % 3}"),
        slack=more.pop("slack", 1.5),
        intercepted=intercepted,
        completed=completed,
        failed=more.pop("failed", False),
        physics_steps=steps if intercepted else HORIZON,
        horizon_steps=HORIZON,
        completed_step=1200 if completed else None,
        **more,
    )


def timing(milliseconds=5.0):
    return Timing(120, milliseconds, 3 * milliseconds, 2.0)


def play(job: Job):
    """Episodes whose outcome is paired over planners through the unit, as in a real evaluation."""
    task, episode, _ = unit_seeds(job.base_seed, job.unit)
    luck = np.random.default_rng(task).random()
    results = []
    for planner in job.planners:
        caught = luck < SKILL[planner]
        steps = 200 + int(2000 * luck * (1.5 - SKILL[planner]))
        learned = None
        if planner == "MLE-POMCP":
            # The chain's state: wrong if a link is skipped, repeated or played out of order.
            learned = hashlib.sha256(f"{job.learned}|{episode}".encode()).hexdigest()
            steps += int(learned, 16) % 50
        results.append(
            (
                row(planner, job.unit.seed, job.unit.mission, job.unit.family, caught, luck > (1 + SKILL[planner]) / 2, steps,
                    adversary=job.adversary, slack=1.2 + luck, ego_first=luck < 0.3, learned=learned and json.dumps(learned)),
                timing(),
            )
        )  # fmt: skip
    return results


def play_slowly(job: Job):
    time.sleep(0.05)
    return play(job)


def play_where_a_node_dies(job: Job):
    """On a Ray cluster: the timing's text is the node that played; one node dies while it plays, after all have begun.

    The folder SYNTHETIC_NODES holds a file per node that began, and `head`, whose text is the node the cluster stands on.
    """
    import dataclasses

    import ray

    node, folder = ray.get_runtime_context().get_node_id(), Path(os.environ["SYNTHETIC_NODES"])
    (folder / f"node-{node}").touch()
    deadline = time.monotonic() + 120
    while len(list(folder.glob("node-*"))) < 3 and time.monotonic() < deadline:
        time.sleep(0.02)
    if job.unit.seed >= 4 and node != (folder / "head").read_text():
        with contextlib.suppress(FileExistsError):
            (folder / "died").touch(exist_ok=False)
            os.kill(os.getppid(), signal.SIGKILL)  # a worker's parent is its node's raylet
            time.sleep(60)  # the episode is not finished: workers of a dead raylet end
    time.sleep(0.05)
    return [(row, dataclasses.replace(spent, traceback=node)) for row, spent in play(job)]


def play_and_break(job: Job):
    """Workers die of one planner's episode, always, and of another's the first time."""
    if job.unit.seed == 3 and job.unit.mission == "M4":
        if "TAB-POMCP" in job.planners:
            os.kill(os.getpid(), signal.SIGKILL)
        marker = Path(os.environ["SYNTHETIC_MARKER"])
        if "MLE-POMCP" in job.planners and not marker.exists():
            marker.write_text("")
            os.kill(os.getpid(), signal.SIGKILL)
    return play(job)


def play_and_always_break(job: Job):
    os.kill(os.getpid(), signal.SIGKILL)


def play_noting(job: Job):
    """Each episode leaves a line: to see how often it was played, and by whom."""
    with Path(os.environ["SYNTHETIC_MARKER"]).open("a") as log:
        log.writelines(
            f"{job.unit.mission} {job.unit.family} {planner} {job.unit.seed} {os.getppid()}\n"
            for planner in job.planners
        )
    _wait_for_players(int(os.environ.get("SYNTHETIC_PLAYERS", "1")))
    return play_slowly(job)


def _wait_for_players(count: int) -> None:
    """Until so many runs have begun to play: one that starts faster must not finish alone."""
    deadline = time.monotonic() + 90
    while time.monotonic() < deadline:
        lines = Path(os.environ["SYNTHETIC_MARKER"]).read_text().splitlines()
        if len({line.rsplit(" ", 1)[-1] for line in lines}) >= count:
            return
        time.sleep(0.02)


class Inline:
    """An engine that plays in this process, one job after the other: what every other engine must agree with."""

    name, workers = "inline", 1

    def __init__(self, play):
        self._play, self._ended = play, []

    @property
    def room(self):
        return 0 if self._ended else 1

    def submit(self, ticket, job):
        self._ended.append(Outcome(ticket, self._play(job)))

    def collect(self, timeout_seconds):
        ended, self._ended = self._ended, []
        return ended

    def stop(self):
        return self.collect(0.0)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


def evaluate_with(folder: Path, episodes: int, engine) -> None:
    """A whole evaluation with synthetic episodes."""
    settings = EvaluationSettings(
        missions=("M1", "M3"),
        families=("point",),
        planners=("S-POMCP", "MLE-POMCP", "TAB-POMCP"),
        episodes=episodes,
        seed=7,
    )
    with Store.create(folder) as store:
        content = settings.content("code", ("a", "b"))
        key = settings_key(content)
        store.use(key, content, {})
        run_id = store.begin_run(key, {})
        run(settings, ("a", "b"), store, key, engine, run_id)
        store.end_run(run_id, "finished")


def evaluate_folder(folder: str, episodes: str, workers: str, play: str = "play_slowly") -> None:
    """The same in worker processes, to be run, and killed, as a process of its own."""
    import synthetic_rows

    evaluate_with(Path(folder), int(episodes), LocalEngine(getattr(synthetic_rows, play), int(workers)))


if __name__ == "__main__":
    import sys

    import synthetic_rows

    synthetic_rows.evaluate_folder(*sys.argv[1:])
