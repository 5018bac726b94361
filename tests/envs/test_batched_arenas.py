"""The batched arenas against the pymunk environment, step by step, and by themselves."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tab_marl.envs import arena_kernels
from tab_marl.envs.adversary_observation import AdversaryTask
from tab_marl.envs.batched_arenas import EVENTS, BatchedArenas
from tab_marl.envs.intercept import InterceptEnv
from tab_marl.envs.styles import Style
from tab_marl.mission.monitor import SPEED_TOLERANCE
from tab_marl.mission.tasks import Task, sample_task
from tab_marl.world.scenario import EGO_TASKS, Scenario


def arenas_of(task: Task, count: int = 1, **arguments) -> BatchedArenas:
    style = Style()
    return BatchedArenas(
        [AdversaryTask.build(task.scenario, task.mission, style, np.random.default_rng(0))], count, **arguments
    )


def both(task: Task, seed: int, steps: int, wander: float = 0.25, hunt: bool = False, **arguments):
    """The same actions in both worlds. Yields (environment's result, batched outcome) while both go on.

    Random turns, a few per second; a hunting ego drives to the adversary, or to its goal in odd seeds.
    """
    env = InterceptEnv(task=task, **arguments)
    observations, _ = env.reset(seed=seed)
    arenas = arenas_of(task, **arguments)
    starts = np.array([[m.x, m.y, m.theta] for m in env.episode.motion])[None]
    ego, adversary = arenas.begin(np.array([0]), np.random.default_rng(0), starts=starts)
    np.testing.assert_allclose(ego[0], observations["ego_0"], atol=1e-6)
    np.testing.assert_allclose(adversary[0], observations["adversary_0"], atol=1e-6)
    rng = np.random.default_rng(seed)
    for step in range(steps):
        if step % 8 == 0:
            actions = rng.uniform(-1, 1, (2, 2)).astype(np.float32)
            actions[:, 0] = 1.0
            actions[:, 1] *= wander
            if hunt:
                actions[1, 1] = math.copysign(0.6, actions[1, 1]) if seed % 3 == 0 else 0.8  # circles, mostly
        if hunt:
            own, other = env.episode.motion
            x, y = (
                (other.x, other.y) if seed % 2 == 0 or task.scenario.ego_goal is None else task.scenario.ego_goal.centre
            )
            actions[0] = 0.9, np.clip(math.remainder(math.atan2(y - own.y, x - own.x) - own.theta, math.tau), -1, 1)
        theirs = env.step({"ego_0": actions[0], "adversary_0": actions[1]})
        ours = arenas.step(actions[:1], actions[1:])
        yield theirs, ours
        over = not env.agents
        assert over == bool(ours.terminated[0] or ours.truncated[0])
        if over:
            return


@pytest.mark.parametrize("kind", EGO_TASKS)
def test_an_episode_is_the_environments(kind, mixed, reach_a) -> None:
    """In free space everything is equal: observations, rewards, ends and events, in every ego task."""
    scenario = replace(Scenario.preset("open").for_task(kind), sensors=replace(mixed.sensors, lidar_rays=7))
    scenario = replace(scenario, sensors=replace(scenario.sensors, adversary_sees_ego_metres=0.9))
    task = replace(reach_a, scenario=scenario)
    ends, compared = set(), 0
    for seed in range(8):
        for (observations, rewards, terminated, _, infos), ours in both(
            task, seed, 250, hunt=True, full_observation=seed == 3,
            adversary_rewards="shaped" if seed % 2 else None,
        ):  # fmt: skip
            events = dict(zip(EVENTS, ours.events[0], strict=True))
            if events["ego_collided"] or events["adversary_collided"] or infos["ego_0"]["collided"]:
                break  # from here on pymunk's contact differs by a millimetre or two; see below
            if ours.ego[0, 8] and math.dist(ours.ego[0, :2], ours.ego[0, 9:11]) < 0.22:
                break  # the robots touch
            compared += 1
            np.testing.assert_allclose(ours.ego[0], observations["ego_0"], atol=2e-6)
            np.testing.assert_allclose(ours.adversary[0], observations["adversary_0"], atol=2e-5)
            assert ours.rewards[0].tolist() == pytest.approx([rewards["ego_0"], rewards["adversary_0"]], abs=1e-7)
            assert ours.terminated[0] == terminated["ego_0"]
            assert events["intercepted"] == infos["ego_0"]["intercepted"]
            for name in ("encountered", "arrived", "watched"):
                assert events[name] == infos["ego_0"].get(name, False), name
            ends |= {name for name in EVENTS if events[name]}
    assert compared > 300
    assert (
        ends
        >= {"interception": {"intercepted"}, "avoidance": {"encountered", "arrived"}, "surveillance": {"watched"}}[kind]
    )


def test_contact_costs_what_it_costs_in_the_environment(reach_a) -> None:
    """Driven against walls and obstacles: poses stay close, and collisions are counted alike."""
    apart, mine, theirs = [], 0, 0
    for seed in range(8):
        for result, ours in both(reach_a, seed, 120, wander=0.6):
            events = dict(zip(EVENTS, ours.events[0], strict=True))
            mine += events["ego_collided"] + events["adversary_collided"]
            theirs += result[4]["ego_0"]["collided"] + result[4]["adversary_0"]["collided"]
            apart.append(math.dist(result[0]["ego_0"][:2], ours.ego[0, :2]))
            if apart[-1] > 0.05:
                break
    assert mine > 10 and abs(mine - theirs) <= 2
    assert np.percentile(apart, 95) < 0.01


def test_arenas_do_not_disturb_each_other() -> None:
    """A batch, shared by several threads, plays what its arenas play alone."""
    tasks = [sample_task(np.random.default_rng(i), mission, "point") for i, mission in enumerate(("M1", "M4", "M5"))]
    built = [AdversaryTask.build(t.scenario, t.mission, Style(), np.random.default_rng(0)) for t in tasks]
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (40, 2, 6, 2)).astype(np.float32)
    together = BatchedArenas(built, 6, workers=4)
    order = np.array([0, 1, 2, 2, 1, 0])
    together.begin(np.arange(6), np.random.default_rng(1), tasks=order)
    starts = together.robots[:, :, :3].copy()
    found = [together.step(*actions[t]) for t in range(40)]
    for i in range(6):
        alone = BatchedArenas([built[order[i]]], 1)
        alone.begin(np.array([0]), np.random.default_rng(2), starts=starts[i : i + 1])
        for t in range(40):
            outcome = alone.step(actions[t, 0, i : i + 1], actions[t, 1, i : i + 1])
            np.testing.assert_array_equal(outcome.ego[0], found[t].ego[i])
            np.testing.assert_array_equal(outcome.adversary[0], found[t].adversary[i])
            assert outcome.rewards[0].tolist() == found[t].rewards[i].tolist()


def test_there_is_at_least_one_worker(reach_a) -> None:
    built = AdversaryTask.build(reach_a.scenario, reach_a.mission, Style(), np.random.default_rng(0))
    with pytest.raises(ValueError, match="workers is 0, must be >= 1"):
        BatchedArenas([built], 2, workers=0)


def test_bodies_that_touch_do_not_pass(mixed, reach_a) -> None:
    """Surveillance lets robots touch: they stay a diameter apart and inside the arena."""
    task = replace(reach_a, scenario=mixed.for_task("surveillance"))
    arenas = arenas_of(task)
    arenas.begin(np.array([0]), np.random.default_rng(0), starts=np.array([[[1.2, 0.4, math.pi], [0.7, 0.4, 0.0]]]))
    forward = np.array([[1.0, 0.0]], dtype=np.float32)
    for _ in range(60):
        arenas.step(forward, forward)
        gap = math.dist(arenas.robots[0, 0, :2], arenas.robots[0, 1, :2])
        assert gap > 0.21 - 0.003
    assert arenas.robots[0, :, :2].min() > 0.104


def test_speed_tolerance_is_the_monitors() -> None:
    assert arena_kernels.SPEED_TOLERANCE == SPEED_TOLERANCE


def test_bad_input_is_refused(reach_a, mixed) -> None:
    arenas = arenas_of(reach_a, 2)
    arenas.begin(np.arange(2), np.random.default_rng(0))
    fine = np.zeros((2, 2), dtype=np.float32)
    with pytest.raises(ValueError, match=r"actions of the ego have shape \(1, 2\), must be \(2, 2\)"):
        arenas.step(fine[:1], fine)
    with pytest.raises(ValueError, match="adversary is not finite"):
        arenas.step(fine, np.full((2, 2), np.nan, dtype=np.float32))
    with pytest.raises(ValueError, match="arenas is 0"):
        arenas_of(reach_a, 0)
    other = replace(reach_a, scenario=mixed.for_task("avoidance"))
    built = [AdversaryTask.build(t.scenario, t.mission, Style(), np.random.default_rng(0)) for t in (reach_a, other)]
    with pytest.raises(ValueError, match="one batch needs one kind of ego"):
        BatchedArenas(built, 2)
