"""What the shipped policies do when nobody hunts them, and the arithmetic of the figures."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binomtest

from tab_marl.agents.adversaries import ScriptedAdversary
from tab_marl.agents.measures.rollouts import rollout_unopposed, zoo_rollouts
from tab_marl.agents.measures.validation import (
    HeldOut,
    allowed_seconds,
    mission_records,
    play_physics,
    run_held_out,
    wilson,
)
from tab_marl.agents.policies.zoo import load_zoo
from tab_marl.agents.training.env import build_bank
from tab_marl.envs.styles import STYLES
from tab_marl.mission.monitor import Monitor
from tab_marl.mission.tasks import sample_task

# Seeds that no measurement on a card and no training uses.
FRESH = 4242


@pytest.fixture(scope="module")
def zoo():
    return {policy.name: policy for policy in load_zoo()}


@pytest.fixture(scope="module")
def held_out():
    return HeldOut.draw(60, FRESH)


@pytest.fixture(scope="module")
def played(zoo, held_out):
    return {name: run_held_out(policy, held_out)[1] for name, policy in zoo.items()}


def test_wilson_is_scipys():
    for done, n in ((0, 5), (5, 5), (27, 30), (140, 150), (1, 2)):
        theirs = binomtest(done, n).proportion_ci(0.95, method="wilson")
        assert wilson(done, n) == pytest.approx((theirs.low, theirs.high), abs=1e-6)
    with pytest.raises(ValueError, match="3 successes of 2"):
        wilson(3, 2)


def test_every_shipped_policy_completes_its_missions_on_fresh_tasks(zoo, held_out, played):
    for name, policy in zoo.items():
        for record in mission_records(held_out.missions, played[name].completed, "batched"):
            if record.mission in policy.card.missions:
                assert record.high >= 0.9, (name, record)


def test_every_shipped_policy_completes_missions_in_the_physics_environment(zoo, held_out):
    """Five tasks each, one per mission type (the cards report sixty per type)."""
    for name, policy in zoo.items():
        tasks = [held_out.tasks[i] for i in range(5)]
        assert [t.mission_id for t in tasks] == ["M1", "M2", "M3", "M4", "M5"]
        assert play_physics(policy, tasks, FRESH).sum() >= 4, name


def test_the_scripted_follower_is_a_baseline_that_works(held_out):
    for style in ("direct", "late"):
        _, rollouts = run_held_out(ScriptedAdversary(STYLES[style]), held_out)
        assert rollouts.completed.mean() >= 0.9
    assert play_physics(ScriptedAdversary(), held_out.tasks[:5], 1).sum() >= 4


def test_the_scripted_follower_acts_alike_alone_and_together():
    seen = np.random.default_rng(0).uniform(-1, 1, (20, 40)).astype(np.float32)
    policy = ScriptedAdversary()
    together = policy.act(seen)
    np.testing.assert_array_equal(together, [policy.act(one) for one in seen])


def test_rollouts_start_like_episodes_and_complete_when_a_monitor_says_so(zoo):
    for mission in ("M1", "M2", "M3", "M4"):
        task = sample_task(np.random.default_rng(5), mission, "ambiguous")
        positions, completed = rollout_unopposed(zoo["direct"], task, np.random.default_rng(0), 12)
        scenario = task.scenario
        assert positions.shape == (12, scenario.horizon_ticks + 1, 2) and completed.shape == (12,)
        assert scenario.adversary_start.contains(positions[:, 0]).all()
        steps = np.hypot(*np.diff(positions, axis=1).transpose(2, 0, 1))
        assert steps.max() <= scenario.adversary.max_speed * scenario.step_seconds + 1e-4
        assert (completed > 0).mean() >= 0.8
        for path, tick in zip(positions, completed, strict=True):
            if tick < 0:
                continue
            # A monitor at the coarser rate sees the same end, up to what happens between two ticks.
            monitor = Monitor(task.mission, scenario, scenario.step_seconds)
            monitor.reset(path[0])
            ended = next((t for t, p in enumerate(path[1:], start=1) if monitor.step(p) != "active"), None)
            if monitor.status == "completed":
                assert abs(ended - tick) <= 1


def test_rollouts_depend_on_the_generator_only(zoo):
    task = sample_task(np.random.default_rng(5), "M1", "ambiguous")
    one = rollout_unopposed(zoo["side"], task, np.random.default_rng(0), 6)
    two = rollout_unopposed(zoo["side"], task, np.random.default_rng(0), 6)
    other = rollout_unopposed(zoo["side"], task, np.random.default_rng(1), 6)
    np.testing.assert_array_equal(one[0], two[0])
    np.testing.assert_array_equal(one[1], two[1])
    assert np.abs(one[0] - other[0]).max() > 0.1


def test_a_zoos_rollouts_are_its_policies_one_after_the_other(zoo):
    task = sample_task(np.random.default_rng(6), "M4")
    policies = list(zoo.values())[:3]
    positions, completed = zoo_rollouts(policies, task, np.random.default_rng(0), 5)
    assert positions.shape[0] == completed.shape[0] == 15
    with pytest.raises(ValueError, match="count is 0"):
        rollout_unopposed(policies[0], task, np.random.default_rng(0), 0)


def test_allowed_seconds_of_every_mission(held_out):
    bank = build_bank(held_out.tasks[:5], STYLES["direct"], 0)
    m1, m2, m3, m4, m5 = bank.tasks
    assert allowed_seconds(m1) == pytest.approx(m1.mission.goals[0].seconds, abs=0.1)
    assert allowed_seconds(m2) == pytest.approx(1.1 * m2.mission.goals[1].seconds, abs=0.6)
    assert allowed_seconds(m3) == pytest.approx(3 * m3.mission.goals[0].seconds, abs=0.4)
    assert allowed_seconds(m4) == m4.scenario.horizon_seconds
    assert allowed_seconds(m5) == pytest.approx(4 * m5.mission.goals[0].max_gap_seconds, abs=0.5)
