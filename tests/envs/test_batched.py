"""The batched world against one robot at a time in plain Python, and its reward's bookkeeping."""

from __future__ import annotations

import numpy as np
import pytest

from tab_marl.envs import adversary_kernels as k
from tab_marl.envs.adversary_observation import AdversaryObserver, AdversaryTask
from tab_marl.envs.batched import Bank, BatchedWorld, Prices, draw_start
from tab_marl.envs.motion_kernels import drive
from tab_marl.envs.styles import STYLES
from tab_marl.mission.tasks import sample_task
from tab_marl.world.grid import free_points


@pytest.fixture(scope="module")
def bank():
    tasks = []
    for i, mission in enumerate(("M1", "M2", "M3", "M4", "M5")):
        drawn = sample_task(np.random.default_rng(i), mission, "ambiguous" if i % 2 else "point", 1.8)
        for style in ("direct", "via", "late"):
            tasks.append(
                AdversaryTask.build(drawn.scenario, drawn.mission, STYLES[style], np.random.default_rng(10 + i))
            )
    return Bank.of(tasks)


def follow(observation):
    """Along the route, waiting where it would be early."""
    angle = np.arctan2(observation[:, 1], observation[:, 0])
    waits = (observation[:, k.O_TARGET] > 0) & (observation[:, k.O_TARGET + 1] > 0.02)
    speed = np.where(waits | (np.abs(angle) > 1), 0.0, np.cos(angle))
    return np.stack([2 * speed - 1, np.clip(angle / 0.182, -1, 1)], axis=1).astype(np.float32)


def test_a_step_equals_one_robot_at_a_time(bank):
    """Positions, mission states, observations and rewards of every robot, by hand, for 300 steps."""
    n = len(bank)
    world = BatchedWorld(bank, n, np.random.default_rng(0))
    world.begin(np.arange(n), np.arange(n))
    prices = Prices()
    observers = [AdversaryObserver(task) for task in bank.tasks]
    pose = world.state[:, :3].copy()
    states, lengths, excesses = [], [], []
    for i, task in enumerate(bank.tasks):
        mask = int(task.automaton.masks(pose[i, :2])[0])
        states.append(task.automaton.first(mask))
        observers[i].observe(*pose[i], 0, 0, *states[i])
        lengths.append(world.potential[i, 0])
        excesses.append(world.potential[i, 1])
    rng = np.random.default_rng(1)
    ended = set()
    for _ in range(250):
        action = np.clip(follow(world.observation) + rng.normal(0, 0.1, (n, 2)), -1.2, 1.2).astype(np.float32)
        world.step(action)
        for i, task in enumerate(bank.tasks):
            if i in ended:
                assert world.reward[i] == 0
                continue
            a = np.clip(action[i].astype(np.float64), -1, 1)
            v, w = (a[0] + 1) / 2 * 0.22, a[1] * 1.82
            *pose[i], v, hit = drive(task.tables, 0, *pose[i], v, w, 0.105, 0.01, 10)
            before, automaton = states[i], task.automaton
            mask = int(automaton.masks(pose[i, :2])[0])
            after = automaton.advance(before, mask)
            counted = automaton.progress[before.location, mask] and after.location != -2
            states[i] = after
            assert world.location[i] == after.location
            np.testing.assert_allclose(world.state[i], (*pose[i], v, w), atol=1e-12)
            reward = prices.visit * counted + prices.touch * hit
            if after.location < 0:
                ended.add(i)
                reward += prices.completed + prices.metre * lengths[i] if after.location == -1 else prices.failed
            else:
                memory = observers[i].via_passed, observers[i].style_dropped
                seen = observers[i].observe(*pose[i], v, w, *after)
                np.testing.assert_allclose(world.observation[i], seen, atol=1e-6)
                length, excess = world.potential[i]
                if memory == (observers[i].via_passed, observers[i].style_dropped):
                    reward += prices.metre * (lengths[i] - length)
                if after.location == before.location and memory[1] == observers[i].style_dropped:
                    reward += prices.excess_metre * (excesses[i] - excess)
                reward += prices.tick * (excess <= 0)
                lengths[i], excesses[i] = length, excess
            assert world.reward[i] == pytest.approx(reward, abs=1e-9)
    assert len(ended) >= n // 3


