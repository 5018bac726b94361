"""A mixture of adversary models against Bayes' rule done by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tab_marl.planning.models.interface import SampledPaths, TickObservation
from tab_marl.planning.models.mixture import Mixture
from tab_marl.world.grid import GridMap
from tab_marl.world.scenario import Scenario

FAR = (50.0, 50.0)
OPEN = Scenario.preset("open")


class Certain:
    """Believes that the adversary is at one point, and foresees every observation with the same probability."""

    def __init__(self, place: float, foresees: float, cell_metres: float = 0.1, fallbacks: int = 0) -> None:
        self.place, self.foresees, self.fallbacks = place, foresees, fallbacks
        self.grid = GridMap.from_scenario(OPEN, cell_metres)
        self.log_evidence = 0.0

    def start(self, observation, rng) -> None:
        self.log_evidence = np.log(self.foresees)

    def observe(self, observation, rng) -> None:
        self.log_evidence += np.log(self.foresees)

    def sample(self, count, ticks, rng) -> SampledPaths:
        return SampledPaths(np.full((count, ticks + 1, 2), self.place), np.full(count, -1, dtype=np.int32))

    def occupancy(self):
        occupancy = np.zeros(self.grid.cells)
        occupancy[self.grid.cells_of([(self.place, self.place)])] = 1.0
        return self.grid, occupancy


def watched(models, priors, ticks):
    mixture = Mixture(models, priors)
    rng = np.random.default_rng(0)
    mixture.start(TickObservation(0, FAR), rng)
    for tick in range(1, ticks):
        mixture.observe(TickObservation(tick, FAR), rng)
    return mixture


def test_weights_are_bayes_rule_and_paths_are_drawn_by_them():
    mixture = watched([Certain(0.5, 0.9), Certain(2.5, 0.6)], [0.25, 0.75], 4)
    joint = np.array([0.25 * 0.9**4, 0.75 * 0.6**4])
    np.testing.assert_allclose(mixture.weights, joint / joint.sum())
    assert mixture.log_evidence == pytest.approx(np.log(joint.sum()))
    paths = mixture.sample(20_000, 3, np.random.default_rng(1))
    assert paths.positions.shape == (20_000, 4, 2) and paths.completed_tick.shape == (20_000,)
    first = (paths.positions[:, 0, 0] == 0.5).mean()
    assert first == pytest.approx(mixture.weights[0], abs=5 * np.sqrt(0.25 / 20_000))


def test_a_contradicted_model_leaves_the_field_to_the_other_and_comes_back_with_a_sighting():
    models = [Certain(0.5, 1.0, fallbacks=0), Certain(2.5, 1e-300, fallbacks=3)]
    mixture = watched(models, [0.5, 0.5], 3)
    assert mixture.weights[1] == 0.0 and mixture.fallbacks == 0
    assert (mixture.sample(100, 1, np.random.default_rng(0)).positions == 0.5).all()
    for model in models:
        model.log_evidence = 0.0  # as models do at a sighting
    np.testing.assert_array_equal(mixture.weights, [0.5, 0.5])


def test_occupancies_on_different_grids_add_up_on_the_first():
    mixture = watched([Certain(0.55, 0.5), Certain(2.5, 0.5, cell_metres=0.3)], [0.4, 0.6], 2)
    grid, occupancy = mixture.occupancy()
    assert grid.cell_metres == 0.1 and occupancy.shape == (grid.cells,)
    assert occupancy[grid.cells_of([(0.55, 0.55)])] == pytest.approx(0.4)
    spread = occupancy[grid.centres.min(axis=1) > 2.0]
    assert spread.sum() == pytest.approx(0.6) and (spread > 0).sum() == 9  # a cell of 30 cm holds nine of 10 cm


@pytest.mark.parametrize("priors", [[1.0], [0.5, 0.6], [1.0, 0.0]])
def test_priors_are_one_per_model_and_sum_to_one(priors):
    with pytest.raises(ValueError, match=r"priors are .*: must be one per model \(2\)"):
        Mixture([Certain(0.5, 0.9), Certain(2.5, 0.9)], priors)
