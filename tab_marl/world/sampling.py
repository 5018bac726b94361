"""Random maps: checkpoints in a ring around the central zone, boxes in between, everything reachable."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tab_marl.world.grid import GridMap
from tab_marl.world.regions import Box, Disc, Region
from tab_marl.world.scenario import STRICT, Checkpoint, Scenario, require_positive

ATTEMPTS = 400
"""Draws before a placement is given up and the map is begun anew."""

PLANNING_CELL_METRES = 0.1
"""Cells on which maps are checked for connectedness."""


@dataclass(frozen=True)
class MapOptions:
    """How random maps are drawn. Lengths in metres."""

    width_metres: float = 3.0
    height_metres: float = 3.0
    checkpoints: int = 5
    obstacles_min: int = 2
    obstacles_max: int = 4
    obstacle_side_min: float = 0.2
    obstacle_side_max: float = 0.45
    checkpoint_spacing: float = 0.8
    """Between the centres of two checkpoints, at least."""
    wall_margin: float = 0.4
    """Between a checkpoint's centre and a wall, at least."""
    obstacle_margin: float = 0.15
    """Free border around checkpoint discs, beyond the robot's radius."""

    __pydantic_config__: ClassVar = STRICT

    def __post_init__(self) -> None:
        for name in ("width_metres", "height_metres", "obstacle_side_min", "checkpoint_spacing", "wall_margin"):
            require_positive(self, name)
        if not 1 <= self.checkpoints <= 26:
            raise ValueError(f"MapOptions.checkpoints is {self.checkpoints}, must lie in 1..26")
        if not 0 <= self.obstacles_min <= self.obstacles_max:
            raise ValueError(
                f"MapOptions: obstacles_min ({self.obstacles_min}) must lie in 0..obstacles_max ({self.obstacles_max})"
            )
        if self.obstacle_side_max < self.obstacle_side_min:
            raise ValueError("MapOptions.obstacle_side_max must be at least obstacle_side_min")


def sample_scenario(
    rng: np.random.Generator, options: MapOptions | None = None, name: str = "sampled", radius_metres: float = 0.18
) -> Scenario:
    """A random connected map. Both robots start anywhere free; `tasks.sample_task` narrows that to fit a mission.

    Raises RuntimeError when the options leave no room (too many checkpoints for the spacing and the arena).
    """
    options = options or MapOptions()
    for _ in range(ATTEMPTS):
        places = _spread(rng, options)
        if places is None:
            continue
        checkpoints = tuple(
            Checkpoint(f"Checkpoint {chr(ord('A') + i)}", round(float(x), 2), round(float(y), 2), radius_metres)
            for i, (x, y) in enumerate(places)
        )
        scenario = Scenario(
            name=name,
            width_metres=options.width_metres,
            height_metres=options.height_metres,
            checkpoints=checkpoints,
            obstacles=_boxes(rng, options, checkpoints),
            ego_start=Box(0, 0, options.width_metres, options.height_metres),
            adversary_start=Box(0, 0, options.width_metres, options.height_metres),
        )
        if _connected(scenario):
            return scenario
    raise RuntimeError(
        f"no map found in {ATTEMPTS} draws: {options.checkpoints} checkpoints {options.checkpoint_spacing} m apart do "
        f"not fit a {options.width_metres} x {options.height_metres} m arena; lower checkpoint_spacing or wall_margin"
    )


def _spread(rng: np.random.Generator, options: MapOptions) -> NDArray[np.float64] | None:
    """Checkpoints spaced apart, off the walls and clear of the central zone."""
    centre = np.array([options.width_metres / 2, options.height_metres / 2])
    clear_of_centre = Scenario.central_zone_metres + 0.18 + options.obstacle_margin
    low = np.full(2, options.wall_margin)
    high = np.array([options.width_metres, options.height_metres]) - options.wall_margin
    placed: list[NDArray[np.float64]] = []
    for _ in range(ATTEMPTS):
        point = rng.uniform(low, high)
        far = all(np.hypot(*(point - other)) >= options.checkpoint_spacing for other in placed)
        if far and np.hypot(*(point - centre)) >= clear_of_centre:
            placed.append(point)
        if len(placed) == options.checkpoints:
            return np.array(placed)
    return None


def _boxes(rng: np.random.Generator, options: MapOptions, checkpoints: tuple[Checkpoint, ...]) -> tuple[Region, ...]:
    """Boxes that leave every checkpoint's disc and a robot's width around it free."""
    count = int(rng.integers(options.obstacles_min, options.obstacles_max + 1))
    boxes: list[Region] = []
    for _ in range(ATTEMPTS):
        if len(boxes) == count:
            break
        side = rng.uniform(options.obstacle_side_min, options.obstacle_side_max, size=2)
        corner = rng.uniform((0.2, 0.2), (options.width_metres - 0.2 - side[0], options.height_metres - 0.2 - side[1]))
        x, y, w, h = (round(float(value), 2) for value in (*corner, *side))
        box = Box(x, y, x + w, y + h)
        keep = [c.radius_metres + options.obstacle_margin + 0.105 for c in checkpoints]
        gaps = box.distance([(c.x, c.y) for c in checkpoints])
        if np.all(gaps >= keep):
            boxes.append(box)
    return tuple(boxes)


def _connected(scenario: Scenario) -> bool:
    grid = GridMap.from_scenario(scenario, PLANNING_CELL_METRES)
    return bool(np.isfinite(grid.distances(0)).all())


def sample_disc(
    rng: np.random.Generator, grid: GridMap, radius_metres: float, allowed: Callable[[NDArray[np.float64]], object]
) -> Disc | None:
    """A small start disc around a free cell for which `allowed(centres [S, 2])` is true; None if there is none."""
    candidates = np.flatnonzero(np.asarray(allowed(grid.centres), dtype=bool))
    if len(candidates) == 0:
        return None
    x, y = grid.centres[rng.choice(candidates)]
    return Disc(round(float(x), 3), round(float(y), 3), radius_metres)
