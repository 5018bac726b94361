"""The torch backend gives the compiled kernels' numbers (here on the CPU; no GPU has been tried)."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from tab_marl.field import FieldOptions, FieldProblem, SoftConstraint, solve
from tab_marl.field.constraints.events import Passes
from tab_marl.mission import Constraint, Mission
from tab_marl.world.scenario import Scenario

MISSION = Mission(
    (
        Constraint("deadline", ("Checkpoint A", "Checkpoint C"), seconds=12.0),
        Constraint("eventually", ("top right",), speed_limit=0.1),
    )
)


@pytest.mark.parametrize(
    ("reference", "options"),
    [
        ("walk", {}),
        ("run_and_tumble", {"headings": 8}),
        ("walk", {"goal_marginals": True}),
        ("run_and_tumble", {"headings": 8, "completion_probability": 0.8}),
    ],
)
def test_same_numbers(reference, options):
    settings = {
        "cell_metres": 0.25,
        "precision": "double",
        "goal_marginals": False,
        "marginal_tolerance": 1e-6,
    } | options
    problem = FieldProblem.from_mission(MISSION, Scenario.preset("lab"), FieldOptions(reference=reference, **settings))
    assert problem.reference.count == 2  # two speeds
    compiled, torch = solve(problem), solve(problem, backend="torch", device="cpu")
    assert torch.log_partition == pytest.approx(compiled.log_partition, abs=1e-11)
    assert torch.kl_to_reference == pytest.approx(compiled.kl_to_reference, abs=1e-9)
    np.testing.assert_allclose(torch.occupancy, compiled.occupancy, rtol=0, atol=1e-12)
    np.testing.assert_allclose(torch.bridge.log_scale[:-1], compiled.bridge.log_scale[:-1], rtol=1e-12)


def test_soft_constraints_too(tiny_scenario):
    mission = Mission((Constraint("deadline", ("Checkpoint A",), seconds=4),))
    problem = FieldProblem.from_mission(
        mission, tiny_scenario(), FieldOptions(cell_metres=1.0, reference="walk", precision="double"),
    ).constrained(SoftConstraint(Passes("Checkpoint C"), 0.3))  # fmt: skip
    compiled, torch = solve(problem), solve(problem, backend="torch")
    assert torch.kl_to_reference == pytest.approx(compiled.kl_to_reference, abs=1e-6)


def test_what_is_not_there_is_named(monkeypatch, tiny_scenario):
    mission = Mission((Constraint("deadline", ("Checkpoint A",), seconds=4),))
    problem = FieldProblem.from_mission(mission, tiny_scenario(), FieldOptions(cell_metres=1.0, reference="walk"))
    with pytest.raises(KeyError, match=r"backend.*jax.*numba"):
        solve(problem, backend="jax")
    with pytest.raises(ValueError, match="device is 'cuda': compiled code runs on \"cpu\" only"):
        solve(problem, device="cuda")
    with pytest.raises(ValueError, match=r"device is 'nosuch', which PyTorch cannot use here .*there is: \['cpu'"):
        solve(problem, backend="torch", device="nosuch")
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ValueError, match="needs PyTorch, which is not installed: pip install torch"):
        solve(problem, backend="torch")
