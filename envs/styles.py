"""Styles: how adversaries with the same mission differ in the way they carry it out.

A style bends the *route* that a policy follows and never its sense of time: lengths and deadlines stay in plain metres
and seconds. What is drawn per episode (the latents) is observed by the policy. A latent is applied only where the
mission leaves time for it (`SLACK_NEEDED`), in full, in half, in a quarter, or not at all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tab_marl.mission.route_kernels import MOVE_CELLS, MOVE_X, MOVE_Y
from tab_marl.world.grid import GridMap
from tab_marl.world.scenario import STRICT, Scenario, UnknownName

SLACK_NEEDED = 1.2
"""Allowed time / shortest time below which an adversary goes straight."""
STRENGTHS = (1.0, 0.5, 0.25)
"""Tried in turn until the styled route fits into the allowed time; else the route stays plain."""

# A robot's radius and a bit: routes keep this far from zones that fail the mission where they can.
ZONE_MARGIN_METRES = 0.12
ZONE_MARGIN_COST = 3.0
WALL_SIDE_COST = 1.15
NOISE_METRES = 0.5
"""Distance between the independent values of the random cost field."""
WEIGHT_SLIP = 1e-3
"""By which the weights of a mixture may miss 1 (they are written down rounded)."""


@dataclass(frozen=True)
class Style:
    """A distribution of latents. All off: the direct style."""

    name: str = "direct"
    side: float = 0.0
    """Probability that the adversary prefers one turning sense about the arena's centre (either, with equal chance)."""
    side_cost: float = 3.0
    """Moves against the preferred sense cost up to 1 + this."""
    via: float = 0.0
    """Probability that a detour over `via_points_max` or fewer points comes first."""
    via_points_max: int = 1
    camera_shy: float = 0.0
    """Cells under a camera cost 1 + this."""
    edge_noise: float = 0.0
    """Standard deviation of the logarithm of a smooth random cost field."""
    contrary_metres: float = 0.0
    """So many metres more it goes to pass an obstacle on another side than the shortest way does, on the first leg."""
    order_metres: float = 0.0
    """Each place that could be visited costs up to this many metres more, drawn per episode: soft order, soft choice."""
    arrival_fraction: tuple[float, float] | None = None
    """Range of the share of the allowed time at which to arrive; None: as soon as possible."""
    mixture: tuple[Habit, ...] = ()
    """If any, an episode's latents are those of one of these habits, drawn by their weights; the fields above are unused."""

    __pydantic_config__: ClassVar = STRICT

    def __post_init__(self) -> None:
        for name in ("side", "via"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"Style.{name} is {getattr(self, name)}, must be a probability in 0..1")
        for name in ("side_cost", "camera_shy", "edge_noise", "contrary_metres", "order_metres"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"Style.{name} is {getattr(self, name)}, must be >= 0")
        if not 0 <= self.via_points_max <= 2:
            raise ValueError(f"Style.via_points_max is {self.via_points_max}, must be 0, 1 or 2")
        if self.arrival_fraction is not None:
            low, high = self.arrival_fraction
            object.__setattr__(self, "arrival_fraction", (float(low), float(high)))
            if not 0 < low <= high < 1:
                raise ValueError(f"Style.arrival_fraction is {self.arrival_fraction}, must be 0 < low <= high < 1")
        object.__setattr__(self, "mixture", tuple(self.mixture))
        if self.mixture:
            for name in ("weight", "open_weight"):
                total = sum(getattr(habit, name) for habit in self.mixture)
                if not math.isclose(total, 1.0, abs_tol=WEIGHT_SLIP):
                    raise ValueError(f"Style.mixture: the {name}s sum to {total:.6g}, must sum to 1")
            if any(habit.style.mixture for habit in self.mixture):
                raise ValueError("Style.mixture: a habit's style has a mixture of its own, must be a plain style")

    @classmethod
    def preset(cls, name: str) -> Style:
        """A style by name. Raises UnknownName."""
        if name not in STYLES:
            raise UnknownName("style", name, STYLES)
        return STYLES[name]

    @property
    def varies(self) -> bool:
        """Whether two draws can differ."""
        return self != Style(name=self.name)

    def weights(self, open_ended: bool) -> NDArray[np.float64]:
        """``[H]`` probabilities of the mixture's habits, for missions whose last goal is any of several places or not."""
        return np.array([habit.open_weight if open_ended else habit.weight for habit in self.mixture])

    def draw(self, rng: np.random.Generator, open_ended: bool = False) -> Latents:
        """Latents of one episode. Every draw takes the same numbers from `rng`, whatever is switched on.

        `open_ended`: whether the mission's last goal is any of several places.
        """
        if self.mixture:
            chosen = np.searchsorted(np.cumsum(self.weights(open_ended)), rng.random(), side="right")
            return self.mixture[min(int(chosen), len(self.mixture) - 1)].style.draw(rng)
        side_on, sign, via_on = rng.random(), rng.random(), rng.random()
        via_share, fraction = rng.random(), rng.random()
        seed = int(rng.integers(2**31))
        low, high = self.arrival_fraction or (0.0, 0.0)
        return Latents(
            side=(1 if sign < 0.5 else -1) if side_on < self.side else 0,
            side_cost=self.side_cost,
            via_points=1 + int(via_share * self.via_points_max) if via_on < self.via and self.via_points_max else 0,
            camera_shy=self.camera_shy,
            edge_noise=self.edge_noise,
            contrary_metres=self.contrary_metres,
            order_metres=self.order_metres,
            arrival_fraction=low + fraction * (high - low),
            seed=seed,
        )


