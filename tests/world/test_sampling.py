from __future__ import annotations

import numpy as np
import pytest

from tab_marl.world.grid import GridMap, free_points
from tab_marl.world.sampling import MapOptions, sample_scenario


def test_maps_are_connected_spaced_and_reproducible() -> None:
    for seed in range(20):
        scenario = sample_scenario(np.random.default_rng(seed))
        assert scenario == sample_scenario(np.random.default_rng(seed))
        places = np.array([(c.x, c.y) for c in scenario.checkpoints])
        gaps = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
        assert gaps[~np.eye(5, dtype=bool)].min() >= 0.8 - 0.02  # coordinates are rounded to centimetres
        assert free_points(scenario, places, scenario.adversary.radius_metres).all()
        assert scenario.region("central zone").distance(places).min() >= 0.18
        grid = GridMap.from_scenario(scenario, 0.1)
        assert np.isfinite(grid.distances(0)).all()


def test_impossible_options_say_what_to_change() -> None:
    with pytest.raises(RuntimeError, match="lower checkpoint_spacing"):
        sample_scenario(np.random.default_rng(0), MapOptions(checkpoints=26))
    with pytest.raises(ValueError, match="obstacles_min"):
        MapOptions(obstacles_min=5, obstacles_max=1)
