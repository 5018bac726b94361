"""TOML and JSON in and out, and what a broken file is answered with."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest
from mission_oracle import KINDS, random_mission

from tab_marl.mission.model import Constraint, Mission
from tab_marl.mission.serialise import (
    MissionFormatError,
    load_mission,
    mission_from_json,
    mission_from_toml,
    mission_to_json,
    mission_to_toml,
)
from tab_marl.world.scenario import Scenario

LAB = Scenario.preset("lab")


@pytest.mark.parametrize("kind", KINDS)
def test_reading_undoes_writing(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    for _ in range(10):
        mission = Mission(random_mission(rng, kind).constraints, name=f"a {kind} mission")
        for text, read in (
            (mission_to_toml(mission), mission_from_toml),
            (mission_to_json(mission), mission_from_json),
        ):
            back = read(text)
            assert back == mission
            assert back.name == mission.name


def test_the_file_is_plain_and_short():
    mission = Mission((Constraint("deadline", ("Checkpoint A", (1.0, 2.5)), 5.0),))  # type: ignore[arg-type]
    expected = {"constraints": [{"type": "deadline", "places": ["Checkpoint A", [1.0, 2.5]], "seconds": 5.0}]}
    assert json.loads(mission_to_json(mission)) == expected
    assert tomllib.loads(mission_to_toml(mission)) == expected


HEAD = '[[constraints]]\ntype = "deadline"\nplaces = ["A"]\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("constraints = ", "^not TOML: .*"),
        ("", "^constraints: missing, must be given"),
        ("constraints = 5", "^constraints: is 5, must be a list of constraint tables"),
        ("constraints = []", "Mission.constraints is empty, must hold at least one constraint"),
        (HEAD, r"^constraints\[0\]: deadline constraint: seconds is None, must be given"),
        (HEAD + 'seconds = "soon"', r"^constraints\[0\].seconds: is 'soon', must be a valid number"),
        (HEAD + "seconds = -1", r"seconds is -1.0, must be a finite number > 0"),
        (HEAD + "secnds = 5", r"constraints\[0\].secnds: no such field, did you mean 'seconds'\?"),
        (HEAD + "seconds = 5\ndifferent = 1.5", r"^constraints\[0\].different: is 1.5, must be a valid integer"),
        (HEAD + 'seconds = 5\nsince = "now"', r"since: is 'now', must be 'start' or 'previous'"),
        (HEAD.replace("deadline", "deadlin"), r"type: is 'deadlin', must be one of exact, deadline, until, eventually"),
        (HEAD.replace('["A"]', '"A"') + "seconds = 5", r"places: is 'A', must be a list of region names and points"),
        (HEAD.replace('["A"]', '["A", 5]') + "seconds = 5", r"^constraints\[0\].places\[1\]: is 5, must be a region's"),
        (
            HEAD.replace('["A"]', '["A", [1.0]]') + "seconds = 5",
            r"^constraints\[0\].places\[1\]: is .*1.0.*, must be a",
        ),
        (HEAD + "seconds = 5\n[extra]\nx = 1", r"^extra: no such field"),
    ],
)
def test_errors_name_field_value_and_remedy(text, message):
    with pytest.raises(MissionFormatError, match=message):
        mission_from_toml(text)


def test_several_errors_are_told_at_once():
    with pytest.raises(MissionFormatError) as caught:
        mission_from_json('{"constraints": [{"type": "later", "places": ["A"], "avoid": 7}]}')
    assert "constraints[0].type" in str(caught.value)
    assert "constraints[0].avoid" in str(caught.value)


def test_load_by_ending(tmp_path):
    mission = Mission((Constraint("deadline", ("Checkpoint A",), 5.0),))  # type: ignore[arg-type]
    (tmp_path / "m.toml").write_text(mission_to_toml(mission))
    (tmp_path / "m.json").write_text(mission_to_json(mission))
    (tmp_path / "m.txt").write_text("Reach Checkpoint A within 5s\n")
    for name in ("m.toml", "m.json", "m.txt"):
        assert load_mission(tmp_path / name, LAB) == mission
    (tmp_path / "m.yaml").write_text("")
    with pytest.raises(MissionFormatError, match=r"ends in '.yaml', must be one of .toml, .json, .txt"):
        load_mission(tmp_path / "m.yaml", LAB)
    (tmp_path / "bad.json").write_bytes(b"\xff\xfe")
    with pytest.raises(MissionFormatError, match="not a text file in UTF-8"):
        load_mission(tmp_path / "bad.json", LAB)
    (tmp_path / "bad.txt").write_text("Reach Checkpiont A")
    with pytest.raises(MissionFormatError, match=r"bad.txt: .*(?s:.*)did you mean 'Checkpoint A'"):
        load_mission(tmp_path / "bad.txt", LAB)
