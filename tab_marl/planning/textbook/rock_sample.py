"""RockSample (Smith and Simmons, UAI 2004): a rover among rocks that are good or bad, with a sensor that weakens with distance.

The rules and layouts are those of the DESPOT package (AdaCompNUS/despot, ``base_rock_sample.cpp``) and of the POMDP files that
SARSOP's figures are for: sampling earns +10 from a good rock, which turns it bad, and -10 from a bad one; leaving by the eastern
border earns +10 and ends; walking into another border or sampling where no rock is costs 100; a check of a rock at distance d
(Euclidean) is right with probability (1 + 2^(-d/20)) / 2. The rover's cell is known, each rock is good with probability 1/2.

Figures at discount .95 are in Ye et al. (JAIR 58, 2017) and, with preferred actions, in Silver and Veness (NeurIPS 2010); their
[15,15] has other rocks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.model import CompiledModel, StateRange
from tab_marl.planning.textbook import rock_sample_kernels as kernels
from tab_marl.planning.textbook.chase_maps import Place
from tab_marl.planning.textbook.choices import chosen

SAMPLE, CHECK = kernels.SAMPLE, kernels.CHECK
"""The number of "sample", and of "check rock 0"; rock k is CHECK + k."""
BAD, GOOD, NOTHING = kernels.BAD, kernels.GOOD, kernels.NOTHING
"""Observations."""

_LAYOUTS: dict[tuple[int, int], list[Place]] = {
    (4, 4): [(3, 1), (2, 1), (1, 3), (1, 0)],
    (5, 5): [(2, 4), (0, 4), (3, 3), (2, 2), (4, 1)],
    (5, 7): [(1, 0), (2, 1), (1, 2), (2, 2), (4, 2), (0, 3), (3, 4)],
    (7, 8): [(2, 0), (0, 1), (3, 1), (6, 3), (2, 4), (3, 4), (5, 5), (1, 6)],
    (11, 11): [(0, 3), (0, 7), (1, 8), (2, 4), (3, 3), (3, 8), (4, 3), (5, 8), (6, 1), (9, 3), (9, 9)],
}
"""(size, rocks): the rocks' places as (x, y), y upwards."""


class RockSampleData(NamedTuple):
    """What the functions of RockSample read."""

    moves: NDArray[np.int16]
    """``[cells * 4]``: the cell after (cell, direction), -1 off the grid. Cells are ``y * size + x``."""
    rock_at: NDArray[np.int16]
    """``[cells]``: the rock there, or -1."""
    rock_cell: NDArray[np.int64]
    """``[rocks]``."""
    distance: NDArray[np.int64]
    """``[cells * rocks]`` in moves."""
    accuracy: NDArray[np.float64]
    """``[cells * rocks]``: probability that a check from the cell is right."""
    evidence: NDArray[np.float64]
    """``[cells * rocks]``: log odds that one reading adds or takes."""
    size: int
    rocks: int
    start: int
    """The rover's first cell."""
    sure: float
    """Log odds beyond which a prior checks a rock no more."""
    hope: float
    """Log odds below which `survey_rollout` gives a rock up."""
    trust: float
    """Log odds from which it goes without another check."""
    discount: float
    """With which the prior `preferred` reckons."""
    pseudo_count: int
    """How often it pretends to have tried each action."""


