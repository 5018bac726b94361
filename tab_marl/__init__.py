"""Task-Aware Behaviour Fields and POMCP against learned adversaries.

The names below load their module when first used, so that ``import tab_marl`` stays quick. Importing this package
registers its environments with Gymnasium and PettingZoo.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOME = {
    "Scenario": "tab_marl.world.scenario",
    "sample_scenario": "tab_marl.world.sampling",
    "GridMap": "tab_marl.world.grid",
    "Mission": "tab_marl.mission",
    "Constraint": "tab_marl.mission",
    "parse_mission": "tab_marl.mission",
    "to_english": "tab_marl.mission",
    "Task": "tab_marl.mission.tasks",
    "sample_task": "tab_marl.mission.tasks",
    "FieldProblem": "tab_marl.field",
    "FieldOptions": "tab_marl.field",
    "TabField": "tab_marl.field",
    "solve": "tab_marl.field",
    "Pomcp": "tab_marl.planning",
    "PomcpOptions": "tab_marl.planning",
    "make_planner": "tab_marl.agents.planners",
    "load_zoo": "tab_marl.agents.policies.zoo",
}
_MODULES = ("agents", "envs", "evaluation", "field", "mission", "planning", "world")

__all__ = [
    "Constraint",
    "FieldOptions",
    "FieldProblem",
    "GridMap",
    "Mission",
    "Pomcp",
    "PomcpOptions",
    "Scenario",
    "TabField",
    "Task",
    "__version__",
    "agents",
    "envs",
    "evaluation",
    "field",
    "load_zoo",
    "make_planner",
    "mission",
    "parse_mission",
    "planning",
    "sample_scenario",
    "sample_task",
    "solve",
    "to_english",
    "world",
]

if TYPE_CHECKING:
    from tab_marl import agents, envs, evaluation, field, mission, planning, world
    from tab_marl.agents.planners import make_planner
    from tab_marl.agents.policies.zoo import load_zoo
    from tab_marl.field import FieldOptions, FieldProblem, TabField, solve
    from tab_marl.mission import Constraint, Mission, parse_mission, to_english
    from tab_marl.mission.tasks import Task, sample_task
    from tab_marl.planning import Pomcp, PomcpOptions
    from tab_marl.world.grid import GridMap
    from tab_marl.world.sampling import sample_scenario
    from tab_marl.world.scenario import Scenario


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(import_module(_HOME[name]), name)
    elif name in _MODULES:
        value = import_module(f"tab_marl.{name}")
    else:
        raise AttributeError(f"module 'tab_marl' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)


def _register_environments() -> None:
    from tab_marl.envs.registration import register_all

    register_all(opponent_loader="tab_marl.agents.opponents:load_opponent")


_register_environments()
