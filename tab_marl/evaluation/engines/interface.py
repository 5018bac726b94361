"""What the runner asks of an engine: take jobs, say what became of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

from tab_marl.evaluation.rows import EpisodeRow, Timing
from tab_marl.evaluation.units import Job

Result = tuple[EpisodeRow, Timing]
Play = Callable[[Job], list[Result]]
"""A function of a module, so that other processes find it by name."""


@dataclass(frozen=True)
class Outcome:
    """The end of one job: its results, or why there are none."""

    ticket: int
    results: list[Result] | None
    lost: str = ""
    """What happened to the worker: "killed by signal 9", "its node left the cluster". Never an episode's own error,
    which is a result."""


class Engine(Protocol):
    """Entered before its first job; leaving it ends every worker."""

    name: str

    @property
    def workers(self) -> int:
        """How many jobs it can play at a time, as far as it knows."""

    @property
    def room(self) -> int:
        """How many jobs it would take now."""

    def submit(self, ticket: int, job: Job) -> None:
        """Take a job; there must be room."""

    def collect(self, timeout_seconds: float) -> list[Outcome]:
        """Whatever ended, as soon as anything did, and nothing after the timeout."""

    def stop(self) -> list[Outcome]:
        """Ask the workers to stop at once; returns what they had finished all the same."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