def rock_sample_data(
    size: int = 7, rocks: int = 8, places: list[Place] | None = None, half_distance: float = 20.0, seed: int = 0
) -> RockSampleData:
    """The tables of RockSample[size, rocks]: the published layout, the one given, or (for other sizes) one drawn by `seed`.

    The rover starts at the middle of the western border. Raises ValueError naming what is out of bounds.
    """
    if not 2 <= size <= 100 or not 1 <= rocks <= 50:
        raise ValueError(f"size is {size} and rocks is {rocks}, must be in 2..100 and 1..50")
    if not half_distance > 0:
        raise ValueError(f"half_distance is {half_distance}, must be > 0")
    if places is None:
        places = _LAYOUTS.get((size, rocks))
    if places is None:
        if rocks > size * size:
            raise ValueError(f"{rocks} rocks do not fit on {size} x {size} cells")
        drawn = np.random.default_rng(seed).choice(size * size, size=rocks, replace=False)
        places = [(int(c) % size, int(c) // size) for c in drawn]
    inside = all(0 <= x < size and 0 <= y < size for x, y in places)
    if len(places) != rocks or len(set(places)) != rocks or not inside:
        raise ValueError(f"places holds {places}: must be {rocks} different (x, y) in 0..{size - 1}")
    x, y = np.arange(size * size) % size, np.arange(size * size) // size
    moves = np.full((size * size, 4), -1, dtype=np.int16)
    for direction, (dx, dy) in enumerate([(0, 1), (1, 0), (0, -1), (-1, 0)]):
        ok = (x + dx >= 0) & (x + dx < size) & (y + dy >= 0) & (y + dy < size)
        moves[ok, direction] = ((y + dy) * size + x + dx)[ok]
    rock_x, rock_y = np.array(places).T
    rock_cell = rock_y * size + rock_x
    rock_at = np.full(size * size, -1, dtype=np.int16)
    rock_at[rock_cell] = np.arange(rocks)
    accuracy = 0.5 * (1 + 2.0 ** (-np.hypot(x[:, None] - rock_x, y[:, None] - rock_y) / half_distance))
    with np.errstate(divide="ignore"):
        evidence = np.minimum(np.log(accuracy / (1 - accuracy)), 50.0)  # on the rock itself a check is certain
    return RockSampleData(
        moves.ravel(),
        rock_at,
        rock_cell.astype(np.int64),
        (abs(x[:, None] - rock_x) + abs(y[:, None] - rock_y)).astype(np.int64).ravel(),
        accuracy.ravel(),
        evidence.ravel(),
        size,
        rocks,
        size // 2 * size,
        6.0,
        -0.1,
        1.5,
        0.95,
        100,
    )


def rock_sample(
    size: int = 7,
    rocks: int = 8,
    rollout: Literal["survey", "harvest", "legal", "engine"] = "survey",
    prior: Literal["preferred", "sensible", "none"] = "preferred",
    data: RockSampleData | None = None,
) -> CompiledModel:
    """RockSample[size, rocks] as a compiled model of ``5 + rocks`` actions.

    `rollout`: "survey" goes to the nearest rock that may be good, checking it until sure, then to the next, and leaves; "harvest"
    collects only what is more likely good than not, without a check; "legal" is uniform among actions that make sense; "engine"
    is uniform among all, with -100 at every border. `prior`: "sensible" forbids what cannot pay (walking into a border, sampling
    bare ground, checking a rock known beyond doubt); "preferred" also starts every action with a guess of its value, by which
    the survey policy is left only for what shows itself to be better (preferred actions: Silver and Veness, section 5).
    """
    data = rock_sample_data(size, rocks) if data is None else data
    rollouts = {
        "survey": kernels.survey_rollout,
        "harvest": kernels.harvest_rollout,
        "legal": kernels.legal_rollout,
        "engine": None,
    }
    priors: dict[str, Callable[..., None] | None] = {
        "preferred": kernels.preferred,
        "sensible": kernels.sensible,
        "none": None,
    }
    return CompiledModel(
        kernels.step,
        5 + data.rocks,
        2 + data.rocks,
        data,
        rollout=chosen("rollout of RockSample", rollout, rollouts),
        prior=chosen("prior of RockSample", prior, priors),
        action_names=("north", "east", "south", "west", "sample", *(f"check {k}" for k in range(data.rocks))),
        upper=kernels.upper,
        states=StateRange(
            [0, 0] + [-np.inf] * data.rocks,
            [data.size**2 - 1, 2**data.rocks - 1] + [np.inf] * data.rocks,
            [True, True] + [False] * data.rocks,
        ),
    )


class RockBelief:
    """The exact belief of RockSample: the rover's cell is known, and rocks are good independently of each other."""

    def __init__(
        self, data: RockSampleData, cell: int | None = None, log_odds: NDArray[np.float64] | None = None
    ) -> None:
        self.data = data
        self.cell = data.start if cell is None else cell
        self.log_odds = np.zeros(data.rocks) if log_odds is None else log_odds
        """``[rocks]`` that a rock is good; ``COLLECTED`` once sampled."""

    @property
    def good(self) -> NDArray[np.float64]:
        """``[rocks]``: the probability that each is good."""
        return 1 / (1 + np.exp(-np.clip(self.log_odds, -700, 700)))

    def sample(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """``[count, 2 + rocks]`` states."""
        bits = rng.random((count, self.data.rocks)) < self.good
        mask = bits @ (2.0 ** np.arange(self.data.rocks))
        return np.column_stack([np.full(count, self.cell), mask, np.tile(self.log_odds, (count, 1))])

    def updated(self, action: int, observation: int) -> RockBelief:
        """Bayes' rule after a step that did not end it; ValueError when the observation was impossible."""
        log_odds = self.log_odds.copy()
        if (observation == NOTHING) == (action >= CHECK) or observation not in (BAD, GOOD, NOTHING):
            raise ValueError(f"observation {observation} after action {action} is impossible")
        if action < SAMPLE:
            after = int(self.data.moves[self.cell * 4 + action])
            return RockBelief(self.data, self.cell if after < 0 else after, log_odds)
        if action == SAMPLE:
            rock = int(self.data.rock_at[self.cell])
            if rock >= 0:
                log_odds[rock] = kernels.COLLECTED
            return RockBelief(self.data, self.cell, log_odds)
        rock = action - CHECK
        if log_odds[rock] != kernels.COLLECTED:
            evidence = self.data.evidence[self.cell * self.data.rocks + rock]
            log_odds[rock] += evidence if observation == GOOD else -evidence
        return RockBelief(self.data, self.cell, log_odds)
