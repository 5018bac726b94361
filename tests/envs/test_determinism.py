"""The same seed and actions give the same episode to the last bit; in a new process: test_own_conformance.py."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tab_marl.envs.intercept import InterceptEnv

ARGUMENTS: dict[str, dict[str, Any]] = {
    "lab": {"mission": "M3", "scenario": "lab"},
    "random": {"mission": "M5", "scenario": "random", "family": "ambiguous"},
}


def episode(env: InterceptEnv, seed: int) -> list[Any]:
    """Everything that an episode of random driving (into walls, mostly) returns, floats as exact text."""
    rng = np.random.default_rng(seed)
    observations, infos = env.reset(seed=seed)
    record: list[Any] = [exact(observations), repr(infos)]
    while env.agents:
        observations, rewards, terminations, truncations, infos = env.step(
            {agent: np.array([1.0, np.clip(rng.normal(0.0, 0.4), -1.0, 1.0)]) for agent in env.agents}
        )
        record.append((exact(observations), repr((rewards, terminations, truncations, infos)), env.state().tobytes()))
    return record


def exact(observations: dict[str, np.ndarray]) -> dict[str, bytes]:
    return {agent: observation.tobytes() for agent, observation in observations.items()}


@pytest.mark.parametrize("name", ARGUMENTS)
def test_whole_episodes_repeat(name: str) -> None:
    env, twin = InterceptEnv(**ARGUMENTS[name]), InterceptEnv(**ARGUMENTS[name])
    lengths, collisions = [], 0
    for seed in (1, 2, 1):  # the last repeats on environments that have played before
        record, other = episode(env, seed), episode(twin, seed)
        assert record == other
        lengths.append(len(record))
        collisions += sum("'collided': True" in str(step) for step in record)
    assert lengths[0] == lengths[2] and max(lengths) > 50
    assert collisions > 0, "no contact: the test shows little"
    assert episode(env, 1) != episode(env, 2)


def test_unseeded_resets_go_on_from_the_seed() -> None:
    starts = []
    for _ in range(2):
        env = InterceptEnv()
        env.reset(seed=9)
        env.reset()
        starts.append(env.episode.motion)
    assert starts[0] == starts[1]
