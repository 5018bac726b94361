"""Missions: constraint tuples, their English, the timed automaton behind them, and whether they can be done.

A mission (`Mission`, the paper's ordered tuples of eq. 1) comes from English (`parse_mission`), TOML or JSON, or Python;
`compile_mission` gives its automaton, `Monitor` steps that on positions, `unroll` makes it finite for the field.
"""

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
from tab_marl.mission.feasibility import check_feasible
from tab_marl.mission.finite import FiniteAutomaton
from tab_marl.mission.impossible import InfeasibleMission
from tab_marl.mission.joint import JointAutomaton, compile_joint, conjunction
from tab_marl.mission.library import MISSIONS
from tab_marl.mission.model import Constraint, ConstraintType, Mission, Place, place_name
from tab_marl.mission.monitor import Monitor
from tab_marl.mission.parse import parse_mission
from tab_marl.mission.places import MissionWorld
from tab_marl.mission.route import RouteField, solve_route
from tab_marl.mission.serialise import (
    MissionFormatError,
    load_mission,
    mission_from_json,
    mission_from_toml,
    mission_to_json,
    mission_to_toml,
)
from tab_marl.mission.syntax_errors import MissionSyntaxError
from tab_marl.mission.unroll import AutomatonTooLarge, TickAutomaton, unroll

__all__ = [
    "ALWAYS_FORBIDDEN",
    "COMPLETED",
    "FAILED",
    "MISSIONS",
    "NO_BRANCH",
    "UNBOUNDED",
    "AutomatonState",
    "AutomatonTooLarge",
    "Constraint",
    "ConstraintType",
    "FiniteAutomaton",
    "InfeasibleMission",
    "JointAutomaton",
    "Mission",
    "MissionAutomaton",
    "MissionFormatError",
    "MissionSyntaxError",
    "MissionWorld",
    "Monitor",
    "Place",
    "RouteField",
    "TickAutomaton",
    "check_feasible",
    "compile_joint",
    "compile_mission",
    "conjunction",
    "load_mission",
    "mission_from_json",
    "mission_from_toml",
    "mission_to_json",
    "mission_to_toml",
    "parse_mission",
    "place_name",
    "solve_route",
    "to_english",
    "unroll",
]
