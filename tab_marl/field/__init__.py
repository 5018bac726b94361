"""The TAB-Field: the maximum-entropy distribution over trajectories that complete a mission, and its exact filter."""

from tab_marl.field.belief import BeliefOptions, ProductBelief
from tab_marl.field.chain import ProductChain, product_chain
from tab_marl.field.problem import FieldOptions, FieldProblem
from tab_marl.field.processes import paper_walk, run_and_tumble, walk
from tab_marl.field.reference import Reference, from_matrices
from tab_marl.field.sampling import Trajectories, sample_paths
from tab_marl.field.solve import InfeasibleField, solve
from tab_marl.field.tab_field import TabField

__all__ = [
    "BeliefOptions",
    "FieldOptions",
    "FieldProblem",
    "InfeasibleField",
    "ProductBelief",
    "ProductChain",
    "Reference",
    "TabField",
    "Trajectories",
    "from_matrices",
    "paper_walk",
    "product_chain",
    "run_and_tumble",
    "sample_paths",
    "solve",
    "walk",
]
