"""The environments for PettingZoo and Gymnasium. Names load their module when first used."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from tab_marl.envs.registration import register_all

_HOME = {
    "AdversaryRewards": "tab_marl.envs.reward",
    "Curriculum": "tab_marl.mission.curriculum",
    "DifficultyLadder": "tab_marl.envs.ladder",
    "EgoView": "tab_marl.envs.ego_observation",
    "InterceptEnv": "tab_marl.envs.intercept",
    "SingleAgentEnv": "tab_marl.envs.single_agent",
    "Style": "tab_marl.envs.styles",
    "TeamEnv": "tab_marl.envs.team",
    "adversary_env": "tab_marl.envs.single_agent",
    "ego_env": "tab_marl.envs.single_agent",
    "parse_ego_observation": "tab_marl.envs.ego_observation",
}
_MODULES = (
    "intercept_v0",
    "team_v0",
)

__all__ = [
    "AdversaryRewards",
    "Curriculum",
    "DifficultyLadder",
    "EgoView",
    "InterceptEnv",
    "SingleAgentEnv",
    "Style",
    "TeamEnv",
    "adversary_env",
    "ego_env",
    "intercept_v0",
    "parse_ego_observation",
    "register_all",
    "team_v0",
]

if TYPE_CHECKING:
    from tab_marl.envs import intercept_v0, team_v0
    from tab_marl.envs.ego_observation import EgoView, parse_ego_observation
    from tab_marl.envs.intercept import InterceptEnv
    from tab_marl.envs.ladder import DifficultyLadder
    from tab_marl.envs.reward import AdversaryRewards
    from tab_marl.envs.single_agent import SingleAgentEnv, adversary_env, ego_env
    from tab_marl.envs.styles import Style
    from tab_marl.envs.team import TeamEnv
    from tab_marl.mission.curriculum import Curriculum


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(import_module(_HOME[name]), name)
    elif name in _MODULES:
        value = import_module(f"tab_marl.envs.{name}")
    else:
        raise AttributeError(f"module 'tab_marl.envs' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
