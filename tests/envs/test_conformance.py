"""Every registered id passes the tests of PettingZoo, Gymnasium and stable-baselines3."""

from __future__ import annotations

import warnings
from types import SimpleNamespace
from typing import Any

import gymnasium
import pettingzoo
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import (
    api_test,
    max_cycles_test,
    parallel_api_test,
    parallel_seed_test,
    render_test,
    seed_test,
)
from pettingzoo.test.state_test import state_test
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from tab_marl.envs import register_all
from tab_marl.envs.registration import ENVIRONMENTS

register_all()

ZOO_IDS = [environment.pettingzoo_id for environment in ENVIRONMENTS]
VIEWS = [name for environment in ENVIRONMENTS for name in environment.gymnasium_ids]

UNEQUAL = {"Agents have different observation space sizes", "Observations are different shapes"}
"""PettingZoo prefers agents that observe alike; ours observe by their roles."""
QUIET = {"Observation numpy array is all zeros.", "Observation numpy array has all its values equal to each other"}
"""An adversary observes nothing once its mission is over."""

# What these test suites do not like they say by warnings.
pytestmark = pytest.mark.filterwarnings("error::UserWarning")


def parallel(name: str, **arguments: Any) -> Any:
    return pettingzoo.make("parallel", name, **arguments)


def aec(name: str, **arguments: Any) -> Any:
    return pettingzoo.make("aec", name, **arguments)


@pytest.mark.parametrize("name", ZOO_IDS)
def test_parallel_api(name: str) -> None:
    parallel_api_test(parallel(name, max_cycles=20), num_cycles=30)


@pytest.mark.parametrize("name", ZOO_IDS)
def test_aec_api(name: str) -> None:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        api_test(aec(name, max_cycles=12), num_cycles=20)
    said = {str(w.message) for w in found if w.category is UserWarning}
    assert said - UNEQUAL - QUIET == set()


@pytest.mark.parametrize("name", ZOO_IDS)
def test_seeds(name: str) -> None:
    seed_test(lambda: aec(name), num_cycles=5)
    parallel_seed_test(lambda: parallel(name), num_cycles=2)


@pytest.mark.parametrize("name", ZOO_IDS)
def test_max_cycles(name: str) -> None:
    max_cycles_test(
        SimpleNamespace(
            env=lambda **k: aec(name, **k),
            raw_env=lambda **k: aec(name, **k),
            parallel_env=lambda **k: parallel(name, **k),
        )
    )


@pytest.mark.parametrize("name", ZOO_IDS)
def test_render(name: str) -> None:
    render_test(lambda **k: aec(name, **k))


@pytest.mark.parametrize("name", ZOO_IDS)
def test_state(name: str) -> None:
    state_test(aec(name), parallel(name), num_cycles=4)


@pytest.mark.parametrize("name", VIEWS)
def test_gymnasium_checker(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(name).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("name", VIEWS)
def test_sb3_checker(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sb3_check_env(gymnasium.make(name).unwrapped)
