"""The TAB-Field: the maximum-entropy distribution over trajectories that complete a mission, and its exact filter."""

from tab_marl.field.answers.evidence import ImpossibleEvidence, Likelihood, NearZeroEvidence, Observation, Seen, Unseen
from tab_marl.field.answers.paths import MostLikelyPath
from tab_marl.field.answers.posterior import Posterior
from tab_marl.field.belief import BeliefOptions, ProductBelief
from tab_marl.field.chain import ProductChain, product_chain
from tab_marl.field.constraints.contradiction import ContradictoryConstraints
from tab_marl.field.constraints.events import Completes, IsAt, Passes, SoftConstraint, TimingPrior, Tracker
from tab_marl.field.constraints.report import ConstraintFit, FitReport
from tab_marl.field.infeasible import InfeasibleField
from tab_marl.field.problem import FieldOptions, FieldProblem
from tab_marl.field.processes import (
    drive_and_turn,
    paper_walk,
    reference_from_simulator,
    reference_from_trajectories,
    run_and_tumble,
    unicycle,
    walk,
)
from tab_marl.field.reference import Reference, from_matrices
from tab_marl.field.sampling import Trajectories, sample_paths
from tab_marl.field.sizing import FieldSize, FieldTooLarge
from tab_marl.field.solve import solve
from tab_marl.field.tab_field import TabField

__all__ = [
    "BeliefOptions",
    "Completes",
    "ConstraintFit",
    "ContradictoryConstraints",
    "FieldOptions",
    "FieldProblem",
    "FieldSize",
    "FieldTooLarge",
    "FitReport",
    "ImpossibleEvidence",
    "InfeasibleField",
    "IsAt",
    "Likelihood",
    "MostLikelyPath",
    "NearZeroEvidence",
    "Observation",
    "Passes",
    "Posterior",
    "ProductBelief",
    "ProductChain",
    "Reference",
    "Seen",
    "SoftConstraint",
    "TabField",
    "TimingPrior",
    "Tracker",
    "Trajectories",
    "Unseen",
    "drive_and_turn",
    "from_matrices",
    "paper_walk",
    "product_chain",
    "reference_from_simulator",
    "reference_from_trajectories",
    "run_and_tumble",
    "sample_paths",
    "solve",
    "unicycle",
    "walk",
]