@dataclass(frozen=True)
class Habit:
    """One way of behaving, and how likely an episode begins with it."""

    style: Style
    weight: float
    """Probability in missions whose last goal is one place."""
    open_weight: float
    """Probability in missions whose last goal is any of several."""

    __pydantic_config__: ClassVar = STRICT

    def __post_init__(self) -> None:
        for name in ("weight", "open_weight"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"Habit.{name} is {getattr(self, name)}, must be a probability in 0..1")


@dataclass(frozen=True)
class Latents:
    """What was drawn for one episode."""

    side: int = 0
    """+1 anticlockwise about the arena's centre, -1 clockwise, 0 no preference."""
    side_cost: float = 0.0
    via_points: int = 0
    camera_shy: float = 0.0
    edge_noise: float = 0.0
    contrary_metres: float = 0.0
    order_metres: float = 0.0
    arrival_fraction: float = 0.0
    """Share of the allowed time at which to arrive; 0: as soon as possible."""
    seed: int = 0
    """Of the cost field, the order and the via points."""

    @property
    def bends_route(self) -> bool:
        return any(
            (self.side, self.via_points, self.camera_shy, self.edge_noise, self.contrary_metres, self.order_metres)
        )


STYLES: dict[str, Style] = {
    style.name: style
    for style in (
        Style("direct"),
        Style("side", side=1.0, order_metres=2.0),
        Style("via", via=1.0, order_metres=2.0),
        Style("camera-shy", camera_shy=6.0, order_metres=2.0),
        Style("late", arrival_fraction=(0.75, 0.9), order_metres=2.0),
        Style("wander", edge_noise=1.0, order_metres=2.0),
        Style("fickle", order_metres=6.0),
        Style("contrary", contrary_metres=1.5, order_metres=2.0),
    )
}


def mixture_of(name: str, styles: Sequence[Style]) -> Style:
    """The style that draws one of these per episode, all equally likely."""
    share = 1.0 / len(styles)
    return Style(name, mixture=tuple(Habit(style, share, share) for style in styles))


STYLES["habits"] = mixture_of(
    "habits",
    (
        *(STYLES[name] for name in ("direct", "side", "via", "camera-shy", "late", "wander", "fickle")),
        Style("fickle-via", via=1.0, order_metres=6.0),
        Style("roundabout", via=1.0, via_points_max=2),
        Style("fickle-shy", camera_shy=6.0, order_metres=6.0),
        Style("fickle-side", side=1.0, order_metres=6.0),
        Style("shy-via", camera_shy=6.0, via=1.0),
    ),
)


def clearance_cost(grid: GridMap, zone_distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """``[S]``: a little more beside walls, more close to forbidden zones; `zone_distance` ``[S]`` is to the nearest one."""
    padded = np.pad(grid.cell_at, 1, constant_values=-1)
    rows, columns = grid.row + 1, grid.column + 1
    beside_wall = np.zeros(grid.cells, dtype=bool)
    for dr in (-1, 0, 1):
        for dc in (-1, 0, 1):
            beside_wall |= padded[rows + dr, columns + dc] < 0
    cost = np.where(beside_wall, WALL_SIDE_COST, 1.0)
    return np.where(zone_distance < ZONE_MARGIN_METRES, ZONE_MARGIN_COST, cost)


def styled_cost(
    scenario: Scenario,
    grid: GridMap,
    clearance: NDArray[np.float64],
    latents: Latents,
    strength: float,
    crossed: NDArray[np.int64] | None = None,
) -> NDArray[np.float64]:
    """Costs ``[S, 16]`` of moves under these latents at this strength (0..1); `crossed` ``[S, 16]``: see `fences_crossed`."""
    cells = clearance.copy()
    if latents.camera_shy:
        cells = cells * np.where(scenario.seen(grid.centres), 1.0 + strength * latents.camera_shy, 1.0)
    if latents.edge_noise:
        cells = cells * np.exp(strength * latents.edge_noise * _smooth_noise(scenario, grid, latents.seed))
    edges = np.repeat(cells[:, None], 16, axis=1)
    if latents.side:
        arm = grid.centres - (scenario.width_metres / 2, scenario.height_metres / 2)
        arm /= np.maximum(np.hypot(arm[:, 0], arm[:, 1]), 1e-9)[:, None]
        turning = arm[:, :1] * MOVE_Y - arm[:, 1:] * MOVE_X
        edges *= 1.0 + strength * latents.side_cost * np.maximum(0.0, -latents.side * turning)
    if crossed is not None:
        edges += strength * latents.contrary_metres * crossed / (grid.cell_metres * MOVE_CELLS)
    return np.asarray(edges)


def _smooth_noise(scenario: Scenario, grid: GridMap, seed: int) -> NDArray[np.float64]:
    """``[S]`` standard normal values at knots `NOISE_METRES` apart, bilinear in between."""
    rng = np.random.default_rng(seed)
    columns = int(scenario.width_metres / NOISE_METRES) + 2
    rows = int(scenario.height_metres / NOISE_METRES) + 2
    knots = rng.standard_normal((rows, columns))
    x, y = grid.centres.T / NOISE_METRES
    c, r = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = x - c, y - r
    upper = (1 - fx) * knots[r + 1, c] + fx * knots[r + 1, c + 1]
    lower = (1 - fx) * knots[r, c] + fx * knots[r, c + 1]
    return np.asarray((1 - fy) * lower + fy * upper)
