"""Missions: constraint tuples, their timed automaton, its unrolled form."""

from tab_marl.mission.automaton import (
    ALWAYS_FORBIDDEN,
    COMPLETED,
    FAILED,
    NO_BRANCH,
    UNBOUNDED,
    AutomatonState,
    MissionAutomaton,
)
from tab_marl.mission.compile import compile_mission
from tab_marl.mission.english import to_english
from tab_marl.mission.library import MISSIONS
from tab_marl.mission.model import Constraint, ConstraintType, Mission, Place, place_name
from tab_marl.mission.monitor import Monitor
from tab_marl.mission.parse import parse_mission
from tab_marl.mission.syntax_errors import MissionSyntaxError
from tab_marl.mission.unroll import TickAutomaton, unroll

__all__ = [
    "ALWAYS_FORBIDDEN",
    "COMPLETED",
    "FAILED",
    "MISSIONS",
    "NO_BRANCH",
    "UNBOUNDED",
    "AutomatonState",
    "Constraint",
    "ConstraintType",
    "Mission",
    "MissionAutomaton",
    "MissionSyntaxError",
    "Monitor",
    "Place",
    "TickAutomaton",
    "compile_mission",
    "parse_mission",
    "place_name",
    "to_english",
    "unroll",
]
