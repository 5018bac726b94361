"""What a particle filter remembers for replays: the latest steps, and the belief that they started from."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass
class Stretch:
    """Steps in a row and the belief before the first of them, kept in one piece: neither can be cut without the other."""

    origin: Any
    """States, `Particles` or a sampler."""
    steps: list[tuple[int, Any]] = field(default_factory=list)
    """(action, observation) of each."""


class RecentHistory:
    """The last `memory` to twice `memory` steps, in at most two stretches; what lies before is kept as a belief."""

    def __init__(self, origin: Any, memory: int) -> None:
        self._memory = memory
        self.restart(origin)

    def __len__(self) -> int:
        """Steps that a replay would take."""
        return sum(len(stretch.steps) for stretch in self._stretches)

    def __iter__(self) -> Iterator[Stretch]:
        return iter(self._stretches)

    @property
    def origin(self) -> Any:
        """Where a replay starts: the belief before the oldest step that is remembered."""
        return self._stretches[0].origin

    def restart(self, origin: Any) -> None:
        """Forgets every step: from here on `origin` is where a replay starts."""
        self._stretches = [Stretch(origin)]

    def append(self, action: int, observation: Any) -> None:
        self._stretches[-1].steps.append((action, observation))

    def keep(self, belief: Any) -> None:
        """Takes the belief after the latest step: where a stretch is full, the next starts from it and the oldest is dropped."""
        if len(self._stretches[-1].steps) >= self._memory:
            self._stretches = [*self._stretches[-1:], Stretch(belief)]

    def mend(self, beliefs: Sequence[Any]) -> None:
        """Takes what a replay believed before each stretch, in place of beliefs kept on the way to a contradiction.

        They may have been wrong already, and the next replay would start from them. The first stretch keeps its origin, which is
        what the replay was drawn from.
        """
        for stretch, belief in zip(self._stretches[1:], beliefs[1:], strict=True):
            stretch.origin = belief
