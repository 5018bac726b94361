"""The team environment as PettingZoo names things: `parallel_env`, `env` (AEC) and `raw_env` (AEC, bare)."""

from __future__ import annotations

from typing import Any

from pettingzoo import AECEnv
from pettingzoo.utils.conversions import parallel_to_aec, parallel_to_aec_wrapper

from tab_marl.envs.team import TeamEnv

__all__ = ["env", "parallel_env", "raw_env"]

parallel_env = TeamEnv
"""ParallelEnv; its arguments are `TeamEnv`'s."""


def env(**arguments: Any) -> AECEnv:
    """AEC environment, by PettingZoo's own conversion and with its order checks; arguments as `parallel_env`."""
    return parallel_to_aec(TeamEnv(**arguments))


def raw_env(**arguments: Any) -> AECEnv:
    """AEC environment without the order checks."""
    return parallel_to_aec_wrapper(TeamEnv(**arguments))
