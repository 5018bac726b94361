"""A belief or field laid over the map: from whatever a caller has to an image ``[rows, columns]``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.world.grid import GridMap
from tab_marl.world.scenario import Scenario

Heat = ArrayLike | tuple[GridMap, ArrayLike]
HeatSource = Callable[[], NDArray[np.float64] | None]

_CELL_METRES = (0.1, 0.05)
"""Cell sizes tried for bare values ``[cells]``."""


def heat_image(heat: Any, scenario: Scenario) -> NDArray[np.float64]:
    """``[rows, columns]``, row 0 at the bottom, from an image, a pair (grid, values ``[cells]``), or values ``[cells]``.

    Bare values must be on the scenario's grid of 0.1 or 0.05 m. Raises ValueError for anything else.
    """
    if isinstance(heat, tuple) and len(heat) == 2 and isinstance(heat[0], GridMap):
        grid, values = heat[0], np.asarray(heat[1], dtype=np.float64)
        if values.shape != (grid.cells,):
            raise ValueError(f"the field has shape {values.shape}, must be [cells] = ({grid.cells},) of its grid")
        return grid.image(values, blocked=0.0)
    values = np.asarray(heat, dtype=np.float64)
    if values.ndim == 2:
        return values
    grids = [GridMap.from_scenario(scenario, metres) for metres in _CELL_METRES]
    for grid in grids:
        if values.shape == (grid.cells,):
            return grid.image(values, blocked=0.0)
    raise ValueError(
        f"a field of shape {values.shape} fits neither an image [rows, columns] nor the scenario's grids of "
        f"{[f'{g.cells} cells of {g.cell_metres} m' for g in grids]}: pass (grid, values)"
    )


def heat_source(heat: Any, scenario: Scenario) -> HeatSource:
    """A function that gives the image to draw now; a callable `heat` is asked at every frame and may return None."""
    if heat is None:
        return lambda: None
    if callable(heat):

        def ask() -> NDArray[np.float64] | None:
            found = heat()
            return None if found is None else heat_image(found, scenario)

        return ask
    image = heat_image(heat, scenario)
    return lambda: image
