"""Jobs on a Ray cluster: one player per processor of every node whose code is ours; nodes may come and go.

Ray retries nothing here: the runner does, and counts, in the same way as for processes of this machine.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

from tab_marl.evaluation.engines.cluster_worker import Parcel, Player
from tab_marl.evaluation.engines.interface import Outcome, Play
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.provenance import differences
from tab_marl.evaluation.units import Job

LOOK_SECONDS = 2.0
"""How often the nodes are counted."""
PATIENCE_SECONDS = 300.0
"""How long the cluster may give no processor at all."""


@dataclass
class _Slot:
    """One player and what it was asked last."""

    actor: Any
    node: str
    pending: Any = None
    """The answer it owes: its identity first, then results."""
    ticket: int | None = None
    checked: bool = False
    """Its code is ours."""


class RayEngine:
    """Plays on a Ray cluster; without an address, on a Ray instance of its own on this machine."""

    name = "ray"

    def __init__(
        self,
        play: Play,
        identity: Mapping[str, str],
        address: str | None = None,
        workers: int | None = None,
        parcel: Parcel | None = None,
        on_note: Callable[[str], None] = lambda text: None,
    ) -> None:
        """`identity`: what every node must be (`provenance.identity`); `parcel`: policies outside the package.

        Raises UserError if Ray is not installed.
        """
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent anywhere
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        try:
            import ray
        except ImportError:
            raise UserError("--engine ray needs Ray: pip install 'tab-marl[ray]'") from None
        self._ray: Any = ray
        self._play, self._identity, self._address, self._limit = play, dict(identity), address, workers
        self._parcel, self._note = parcel or {}, on_note
        self._slots: list[_Slot] = []
        self._refused: dict[str, str] = {}
        self._warm: set[str] = set()
        self._next_look = 0.0
        self._last_useful = time.monotonic()
        self._ours = False

    @property
    def workers(self) -> int:
        if not self._ray.is_initialized():
            return self._limit or 0
        processors = sum(int(node["Resources"].get("CPU", 0)) for node in self._nodes())
        return processors if self._limit is None else min(processors, self._limit)

    @property
    def room(self) -> int:
        return sum(slot.checked and slot.ticket is None for slot in self._slots)

    def submit(self, ticket: int, job: Job) -> None:
        slot = next(s for s in self._slots if s.checked and s.ticket is None)
        slot.ticket, slot.pending = ticket, slot.actor.play.remote(self._play, job)

    def collect(self, timeout_seconds: float) -> list[Outcome]:
        self._look()
        waiting = {slot.pending: slot for slot in self._slots if slot.pending is not None}
        if not waiting:
            self._check_patience()
            time.sleep(min(timeout_seconds, 0.2))
            return []
        done, rest = self._ray.wait(list(waiting), num_returns=1, timeout=timeout_seconds)
        if done and rest:
            done += self._ray.wait(rest, num_returns=len(rest), timeout=0)[0]
        found = [outcome for ref in done if (outcome := self._answer(waiting[ref])) is not None]
        self._check_patience()
        return found

    def stop(self) -> list[Outcome]:
        """What is finished this moment; an episode on another machine cannot be asked to stop, only ended."""
        return [outcome for outcome in self.collect(0.0) if outcome.results is not None]

    def __enter__(self) -> Self:
        handlers = _handlers()
        try:
            if not self._ray.is_initialized():
                quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
                if self._address is None:
                    processors = self._limit or os.cpu_count()
                    self._ray.init("local", num_cpus=processors, include_dashboard=False, **quiet)
                else:
                    self._ray.init(self._address, **({} if self._address.startswith("ray://") else quiet))
                self._ours = True
        except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
            said = str(error).strip().splitlines()
            raise UserError(
                f"no Ray cluster answers at {self._address!r} ({said[0] if said else type(error).__name__}); start one "
                "with ray start --head, or leave out --address for one of its own on this machine"
            ) from error
        finally:
            for number, handler in handlers.items():  # Ray takes SIGTERM over; a polite kill should end as Ctrl-C does
                signal.signal(number, handler)
        self._last_useful = time.monotonic()
        self._put = self._ray.put(self._parcel)
        self._look()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        ray = self._ray
        with contextlib.suppress(Exception):
            if self._parcel:
                idle = [slot.actor.clean.remote() for slot in self._slots if slot.ticket is None]
                ray.wait(idle, num_returns=len(idle), timeout=2.0)
        for slot in self._slots:
            with contextlib.suppress(Exception):
                ray.kill(slot.actor)
        self._slots = []
        if self._ours:
            ray.shutdown()

    def _nodes(self) -> list[dict[str, Any]]:
        return [node for node in self._ray.nodes() if node["Alive"]]

    def _look(self) -> None:
        """Players for the processors of every node that is there and not refused; one at first, which compiles."""
        if time.monotonic() < self._next_look:
            return
        self._next_look = time.monotonic() + LOOK_SECONDS
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        remote = self._ray.remote(num_cpus=1, max_restarts=0, max_task_retries=0)(Player)
        nodes = self._nodes()
        self._check_refused(nodes)
        for node in nodes:
            name = node["NodeID"]
            if name in self._refused:
                continue
            processors = int(node["Resources"].get("CPU", 0))
            wanted = processors if name in self._warm else min(1, processors)
            for _ in range(wanted - sum(slot.node == name for slot in self._slots)):
                if self._limit is not None and len(self._slots) >= self._limit:
                    return
                here = NodeAffinitySchedulingStrategy(node_id=name, soft=False)
                actor = remote.options(scheduling_strategy=here).remote(self._put)
                self._slots.append(_Slot(actor, name, actor.identity.remote()))

    def _answer(self, slot: _Slot) -> Outcome | None:
        """What the player said; None if it only said who it is, or died before it had a job."""
        ref, ticket = slot.pending, slot.ticket
        slot.pending = slot.ticket = None
        try:
            answer = self._ray.get(ref)
        except self._ray.exceptions.RayTaskError as error:
            if ticket is None:
                self._refuse(slot, _last_line(error))
                return None
            return Outcome(ticket, None, _last_line(error))
        except self._ray.exceptions.RayError as error:
            self._drop(slot)
            if ticket is not None:
                return Outcome(ticket, None, f"on node {self._address_of(slot.node)}: {type(error).__name__}")
            if "No module named" in str(error):
                self._refuse(slot, "it has no tab_marl installed")
            return None
        self._last_useful = time.monotonic()
        if ticket is not None:
            self._warm.add(slot.node)
            return Outcome(ticket, answer)
        if found := differences(self._identity, answer):
            self._refuse(slot, found)
        else:
            slot.checked = True
        return None

    def _refuse(self, slot: _Slot, why: str) -> None:
        """Nothing is played on this node: its rows could differ from ours."""
        self._drop(slot)
        if slot.node in self._refused:
            return
        text = f"node {self._address_of(slot.node)} is refused: {why}; install the same version of tab-marl there"
        self._refused[slot.node] = text
        self._note(text)
        self._check_refused(self._nodes())

    def _check_refused(self, nodes: list[dict[str, Any]]) -> None:
        """Raises UserError if every node that is there was refused; asked again as nodes leave."""
        able = [node["NodeID"] for node in nodes if node["Resources"].get("CPU", 0) >= 1]
        if able and all(name in self._refused for name in able):
            raise UserError(f"no node of the cluster can play these episodes: {self._refused[able[-1]]}")

    def _drop(self, slot: _Slot) -> None:
        self._slots.remove(slot)
        with contextlib.suppress(Exception):
            self._ray.kill(slot.actor)

    def _address_of(self, node: str) -> str:
        return next((n["NodeManagerAddress"] for n in self._ray.nodes() if n["NodeID"] == node), "?") + f" ({node[:8]})"

    def _check_patience(self) -> None:
        if any(slot.checked for slot in self._slots):
            self._last_useful = time.monotonic()
        elif time.monotonic() - self._last_useful > PATIENCE_SECONDS:
            raise UserError(
                f"the cluster gave no free processor for {PATIENCE_SECONDS:.0f} s (nodes there: {len(self._nodes())}); "
                "finished episodes are stored and the same command continues"
            )


def _handlers() -> dict[int, Any]:
    if threading.current_thread() is not threading.main_thread():
        return {}
    return {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}


def _last_line(error: BaseException) -> str:
    """What was raised in the player; Ray's text has its traceback first."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    return " ".join(lines[-1].split()) if lines else type(error).__name__
