"""Sampled tasks keep what their family promises."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tab_marl.mission.tasks import FAMILIES, FAR_METRES, MISSION_IDS, SLACK_RANGE, ego_can_be_first, sample_task
from tab_marl.world.grid import GridMap, free_points
from tab_marl.world.scenario import UnknownName

CASES = [(m, f) for m in MISSION_IDS for f in FAMILIES]


@pytest.mark.parametrize(("mission_id", "family"), CASES)
def test_same_seed_same_task_and_other_seed_another(mission_id: str, family: str) -> None:
    task = sample_task(np.random.default_rng(3), mission_id, family)
    assert task == sample_task(np.random.default_rng(3), mission_id, family)
    assert task != sample_task(np.random.default_rng(4), mission_id, family)
    assert (task.mission_id, task.family, task.mission.name) == (mission_id, family, mission_id)
    assert SLACK_RANGE[0] <= task.slack <= SLACK_RANGE[1]


@pytest.mark.parametrize(("mission_id", "family"), CASES)
def test_starts_are_free_apart_and_far_from_the_first_goal(mission_id: str, family: str) -> None:
    for seed in range(6):
        task = sample_task(np.random.default_rng(seed), mission_id, family)
        scenario = task.scenario
        ego, adversary = np.array(scenario.ego_start.centre), np.array(scenario.adversary_start.centre)
        assert free_points(scenario, [ego], scenario.ego.radius_metres)[0]
        assert free_points(scenario, [adversary], scenario.adversary.radius_metres)[0]
        assert math.hypot(*(ego - adversary)) >= FAR_METRES - 1e-9
        for place in task.mission.goals[0].places:
            assert scenario.place(place).distance([adversary])[0] >= FAR_METRES - 1e-9


@pytest.mark.parametrize(("mission_id", "family"), CASES)
def test_families_differ_in_what_they_promise(mission_id: str, family: str) -> None:
    task = sample_task(np.random.default_rng(1), mission_id, family)
    last = task.mission.goals[-1]
    x_min, _, x_max, _ = task.scenario.place(last.places[0]).bounds()
    radius = (x_max - x_min) / 2
    assert (radius > task.scenario.interception_metres) == (family == "perimeter")
    assert (len(last.places) > 1) == (family == "ambiguous")


def test_allowed_time_is_slack_times_the_way_to_the_farthest_goal() -> None:
    for seed in range(10):
        task = sample_task(np.random.default_rng(seed), "M1", "ambiguous", slack=1.5)
        scenario, goal = task.scenario, task.mission.goals[0]
        fine = GridMap.from_scenario(scenario, 0.05)
        start = fine.cells_of([scenario.adversary_start.centre])[0]
        farthest = max(
            fine.distances(np.flatnonzero(fine.inside(scenario.place(p))))[start] for p in goal.places
        )  # on other cells than the sampler's
        expected = 1.5 * (farthest / scenario.adversary.max_speed + 1.0)
        assert goal.seconds is not None
        assert goal.seconds == pytest.approx(expected, abs=0.5 + 1.5 * 0.15 / scenario.adversary.max_speed)


def test_an_ego_that_can_be_first_is_nearer_to_the_goal_than_the_adversary() -> None:
    firsts = 0
    for seed in range(30):
        task = sample_task(np.random.default_rng(seed), "M1", "point")
        scenario = task.scenario
        goal = np.array(scenario.place(task.mission.goals[0].places[0]).centre)
        ego = math.hypot(*(goal - scenario.ego_start.centre))
        adversary = math.hypot(*(goal - scenario.adversary_start.centre))
        if ego_can_be_first(task):
            firsts += 1
            assert ego < adversary
    assert 5 <= firsts <= 29
    assert not ego_can_be_first(sample_task(np.random.default_rng(0), "M1", "ambiguous"))
    assert not ego_can_be_first(sample_task(np.random.default_rng(0), "M1", "perimeter"))


def test_wrong_words_are_answered_with_the_nearest_right_one() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(UnknownName, match="did you mean 'ambiguous'"):
        sample_task(rng, "M1", "ambigous")
    with pytest.raises(UnknownName, match="mission type"):
        sample_task(rng, "M9")
    with pytest.raises(ValueError, match="must be > 1"):
        sample_task(rng, slack=0.9)
