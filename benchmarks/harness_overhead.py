"""How much of an evaluation is neither planner nor physics: everything that `tab-marl evaluate` adds to the episodes.

One run of real episodes in worker processes, as the command plays them. Processor time is counted, of this process and of
its workers until they end, so that other jobs on the machine change little: what planners and the simulation took is
measured inside the episodes, the rest is the harness's (drawing tasks, loading policies, storing, passing messages, the
rows themselves). Starting processes (imports, loading compiled kernels) is counted too, and also shown alone, because it
is paid once per run: the last line says what it amounts to in a run of the paper's size.

    python benchmarks/harness_overhead.py --episodes 6 --workers 2
"""

from __future__ import annotations

import resource
import tempfile
import time
from pathlib import Path
from typing import Annotated

import typer

from tab_marl.evaluation.engines.local import LocalEngine
from tab_marl.evaluation.episode import play_job
from tab_marl.evaluation.evaluate import prepare
from tab_marl.evaluation.rows import Timing
from tab_marl.evaluation.runner import Watch, run
from tab_marl.evaluation.settings import PAPER_PLANNERS, EvaluationSettings
from tab_marl.evaluation.store import Store

LIMIT = 0.05
PAPER_SIZE = 150 * 5 * 6
PLANNERS = (*PAPER_PLANNERS, "population-POMCP", "oracle")


def processor_seconds() -> float:
    """Of this process and its ended children."""
    own, children = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def measured(settings: EvaluationSettings, workers: int) -> tuple[list[Timing], float, float]:
    """(timings, processor seconds of everything, wall seconds) of playing these settings into a fresh store."""
    experiment = prepare(settings)
    with tempfile.TemporaryDirectory() as folder, Store.create(Path(folder)) as store:
        store.use(experiment.key, experiment.content, {})
        began, before = time.perf_counter(), processor_seconds()
        run(
            settings,
            experiment.adversaries,
            store,
            experiment.key,
            LocalEngine(play_job, workers),
            store.begin_run(experiment.key, {}),
            Watch(),
        )
        spent, wall = processor_seconds() - before, time.perf_counter() - began
        return list(store.timings(experiment.key).values()), spent, wall


def main(
    episodes: Annotated[int, typer.Option(min=1, help="Per mission and planner.")] = 6,
    workers: Annotated[int, typer.Option(min=1)] = 2,
    families: Annotated[str, typer.Option(help="Comma-separated.")] = "point",
    seed: Annotated[int, typer.Option(help="Base seed.")] = 77,
) -> None:
    """Measure and print."""
    tiny = EvaluationSettings(missions=("M1",), families=("point",), planners=PLANNERS, episodes=1, seed=seed + 1)
    measured(tiny, 1)  # compiles, where nothing is compiled yet
    timings, all_of_it, _ = measured(tiny, 1)
    start = all_of_it - sum(t.planner_processor_seconds + t.simulation_processor_seconds for t in timings)
    settings = EvaluationSettings(families=tuple(families.split(",")), planners=PLANNERS, episodes=episodes, seed=seed)
    timings, spent, wall = measured(settings, workers)
    planner = sum(t.planner_processor_seconds for t in timings)
    simulation = sum(t.simulation_processor_seconds for t in timings)
    rest = spent - planner - simulation
    steady = max(0.0, rest - workers * start)
    count = len(timings)
    print(f"{count} episodes, {workers} workers, {wall:.0f} s; processor time {spent:.1f} s:")
    for name, seconds in (("planners", planner), ("physics and adversaries", simulation), ("everything else", rest)):
        print(f"  {name:<24}{seconds:8.1f} s  {100 * seconds / spent:5.1f} %")
    print(
        f"  of everything else, {workers} starts of a worker: {workers * start:.1f} s; per episode: {1000 * steady / count:.1f} ms"
    )
    each = (planner + simulation) / count
    whole = (steady / count * PAPER_SIZE + workers * start) / ((each + steady / count) * PAPER_SIZE + workers * start)
    print(
        f"share of the harness in a run of {PAPER_SIZE} episodes (150 x 5 missions x 6 planners): {100 * whole:.1f} % "
        f"(limit {100 * LIMIT:.0f} %: {'kept' if whole <= LIMIT else 'EXCEEDED'})"
    )
    hours = ((each + steady / count) * PAPER_SIZE / workers + start) / 3600
    print(f"such a run takes {60 * hours:.0f} min of processor time on each of {workers} cores (limit 60 min)")


if __name__ == "__main__":
    typer.run(main)
