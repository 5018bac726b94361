"""Vector environments through Gymnasium's make_vec: copies of the pymunk environment, and the batched one."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import tab_marl  # noqa: F401, registers the environments
from tab_marl.agents.policies.zoo import load_zoo
from tab_marl.envs.batched_env import BatchedEnv

BATCHED = ("tab_marl/BatchedEgo-v0", "tab_marl/BatchedAdversary-v0")
SIDES = ("tab_marl/Ego-v0", "tab_marl/Adversary-v0")


def play(env, seed: int, steps: int = 60) -> list[np.ndarray]:
    first, _ = env.reset(seed=seed)
    rng = np.random.default_rng(0)
    found = [first]
    for _ in range(steps):
        observations, rewards, terminated, truncated, _ = env.step(
            rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        )
        found += [observations, rewards, terminated, truncated]
    return found


@pytest.mark.parametrize("side", SIDES)
def test_copies_of_the_environment(side) -> None:
    """`make_vec` makes pymunk environments; each plays what it would play alone with its seed."""
    envs = gymnasium.make_vec(side, num_envs=3, mission="M4")
    assert isinstance(envs, SyncVectorEnv)
    alone = gymnasium.make(side, mission="M4")
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (40, 3, 2)).astype(np.float32)
    observations, _ = envs.reset(seed=5)
    rows = [observations] + [envs.step(a)[0] for a in actions]
    for i in range(3):
        expected, _ = alone.reset(seed=5 + i)  # Gymnasium's rule for one seed and many environments
        np.testing.assert_array_equal(rows[0][i], expected)
        for t in range(40):
            expected, _, terminated, truncated, _ = alone.step(actions[t, i])
            np.testing.assert_array_equal(rows[t + 1][i], expected)
            if terminated or truncated:
                break
    assert not np.array_equal(rows[0][0], rows[0][1])


@pytest.mark.parametrize("name", BATCHED)
def test_batched_environments(name) -> None:
    env = gymnasium.make_vec(name, num_envs=8, mission="M1", max_cycles=25)
    assert isinstance(env, BatchedEnv) and env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    single = gymnasium.make(name.replace("Batched", ""), mission="M1")
    assert env.single_observation_space == single.observation_space
    assert env.single_action_space == single.action_space
    one, two, other = play(env, 3), play(env, 3), play(env, 4)
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)
    assert any(not np.array_equal(a, b) for a, b in zip(one, other, strict=True))
    assert all(row in env.observation_space for row in one[:1] + one[1::4])
    truncated = np.array(one[4::4])
    assert truncated.sum() == 8 * 2, "two cut-offs of 25 steps each within 60"


def test_batched_ends_begin_anew_in_the_same_step() -> None:
    env = gymnasium.make_vec(
        "tab_marl/BatchedEgo-v0", num_envs=4, mission="M4", scenario="random", tasks=6, max_cycles=10
    )
    env.reset(seed=0)
    assert len(env.arenas.bank) == 6
    for step in range(1, 31):
        before = env.arenas.robots.copy()
        observations, _, terminated, truncated, infos = env.step(np.tile(np.float32([0.5, 0.1]), (4, 1)))
        ended = terminated | truncated
        assert (truncated == (step % 10 == 0)).all()
        if ended.any():
            np.testing.assert_array_equal(infos["_final_obs"], ended)
            for i in np.flatnonzero(ended):
                assert np.hypot(*(infos["final_obs"][i][:2] - before[i, 0, :2])) < 0.03
                np.testing.assert_allclose(observations[i, 6], 0.0)
        else:
            assert "final_obs" not in infos
    with_statistics = RecordEpisodeStatistics(env)
    with_statistics.reset(seed=0)
    for _ in range(10):
        *_, infos = with_statistics.step(np.tile(np.float32([0.5, 0.1]), (4, 1)))
    assert (infos["episode"]["l"] == 10).all()


def test_who_plays_the_other_side() -> None:
    """Scripted by name, all at once or one per arena; a zoo policy; a function of all observations."""
    policy = load_zoo()[0]
    paths = {}
    for opponent in ("follow", "static", "random", policy, policy.name, lambda o: np.zeros((len(o), 2))):
        env = gymnasium.make_vec("tab_marl/BatchedEgo-v0", num_envs=5, mission="M4", opponent=opponent)
        paths[str(opponent)] = play(env, 1, 40)
        moved = np.hypot(*(env.arenas.robots[:, 1, :2] - env.arenas.bank.tasks[0].scenario.adversary_start.centre).T)
        assert (moved.max() > 0.3) == (opponent != "static")
    hunted = gymnasium.make_vec("tab_marl/BatchedAdversary-v0", num_envs=3, mission="M4", opponent="pursue")
    assert np.isfinite(play(hunted, 1, 20)[-4]).all()
    wrong = gymnasium.make_vec("tab_marl/BatchedEgo-v0", num_envs=5, opponent=lambda o: np.zeros(2))
    wrong.reset(seed=0)
    with pytest.raises(ValueError, match=r"actions \(2,\), must be \(5, 2\): in a batched environment it plays all"):
        wrong.step(np.zeros((5, 2), dtype=np.float32))
    for bad, message in (
        ({"opponent": 3}, "opponent is 3, must be"),
        ({"tasks": 0}, "tasks is 0"),
        ({"side": "x"}, "side is 'x'"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            BatchedEnv(**{"num_envs": 2, "side": "ego", "opponent": "follow", **bad})
