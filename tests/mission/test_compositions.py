"""Sampled compositions: missions that can be done, fair starts, and none of them one of M1 to M5."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tab_marl.mission import parse_mission, to_english
from tab_marl.mission.compositions import COMPOSITIONS, SAMPLED, sample_composition
from tab_marl.mission.feasibility import check_feasible
from tab_marl.mission.model import Constraint, ConstraintType
from tab_marl.mission.tasks import FAMILIES, FAR_METRES, MISSION_IDS, SLACK_RANGE, Task, sample_task
from tab_marl.world.grid import free_points
from tab_marl.world.scenario import UnknownName


@pytest.fixture(scope="module")
def tasks() -> list[Task]:
    return [sample_composition(np.random.default_rng((3, i)), COMPOSITIONS[i % len(COMPOSITIONS)]) for i in range(32)]


def kind_of(constraint: Constraint) -> tuple[object, ...]:
    """What a constraint asks for, whatever its places and numbers."""
    return (
        "central zone" in constraint.places, len(constraint.places), constraint.type, constraint.since, constraint.different, constraint.recurrences, constraint.avoid,
        constraint.max_gap_seconds is None, constraint.speed_limit is None, constraint.until_goal,
    )  # fmt: skip


def form_of(task: Task) -> tuple[tuple[object, ...], ...]:
    return tuple(kind_of(constraint) for constraint in task.mission.constraints)


def test_same_seed_same_task_and_other_seed_another() -> None:
    for name in COMPOSITIONS:
        task = sample_composition(np.random.default_rng(3), name)
        assert task == sample_composition(np.random.default_rng(3), name)
        assert task != sample_composition(np.random.default_rng(4), name)
        assert task.mission.name == name and task.mission_id == SAMPLED
        assert SLACK_RANGE[0] <= task.slack <= SLACK_RANGE[1]
    drawn = {sample_composition(np.random.default_rng(i)).mission.name for i in range(12)}
    assert len(drawn) >= 3 and drawn <= set(COMPOSITIONS)


def test_no_composition_is_one_of_the_five_missions(tasks: list[Task]) -> None:
    five = {form_of(sample_task(np.random.default_rng(0), m, f)) for m in MISSION_IDS for f in FAMILIES}
    assert five.isdisjoint({form_of(task) for task in tasks})
    for name in COMPOSITIONS:
        mine = {form_of(task) for task in tasks if task.mission.name == name}
        assert mine.isdisjoint({form_of(task) for task in tasks if task.mission.name != name})


def test_they_read_as_english_that_means_the_same(tasks: list[Task]) -> None:
    for task in tasks:
        text = to_english(task.mission, task.scenario)
        assert parse_mission(text, task.scenario) == task.mission, text


def test_they_can_be_done_in_time_but_not_at_leisure(tasks: list[Task]) -> None:
    """The shortest time that the feasibility check finds is less than the allowed one, by about the slack."""
    for task in tasks:
        goals = task.mission.goals
        if task.mission.name not in ("return", "detour", "slow", "all slow"):
            continue
        allowed = goals[-1].seconds
        assert allowed is not None
        least = check_feasible(task.mission, task.scenario)
        assert 1.0 <= allowed / least <= 2.2 * task.slack
        assert task.scenario.horizon_seconds > allowed


def test_starts_are_free_far_and_clear_of_what_is_forbidden(tasks: list[Task]) -> None:
    for task in tasks:
        scenario = task.scenario
        ego, adversary = np.array(scenario.ego_start.centre), np.array(scenario.adversary_start.centre)
        assert free_points(scenario, [ego], scenario.ego.radius_metres)[0]
        assert free_points(scenario, [adversary], scenario.adversary.radius_metres)[0]
        assert math.hypot(*(ego - adversary)) >= FAR_METRES - 1e-9
        for place in task.mission.goals[0].places:
            assert scenario.place(place).distance([adversary])[0] >= FAR_METRES - 1e-9
        for constraint in task.mission.beside:
            for place in constraint.places:
                assert scenario.place(place).distance([adversary])[0] > 0.25
            assert constraint.avoid or constraint.type is ConstraintType.ALWAYS


def test_wrong_arguments_are_answered() -> None:
    with pytest.raises(UnknownName, match="did you mean 'return'"):
        sample_composition(np.random.default_rng(0), "retrun")
    with pytest.raises(ValueError, match="slack is 1"):
        sample_composition(np.random.default_rng(0), slack=1.0)
