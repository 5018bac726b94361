"""Online POMDP planning for any generative model, and the models that make it an interceptor.

`Pomcp` and `Despot` plan; `CompiledModel`, `table_model` and `PythonModel` (see `tab_marl.planning.model`) say in what.
"""

from __future__ import annotations

from tab_marl.planning.belief import BeliefDepleted, update_particles
from tab_marl.planning.despot import Despot, DespotOptions
from tab_marl.planning.model import CompiledModel, Particles, PythonModel
from tab_marl.planning.plan import Plan
from tab_marl.planning.pomcp import Pomcp, PomcpOptions
from tab_marl.planning.tables import table_model
from tab_marl.planning.tree import SearchTree

__all__ = [
    "BeliefDepleted",
    "CompiledModel",
    "Despot",
    "DespotOptions",
    "Particles",
    "Plan",
    "Pomcp",
    "PomcpOptions",
    "PythonModel",
    "SearchTree",
    "table_model",
    "update_particles",
]