def test_a_completed_direct_mission_pays_its_length_visits_and_time(bank):
    """The potential telescopes: metres from the start, whatever the way, plus visits, completion and ticks."""
    direct = [i for i in range(len(bank)) if bank.tasks[i].style.name == "direct" and i not in (3,)]
    world = BatchedWorld(bank, len(direct), np.random.default_rng(3))
    world.begin(np.arange(len(direct)), np.array(direct))
    start = world.potential[:, 0].copy()
    total, ticks, visits = np.zeros(len(direct)), np.zeros(len(direct)), np.zeros(len(direct))
    touched = np.zeros(len(direct))
    for _ in range(1500):
        alive = ~world.finished
        world.step(follow(world.observation))
        total += world.reward
        visits += world.visited
        touched += world.touched
        ticks += alive
        if world.finished.all():
            break
    assert world.completed.all()
    p = Prices()
    expected = p.metre * start + p.visit * visits + p.completed + p.touch * touched + p.tick * (ticks - 1)
    np.testing.assert_allclose(total, expected, atol=1e-5)


def test_excess_time_is_a_debt_that_only_waiting_pays(bank):
    """On an exact-time mission, waiting earns what hurrying forfeits; and hurrying fails."""
    exact = np.array([3, 3])
    world = BatchedWorld(bank, 2, np.random.default_rng(0))
    world.begin(np.arange(2), exact)
    earned = np.zeros(2)
    for _ in range(600):
        patient = follow(world.observation)
        hasty_view = world.observation.copy()
        hasty_view[:, k.O_TARGET] = 0
        action = np.stack([patient[0], follow(hasty_view)[1]])
        world.step(action)
        earned += world.reward
    assert world.location.tolist() == [-1, -2]
    assert earned[0] > earned[1] + 5


def test_same_seed_same_episodes_and_finished_robots_stand_still(bank):
    def run(seed):
        world = BatchedWorld(bank, 8, np.random.default_rng(seed))
        world.begin(np.arange(8), np.arange(8))
        return world, [world.step(follow(world.observation)) or world.state.copy() for _ in range(400)]

    first, one = run(5)
    _, two = run(5)
    _, other = run(6)
    np.testing.assert_array_equal(one, two)
    assert np.abs(np.array(one) - np.array(other)).max() > 0.05
    done = np.flatnonzero(first.finished)
    assert len(done) > 2
    still = first.state[done].copy()
    first.step(np.ones((8, 2), dtype=np.float32))
    np.testing.assert_array_equal(first.state[done], still)


def test_beginning_some_leaves_the_others_alone(bank):
    world = BatchedWorld(bank, 4, np.random.default_rng(0))
    world.begin(np.arange(4), np.arange(4))
    for _ in range(20):
        world.step(follow(world.observation))
    others = world.state[[0, 2, 3]].copy(), world.observation[[0, 2, 3]].copy()
    world.begin(np.array([1]), np.array([7]))
    np.testing.assert_array_equal(world.state[[0, 2, 3]], others[0])
    np.testing.assert_array_equal(world.observation[[0, 2, 3]], others[1])
    assert world.task[1] == 7 and world.clocks[1].tolist() == [0, 0, 0]


def test_starts_are_free_points_of_the_start_region(bank):
    rng = np.random.default_rng(0)
    for task in bank.tasks[::3]:
        scenario = task.scenario
        poses = np.array([draw_start(task, rng) for _ in range(50)])
        assert scenario.adversary_start.contains(poses[:, :2]).all()
        assert free_points(scenario, poses[:, :2], scenario.adversary.radius_metres).all()
        assert np.ptp(poses[:, 2]) > 3


def test_a_ghost_ego_is_seen_only_nearby(bank):
    world = BatchedWorld(bank, 40, np.random.default_rng(0))
    world.seen_metres = 0.8
    seen = []
    for _ in range(30):
        world.begin(np.arange(40), np.zeros(40, dtype=np.int64))
        seen.append(world.observation[:, k.O_EGO :].copy())
    rows = np.concatenate(seen)
    flagged = rows[:, 0] > 0
    assert 0.01 < flagged.mean() < 0.25
    assert (np.hypot(rows[flagged, 1], rows[flagged, 2]) <= 0.8 + 1e-6).all()
    assert not rows[~flagged].any()


def test_bad_sizes_are_refused(bank):
    with pytest.raises(ValueError, match="at least one task"):
        Bank.of([])
    with pytest.raises(ValueError, match="robots is 0"):
        BatchedWorld(bank, 0, np.random.default_rng(0))
