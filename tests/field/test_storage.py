"""Fields on disk: the same field comes back, damage and malice are named, nothing is executed."""

from __future__ import annotations

import io
import json
import pickle
import zipfile

import numpy as np
import pytest

from tab_marl.field import FieldOptions, FieldProblem, Passes, SoftConstraint, TabField
from tab_marl.field.answers import storage
from tab_marl.field.answers.storage import FieldFormatError
from tab_marl.mission import Constraint, Mission
from tab_marl.world.scenario import Scenario

MISSION = Mission((Constraint("deadline", ("Checkpoint A", "Checkpoint C"), seconds=5),))


def small(scenario, *constraints, **options) -> FieldProblem:
    return FieldProblem.from_mission(
        MISSION, scenario, FieldOptions(headings=4, cell_metres=1.0, **options), constraints=constraints
    )


@pytest.fixture
def saved(tmp_path, tiny_scenario):
    from tab_marl.field import solve

    field = solve(small(tiny_scenario(), SoftConstraint(Passes("central zone"), 0.4)))
    field.save(tmp_path / "field.npz")
    return field, tmp_path / "field.npz"


def same(a: TabField, b: TabField) -> None:
    for name in ("occupancy", "automaton_occupancy", "completion_probability", "transitions"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert a.kl_to_reference == b.kl_to_reference and a.log_partition == b.log_partition
    assert a.path_entropy == b.path_entropy and a.report == b.report
    assert a.branch_visits == b.branch_visits
    for x, y in zip(a.stage_times.items(), b.stage_times.items(), strict=True):
        assert x[0] == y[0]
        np.testing.assert_array_equal(x[1], y[1])
    paths = [f.sample(np.random.default_rng(0), 20).positions for f in (a, b)]
    np.testing.assert_array_equal(*paths)


def test_the_same_field_comes_back(saved):
    field, path = saved
    again = TabField.load(path)
    same(field, again)
    assert again.problem.scenario == field.problem.scenario and again.problem.mission == MISSION
    assert again.event_probabilities == field.event_probabilities
    assert again.probability(Passes("Checkpoint B")) == field.probability(Passes("Checkpoint B"))
    np.testing.assert_array_equal(again.problem.grid.centres, field.problem.grid.centres)


def test_raw_problems_and_fitted_goal_marginals(tmp_path, tiny_scenario):
    from tab_marl.field import solve

    given = small(tiny_scenario(), precision="double")
    bare = FieldProblem(
        given.reference, given.labels, given.automaton, given.start, given.horizon, given.options, given.reference_of
    )
    for problem in (given, bare):
        field = solve(problem)
        field.save(tmp_path / "raw.npz")
        same(field, TabField.load(tmp_path / "raw.npz"))


def test_the_file_holds_numbers_and_json_only(saved):
    _, path = saved
    with np.load(path, allow_pickle=False) as file:
        header = json.loads(file["header"].tobytes())
        assert {file[name].dtype.kind for name in file.files} <= set("biuf")
    assert header["format"] == "tab_marl.field" and header["version"] == 1


def rewritten(path, changes: dict[str, object], header: dict | None = None):
    """The file with some arrays replaced (None: left out) and header entries changed."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    text = json.loads(arrays.pop("header").tobytes()) | (header or {})
    arrays |= changes
    kept = {name: array for name, array in arrays.items() if array is not None}
    other = path.with_name("other.npz")
    np.savez(other, header=np.frombuffer(json.dumps(text).encode(), np.uint8), **kept)
    return other


@pytest.mark.parametrize(
    ("changes", "header", "says"),
    [
        ({}, {"version": 2}, "has version 2, this program reads version 1"),
        ({}, {"format": "other"}, "is not a field file"),
        ({}, {"options": {"reference": "wlk"}}, "did you mean 'walk'"),
        ({}, {"options": {"colour": "red"}}, "colour"),
        ({}, {"absorbing": [0, 999, 1]}, "999 is no state"),
        ({}, {"horizon": -1}, "horizon is -1"),
        ({}, {"scenario": {"name": "x", "os": "rm"}}, "not a valid field"),
        ({}, {"world": "os.system"}, "os.system"),
        ({"weights": None}, {}, "the part 'weights' is missing"),
        ({"weights": np.zeros((2, 2))}, {}, "weights: is float64"),
        ({"weights": np.array(["x"])}, {}, "only numbers are read"),
        ({"reference.indices": "far"}, {}, "reference.indices: has entries"),
        ({"reference.data": "large"}, {}, "does not sum to 1"),
        ({"reference.indptr": "falling"}, {}, "must rise from 0"),
        ({"automaton.delta": "far"}, {}, "automaton.delta: has entries"),
        ({"problem.labels": "far"}, {}, "problem.labels: has entries"),
        ({"problem.start": "large"}, {}, "sums to"),
        ({"grid.row": "far"}, {}, "grid.row: has entries"),
        ({"automaton.branch": "far"}, {}, "automaton.branch: has entries"),
    ],
)
def test_damage_is_named(saved, changes, header, says):
    _, path = saved
    with np.load(path) as file:
        for name, how in changes.items():
            if isinstance(how, str):
                array = file[name].copy()
                if how == "far":
                    array.flat[0] = 10_000
                elif how == "large":
                    array = array * 5
                else:
                    array[1] = -3
                changes[name] = array
    with pytest.raises(FieldFormatError, match=says) as error:
        TabField.load(rewritten(path, dict(changes), header))
    assert "other.npz" in str(error.value) and "\n" not in str(error.value)


class Trap:
    """Would run when unpickled."""

    def __reduce__(self):
        return (exec, ("raise SystemExit('executed')",))


def test_nothing_in_a_file_is_executed(tmp_path):
    trap = np.array([Trap()], dtype=object)
    held = io.BytesIO()
    np.lib.format.write_array(held, trap, allow_pickle=True)
    with zipfile.ZipFile(tmp_path / "trap.npz", "w") as archive:
        archive.writestr("header.npy", held.getvalue())
    with pytest.raises(FieldFormatError, match="only numbers are read"):
        TabField.load(tmp_path / "trap.npz")
    (tmp_path / "plain.npz").write_bytes(pickle.dumps(Trap()))
    with pytest.raises(FieldFormatError, match="not a field file"):
        TabField.load(tmp_path / "plain.npz")


def test_claims_larger_than_the_file_are_refused_before_memory_is_taken(tmp_path, saved, monkeypatch):
    _, path = saved
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (10**14,)})
    with zipfile.ZipFile(tmp_path / "huge.npz", "w") as archive:
        archive.writestr("weights.npy", head.getvalue())
    with pytest.raises(FieldFormatError, match="claims 800000000000000 bytes"):
        TabField.load(tmp_path / "huge.npz")
    monkeypatch.setattr(storage, "MOST_BYTES", 1000)
    with pytest.raises(FieldFormatError, match="more than the 1e\\+03 allowed"):
        TabField.load(path)
    cut = tmp_path / "cut.npz"
    cut.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(FieldFormatError, match="not a field file"):
        TabField.load(cut)
    with pytest.raises(FileNotFoundError):
        TabField.load(tmp_path / "none.npz")


def test_a_preset_scenario_survives(tmp_path):
    scenario = Scenario.preset("reef")
    world = storage._plain(scenario)
    assert storage.TypeAdapter(Scenario).validate_python(json.loads(json.dumps(world))) == scenario
