"""Online POMDP planning for any generative model, and the models that make it an interceptor.

`Pomcp`, `Despot` and `Pomcpow` plan; `CompiledModel`, `ContinuousModel`, `table_model` and `PythonModel` (see
`tab_marl.planning.model`) say in what. docs/planning/engine.md tells how it fits together.
"""

from __future__ import annotations

from tab_marl.planning.beliefs.belief import BeliefDepleted, update_particles
from tab_marl.planning.beliefs.exact_filter import ExactFilter
from tab_marl.planning.beliefs.filter_report import BeliefWarning, FilterReport, ImpossibleObservation
from tab_marl.planning.beliefs.particle_filter import FilterOptions, ParticleFilter
from tab_marl.planning.cycle import Game, play
from tab_marl.planning.model import (
    CompiledModel,
    ContinuousModel,
    Particles,
    PlainPythonWarning,
    PythonModel,
    StateRange,
)
from tab_marl.planning.search.despot import Despot, DespotOptions
from tab_marl.planning.search.explanation import Explanation
from tab_marl.planning.search.plan import Plan, Planner
from tab_marl.planning.search.pomcp import START, Pomcp, PomcpOptions
from tab_marl.planning.search.pomcpow import Pomcpow, PomcpowOptions
from tab_marl.planning.search.tree import SearchTree
from tab_marl.planning.tables import table_model

__all__ = [
    "START",
    "BeliefDepleted",
    "BeliefWarning",
    "CompiledModel",
    "ContinuousModel",
    "Despot",
    "DespotOptions",
    "ExactFilter",
    "Explanation",
    "FilterOptions",
    "FilterReport",
    "Game",
    "ImpossibleObservation",
    "ParticleFilter",
    "Particles",
    "PlainPythonWarning",
    "Plan",
    "Planner",
    "Pomcp",
    "PomcpOptions",
    "Pomcpow",
    "PomcpowOptions",
    "PythonModel",
    "SearchTree",
    "StateRange",
    "play",
    "table_model",
    "update_particles",
]
