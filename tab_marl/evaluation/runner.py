"""Plays the missing episodes in worker processes and stores each as it ends. The parent alone writes."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing.synchronize import Event
from typing import Any

from tab_marl.evaluation.errors import Interrupted, UserError
from tab_marl.evaluation.rows import EpisodeRow, Timing
from tab_marl.evaluation.settings import EvaluationSettings
from tab_marl.evaluation.store import Store
from tab_marl.evaluation.units import Job, Schedule

Result = tuple[EpisodeRow, Timing]
Play = Callable[[Job], list[Result]]

# One process per core already: libraries that start threads of their own only get in each other's way.
SINGLE_THREADED = {
    name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
}

POLL_SECONDS = 0.5

_stop: Event | None = None


def stop_requested() -> bool:
    """In a worker: whether the parent asked to stop."""
    return _stop is not None and _stop.is_set()


def run(
    settings: EvaluationSettings,
    adversaries: tuple[str, ...],
    store: Store,
    key: str,
    play: Play,
    on_result: Callable[[list[Result]], None] = lambda results: None,
) -> None:
    """Play every episode of the settings that the store lacks under this key.

    Raises Interrupted after Ctrl-C (everything finished is stored) and UserError if a worker process dies.
    """
    schedule = Schedule(settings, adversaries, store.keys(key))
    for unit, planner in schedule.begin_chains():
        before = store.learned(key, unit.mission, unit.family, planner, unit.seed - 1) if unit.seed else None
        schedule.push_link(unit, planner, before)
    if schedule.missing == 0:
        return
    workers = min(settings.workers or os.cpu_count() or 1, schedule.missing)
    with pool(workers) as (executor, stop):
        running: dict[Future[list[Result]], Job] = {}
        # The first job runs alone: it compiles the kernels, once, into a cache that the other workers then read.
        limit = 1
        try:
            while True:
                while len(running) < limit and (job := schedule.pop()) is not None:
                    running[executor.submit(play, job)] = job
                if not running:
                    return
                done, _ = wait(running, timeout=POLL_SECONDS, return_when=FIRST_COMPLETED)
                for future in done:
                    job = running.pop(future)
                    results = future.result()
                    store.add(key, results)
                    if job.is_link:
                        unit = replace(job.unit, seed=job.unit.seed + 1)
                        schedule.push_link(unit, job.planners[0], results[-1][0].learned)
                    on_result(results)
                if done:
                    limit = workers + 1  # one in the queue keeps every worker busy
        except KeyboardInterrupt:
            stop.set()
            for future in running:
                future.cancel()
            with contextlib.suppress(KeyboardInterrupt):
                _keep_finished(running, store, key)
            raise Interrupted from None
        except BrokenProcessPool:
            raise UserError(
                "a worker process died (out of memory?); finished episodes are stored and the same command continues, "
                "with fewer --workers if memory is short"
            ) from None
        except BaseException:
            stop.set()
            raise


def _keep_finished(running: dict[Future[list[Result]], Job], store: Store, key: str) -> None:
    """Wait for the workers to notice, and store what they had finished."""
    wait(running, timeout=10.0)
    for future in running:
        if future.done() and not future.cancelled() and future.exception() is None:
            store.add(key, future.result())


@contextlib.contextmanager
def pool(workers: int) -> Iterator[tuple[ProcessPoolExecutor, Event]]:
    """Fresh single-threaded processes that end with their parent, however it ends."""
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    with _environment(SINGLE_THREADED):
        executor = ProcessPoolExecutor(workers, mp_context=context, initializer=_begin_worker, initargs=(stop,))
        try:
            yield executor, stop
        finally:
            stop.set()
            executor.shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _begin_worker(stop: Any) -> None:
    global _stop
    _stop = stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    # A killed parent leaves its workers waiting for work for ever: each holds both ends of the queue.
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
