"""Names for the environments in Gymnasium's and PettingZoo's registries. Entry points are strings: nothing is loaded.

`ENVIRONMENTS` is the one table of ids; tests and pages read it. An id fixes some arguments; every other argument, and these
too, can be given to `make`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

NAMESPACE = "tab_marl"
VERSION = 0


@dataclass(frozen=True)
class Environment:
    """One environment and its ids in both libraries."""

    name: str
    """Of the PettingZoo environment, without namespace and version."""
    meaning: str
    """One sentence."""
    arguments: Mapping[str, Any] = field(default_factory=dict)
    """What the id fixes."""
    module: str = "intercept_v0"
    """Of `tab_marl.envs`: holds `parallel_env` and `env`."""
    views: Mapping[str, str] = field(default_factory=dict)
    """Gymnasium name -> the side that learns, "ego" or "adversary"."""

    @property
    def pettingzoo_id(self) -> str:
        return f"{NAMESPACE}/{self.name}-v{VERSION}"

    @property
    def gymnasium_ids(self) -> dict[str, str]:
        """Id -> the side that learns."""
        return {f"{NAMESPACE}/{name}-v{VERSION}": side for name, side in self.views.items()}


def _both(name: str, meaning: str, arguments: Mapping[str, Any], module: str = "intercept_v0") -> Environment:
    """An environment in which either side may learn; the part of its name after "intercept" names the views."""
    rest = name.removeprefix("intercept")
    rest = rest if rest != name else f"-{name}"
    return Environment(name, meaning, arguments, module, {f"Ego{rest}": "ego", f"Adversary{rest}": "adversary"})


def _ego_only(name: str, meaning: str, arguments: Mapping[str, Any]) -> Environment:
    return Environment(name, meaning, arguments, views={f"Ego-{name}": "ego"})


ANY_ON_RANDOM_MAPS = {"scenario": "random", "mission": "any"}
AWARE_METRES = 1.0

ENVIRONMENTS: tuple[Environment, ...] = (
    _both("intercept", "One ego, one adversary on the lab map; mission M1 unless `mission` says otherwise.", {}),
    _both("intercept-M1", "The paper's M1 on the lab map: reach a checkpoint within a time.", {"mission": "M1"}),
    _both("intercept-M2", "M2: a checkpoint, then another at an exact time.", {"mission": "M2"}),
    _both("intercept-M3", "M3: a checkpoint again and again, each time within a time.", {"mission": "M3"}),
    _both("intercept-M4", "M4: a checkpoint, while avoiding the central zone.", {"mission": "M4"}),
    _both("intercept-M5", "M5: any three checkpoints, then a target, avoiding the centre.", {"mission": "M5"}),
    _both("intercept-U5", "The paper's underwater mission on the planar reef, 6 x 6 m.", {"mission": "U5", "scenario": "reef"}),
    _both("intercept-sampled", "The lab map; type, goals, starts and deadlines of M1 to M5 drawn at every reset.", {"mission": "any", "sampled": True}),
    _both("intercept-random", "Map, type, goals, starts and deadlines of M1 to M5 drawn at every reset.", ANY_ON_RANDOM_MAPS),
    _both("intercept-ambiguous", "As intercept-random; the last goal is any of several.", {**ANY_ON_RANDOM_MAPS, "family": "ambiguous"}),
    _both("intercept-perimeter", "As intercept-random; the last goal is wider than the interception radius.", {**ANY_ON_RANDOM_MAPS, "family": "perimeter"}),
    _both("intercept-curriculum", "As intercept-random, by difficulty: 0 at first, set with `set_difficulty`.", {**ANY_ON_RANDOM_MAPS, "difficulty": 0.0}),
    _both("intercept-discrete", "As intercept, with 15 discrete actions.", {"actions": "discrete"}),
    _both("intercept-random-discrete", "As intercept-random, with 15 discrete actions.", {**ANY_ON_RANDOM_MAPS, "actions": "discrete"}),
    _both("intercept-aware", "As intercept; the adversary notices the ego within a metre and in free sight.", {"adversary_sees_ego_metres": AWARE_METRES}),
    _both("intercept-random-aware", "As intercept-random; the adversary notices the ego.", {**ANY_ON_RANDOM_MAPS, "adversary_sees_ego_metres": AWARE_METRES}),
    _ego_only("avoidance", "The lab map; the ego must cross it without meeting the adversary.", {"scenario": "lab-avoidance"}),
    _ego_only("avoidance-random", "Map and missions drawn; the ego must cross without meeting the adversary.", {**ANY_ON_RANDOM_MAPS, "ego_task": "avoidance"}),
    _ego_only("surveillance", "The lab map; the ego is paid while it watches the adversary.", {"scenario": "lab-surveillance"}),
    _ego_only("surveillance-random", "Map and missions drawn; the ego is paid while it watches the adversary.", {**ANY_ON_RANDOM_MAPS, "ego_task": "surveillance"}),
    _both("team", "Two egos, two adversaries (M1 and M2) on the lab map.", {"egos": 2, "adversaries": 2, "mission": ("M1", "M2")}, "team_v0"),
    _both("team-random", "Two egos, two adversaries; map and missions drawn.", {"egos": 2, "adversaries": 2, **ANY_ON_RANDOM_MAPS}, "team_v0"),
)  # fmt: skip
"""Every environment; the batched ones (`BATCHED_IDS`) are vector environments of their own."""

BATCHED_IDS = {
    "tab_marl/BatchedEgo-v0": "tab_marl.envs.batched_env:batched_ego_env",
    "tab_marl/BatchedAdversary-v0": "tab_marl.envs.batched_env:batched_adversary_env",
}
"""For `gymnasium.make_vec` only."""

_VIEW_ENTRY_POINTS = {
    "ego": "tab_marl.envs.single_agent:ego_env",
    "adversary": "tab_marl.envs.single_agent:adversary_env",
}

_opponent_loader: str | None = None


def register_all(opponent_loader: str | None = None) -> None:
    """Register every environment with both libraries; those already registered are left alone.

    `opponent_loader`: "module:function" that makes a player from (name, side) for opponents that are no scripted ones, e.g.
    policies of a zoo; the environments themselves know none. Asked when such a name is used.
    """
    import gymnasium
    import pettingzoo

    global _opponent_loader
    _opponent_loader = opponent_loader or _opponent_loader
    registries = {"parallel": pettingzoo.parallel_registry, "aec": pettingzoo.aec_registry}
    functions = {"parallel": "parallel_env", "aec": "env"}
    for environment in ENVIRONMENTS:
        for name, side in environment.gymnasium_ids.items():
            if name not in gymnasium.registry:
                gymnasium.register(id=name, entry_point=_VIEW_ENTRY_POINTS[side], kwargs=dict(environment.arguments))
        for kind, registry in registries.items():
            if environment.pettingzoo_id not in registry:
                entry_point = f"tab_marl.envs.{environment.module}:{functions[kind]}"
                pettingzoo.register(
                    kind, environment.pettingzoo_id, entry_point, kwargs=dict(environment.arguments)
                )  # fmt: skip
    for name, entry_point in BATCHED_IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(id=name, vector_entry_point=entry_point)


def opponent_loader() -> str | None:
    """What `register_all` was given."""
    return _opponent_loader
