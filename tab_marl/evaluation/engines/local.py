"""Worker processes of this machine, one job each at a time: when one dies it is known which job it had."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.connection import Connection, wait
from multiprocessing.synchronize import Event
from types import TracebackType
from typing import Any, Self

from tab_marl.agents.processes import SINGLE_THREADED, environment
from tab_marl.evaluation.engines.interface import Outcome, Play
from tab_marl.evaluation.errors import Interrupted
from tab_marl.evaluation.units import Job

STOP_SECONDS = 10.0
"""How long workers may take to notice that they should stop, before they are killed."""

_stop: Event | None = None


def stop_requested() -> bool:
    """In a worker: whether the parent asked to stop."""
    return _stop is not None and _stop.is_set()


class LocalEngine:
    """`workers` processes; one at first, which compiles the kernels into a cache that the others then read."""

    name = "local"

    def __init__(self, play: Play, workers: int | None = None) -> None:
        self._play = play
        self._workers = workers or os.cpu_count() or 1
        self._context = multiprocessing.get_context("spawn")
        self._stop = self._context.Event()
        self._slots: list[_Slot] = []
        self._warm = False

    @property
    def workers(self) -> int:
        return self._workers

    @property
    def room(self) -> int:
        return (self._workers if self._warm else 1) - sum(slot.ticket is not None for slot in self._slots)

    def submit(self, ticket: int, job: Job) -> None:
        slot = next((s for s in self._slots if s.ticket is None), None)
        if slot is None:
            with environment(SINGLE_THREADED):
                slot = _Slot(self._context, self._play, self._stop)
            self._slots.append(slot)
        slot.give(ticket, job)

    def collect(self, timeout_seconds: float) -> list[Outcome]:
        busy = [slot for slot in self._slots if slot.ticket is not None]
        if not busy:
            return []
        ready = set(wait([slot.connection for slot in busy], timeout_seconds))
        found = []
        for slot in busy:
            if slot.connection in ready:
                outcome = slot.take()
                if outcome.results is None and not slot.process.is_alive():
                    self._slots.remove(slot)
                self._warm |= outcome.results is not None
                found.append(outcome)
        return found

    def stop(self) -> list[Outcome]:
        self._stop.set()
        found = []
        deadline = time.monotonic() + STOP_SECONDS
        while any(slot.ticket is not None for slot in self._slots) and time.monotonic() < deadline:
            found += [outcome for outcome in self.collect(0.2) if outcome.results is not None]
        return found

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        for slot in self._slots:
            slot.connection.close()  # an idle worker ends with its connection
        deadline = time.monotonic() + (STOP_SECONDS if kind is None else 1.0)
        for slot in self._slots:
            slot.process.join(max(0.0, deadline - time.monotonic()))
            if slot.process.is_alive():
                slot.process.kill()
                slot.process.join()
        self._slots = []


class _Slot:
    """One worker process and the job that it has."""

    def __init__(self, context: Any, play: Play, stop: Event) -> None:
        self.ticket: int | None = None
        self.connection: Connection
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, play, stop), daemon=True)
        self.process.start()
        theirs.close()

    def give(self, ticket: int, job: Job) -> None:
        self.ticket = ticket
        with contextlib.suppress(OSError):  # it died since: `take` will say so
            self.connection.send(job)

    def take(self) -> Outcome:
        assert self.ticket is not None
        ticket, self.ticket = self.ticket, None
        try:
            results, lost = self.connection.recv()
        except (EOFError, OSError):
            self.process.join(5.0)
            self.process.kill()
            self.process.join()
            return Outcome(ticket, None, _manner(self.process.exitcode))
        return Outcome(ticket, results, lost)


def _manner(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        return f"killed by signal {-exitcode}" + (", as happens when memory runs out" if exitcode == -9 else "")
    return f"ended with status {exitcode}"


def _work(connection: Connection, play: Play, stop: Event) -> None:
    """A worker's life: jobs in, results out, until the connection ends."""
    begin_worker(stop)
    while True:
        try:
            job = connection.recv()
        except (EOFError, OSError):
            return
        try:
            answer: tuple[Any, str] = (play(job), "")
        except Interrupted:
            return
        except Exception as error:  # noqa: BLE001, the parent decides what an error of any kind means
            answer = (None, " ".join(f"{type(error).__name__}: {error}".split()))
        try:
            connection.send(answer)
        except OSError:
            return


@contextlib.contextmanager
def pool(workers: int) -> Iterator[tuple[ProcessPoolExecutor, Event]]:
    """Fresh single-threaded processes that end with their parent, however it ends: for work that is no episode's."""
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    with environment(SINGLE_THREADED):
        executor = ProcessPoolExecutor(workers, mp_context=context, initializer=begin_worker, initargs=(stop,))
        try:
            yield executor, stop
        finally:
            stop.set()
            executor.shutdown(wait=True, cancel_futures=True)


def begin_worker(stop: Any) -> None:
    """In a fresh worker: leave Ctrl-C to the parent, and end when the parent does."""
    global _stop
    _stop = stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    # A killed parent leaves a playing worker unaware of it until it sends; a waiting one may share the queue's ends.
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
