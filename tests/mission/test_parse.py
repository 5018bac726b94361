"""The English of missions: what the paper's texts mean, that printing is undone by parsing, and what errors say."""

from __future__ import annotations

import numpy as np
import pytest
from mission_oracle import KINDS, random_mission

from tab_marl.mission.english import to_english
from tab_marl.mission.library import MISSIONS
from tab_marl.mission.model import Constraint, ConstraintType, Mission
from tab_marl.mission.parse import _parser, parse_mission
from tab_marl.mission.syntax_errors import MissionSyntaxError
from tab_marl.world.scenario import Scenario

LAB = Scenario.preset("lab")
REEF = Scenario.preset("reef")
TARGET = (1.2, 2.4)
EXACT, DEADLINE, UNTIL, EVENTUALLY, ALWAYS = (
    ConstraintType.EXACT, ConstraintType.DEADLINE, ConstraintType.UNTIL, ConstraintType.EVENTUALLY,
    ConstraintType.ALWAYS,
)  # fmt: skip
A, B, C, D, E = (f"Checkpoint {letter}" for letter in "ABCDE")
ALL = (A, B, C, D, E)

MEANINGS = {
    "M1": [Constraint(DEADLINE, (A,), 5.0)],
    "M2": [Constraint(EVENTUALLY, (A,)), Constraint(EXACT, (B,), 5.0)],
    "M3": [Constraint(DEADLINE, (A,), 5.0, recurrences=3)],
    "M4": [Constraint(EVENTUALLY, (A,)), Constraint(ALWAYS, ("central zone",), avoid=True)],
    "M5": [
        Constraint(EVENTUALLY, ALL, different=3, max_gap_seconds=10.0),
        Constraint(EVENTUALLY, (TARGET,), max_gap_seconds=10.0),
        Constraint(ALWAYS, ("central zone",), avoid=True),
    ],
    "U5": [Constraint(EVENTUALLY, (p,), max_gap_seconds=30.0) for p in (A, B, C, "corals")],
    "a": [
        *(Constraint(DEADLINE, (p,), 7.0, since="previous") for p in (C, B, A)), Constraint(EVENTUALLY, ("top right",)),
    ],
    "b": [
        Constraint(EVENTUALLY, ALL), Constraint(DEADLINE, ("bottom right",), 50.0),
        Constraint(ALWAYS, ("central zone",), avoid=True),
    ],
    "c": [Constraint(EXACT, (A,), 5.0), Constraint(DEADLINE, (B,), 10.0)],
    "d": [Constraint(DEADLINE, ALL, 10.0, recurrences=3), Constraint(ALWAYS, ("right half",), avoid=True)],
    "e": [
        Constraint(EXACT, ALL, 10.0, different=3, recurrences=3, including=(D,)),
        Constraint(EVENTUALLY, ("bottom right",)),
    ],
    "f": [
        Constraint(DEADLINE, ("top right", *ALL), 40.0, different=2, including=("top right",)),
        Constraint(DEADLINE, ("central zone",), 80.0),
    ],
}  # fmt: skip

PRINTED = {
    "M5": (
        "Reach target [1.2, 2.4] after visiting any three different checkpoints, taking no more than 10s between "
        "checkpoints, while avoiding the central zone"
    ),
    "U5": (
        "Reach the corals after visiting Checkpoint A, Checkpoint B and Checkpoint C in order, taking no more than "
        "30s between checkpoints"
    ),
    "a": "Reach Checkpoint C, then Checkpoint B, then Checkpoint A, each within 7s, and end at the top right",
    "b": "Visit any checkpoint, and end at the bottom right within 50s, while avoiding the central zone",
    "c": "Reach Checkpoint A in exactly 5s, then Checkpoint B within 10s",
    "d": "Visit any checkpoint every 10s while avoiding the right half",
    "e": "Visit any three different checkpoints including Checkpoint D, exactly every 10s, and end at the bottom right",
    "f": ("Visit the top right and another checkpoint in any order within 40s, and end at the central zone within 80s"),
}


def scenario_of(mission_id):
    return REEF if mission_id == "U5" else LAB


@pytest.mark.parametrize("mission_id", MISSIONS)
def test_the_papers_texts_mean_what_they_say(mission_id):
    scenario = scenario_of(mission_id)
    mission = parse_mission(MISSIONS[mission_id], scenario, target=TARGET, name=mission_id)
    assert mission == Mission(tuple(MEANINGS[mission_id]))
    assert mission.name == mission_id


@pytest.mark.parametrize("mission_id", MISSIONS)
def test_the_papers_texts_print_back(mission_id):
    scenario = scenario_of(mission_id)
    mission = Mission(tuple(MEANINGS[mission_id]))
    printed = to_english(mission, scenario)
    assert printed == PRINTED.get(mission_id, MISSIONS[mission_id])
    assert parse_mission(printed, scenario) == mission
    assert parse_mission(to_english(mission), scenario) == mission


@pytest.mark.parametrize("kind", KINDS)
def test_parsing_undoes_printing(kind):
    rng = np.random.default_rng(KINDS.index(kind) + 100)
    for _ in range(4 if kind != "mixed" else 30):
        mission = random_mission(rng, kind)
        for scenario in (None, LAB):
            printed = to_english(mission, scenario)
            assert parse_mission(printed, LAB) == mission, printed


def test_no_text_can_be_read_in_two_ways():
    parser = _parser(tuple(sorted(LAB.spellings())), "explicit")
    rng = np.random.default_rng(5)
    texts = [text for mission_id, text in MISSIONS.items() if mission_id != "U5"]
    texts += [to_english(random_mission(rng), LAB) for _ in range(20)]
    for text in texts:
        assert not list(parser.parse(text).find_data("_ambig")), text


@pytest.mark.parametrize(
    ("text", "constraints"),
    [
        ("reach checkpoint a WITHIN 5 seconds.", [Constraint(DEADLINE, (A,), 5.0)]),
        ("Go to the   center of the environment in at most 2.5 s", [Constraint(DEADLINE, ("central zone",), 2.5)]),
        ("Visit A and B", None),
        ("Visit Checkpoint A or Checkpoint B within 9s", [Constraint(DEADLINE, (A, B), 9.0)]),
        (
            "Visit two different of Checkpoint A, Checkpoint B and the top right",
            [Constraint(EVENTUALLY, (A, B, "top right"), different=2)],
        ),
        (
            "Visit any two different of the checkpoints and the top right including the top right",
            [Constraint(EVENTUALLY, (*ALL, "top right"), different=2, including=("top right",))],
        ),
        ("Reach Checkpoint A every 5s four times", [Constraint(DEADLINE, (A,), 5.0, recurrences=4)]),
        ("Reach Checkpoint A exactly every 5s, twice", [Constraint(EXACT, (A,), 5.0, recurrences=2)]),
        ("Reach Checkpoint A present at exactly 5s", [Constraint(EXACT, (A,), 5.0, presence=True)]),
        (
            "Reach Checkpoint A no faster than 0.1 m/s without entering the left half or the top left, then (1, 2)",
            [
                Constraint(EVENTUALLY, (A,), speed_limit=0.1, restricted=("left half", "top left")),
                Constraint(EVENTUALLY, ((1.0, 2.0),)),
            ],
        ),
        ("Reach A, then B", None),
        (
            "Visit checkpoints C and E in order",
            [Constraint(EVENTUALLY, (C,)), Constraint(EVENTUALLY, (E,))],
        ),
        (
            "Stay in the left half until 10s and never go faster than 0.1 m/s",
            [Constraint(UNTIL, ("left half",), 10.0), Constraint(ALWAYS, speed_limit=0.1)],
        ),
        ("Always avoid the centre", [Constraint(ALWAYS, ("central zone",), avoid=True)]),
        (
            "Reach Checkpoint A, then Checkpoint B, while avoiding the center until Checkpoint A is reached",
            [
                Constraint(EVENTUALLY, (A,)), Constraint(EVENTUALLY, (B,)),
                Constraint(UNTIL, ("central zone",), avoid=True, until_goal=0),
            ],
        ),
        (
            "Reach Checkpoint A while staying out of the center for the first 4s",
            [Constraint(EVENTUALLY, (A,)), Constraint(UNTIL, ("central zone",), 4.0, avoid=True)],
        ),
    ],
)  # fmt: skip
def test_other_ways_to_say_it(text, constraints):
    if constraints is None:
        with pytest.raises(MissionSyntaxError):
            parse_mission(text, LAB)
    else:
        assert parse_mission(text, LAB) == Mission(tuple(constraints))


@pytest.mark.parametrize(
    ("text", "column", "expected", "suggestion"),
    [
        ("Reach Checkpiont A within 5s", 7, "a place", "Checkpoint A"),
        ("Reach Checkpoint A withn 5s", 20, "a time such as 'within 5s'", "within"),
        ("Reach Checkpoint A while avoiding the centrl zone", 39, "a place", "central zone"),
        ("Reech Checkpoint A", 1, "'Reach'", "Reach"),
        ("Reach Checkpoint A within 5", 28, "'seconds'", None),
        ("Reach Checkpoint A within", 26, "a number", None),
        ("Visit any three diferent checkpoints", 17, "'different'", "different"),
        ("Reach Checkpoint A and Checkpoint B", 36, "'in any order'", None),
        ("Reach Checkpoint A; then stop", 19, "'then'", "then"),
    ],
)
def test_a_text_that_does_not_parse_says_where_and_what(text, column, expected, suggestion):
    with pytest.raises(MissionSyntaxError) as caught:
        parse_mission(text, LAB)
    error = caught.value
    assert error.column == column
    assert expected in error.expected
    assert error.suggestion == suggestion
    lines = str(error).splitlines()
    assert lines[1] == f"  {text}"
    assert lines[2].index("^") == column + 1  # the text is indented by two
    if suggestion is not None:
        assert f"did you mean {suggestion!r}?" in lines[3]


def test_an_unknown_place_lists_what_is_near():
    with pytest.raises(MissionSyntaxError, match=r"\"Checkpoint Z\": did you mean 'Checkpoint A' or 'Checkpoint B'"):
        parse_mission("Reach Checkpoint Z", LAB)
    with pytest.raises(MissionSyntaxError, match=r"known places: Checkpoint A, .*central zone"):
        parse_mission("Reach Xanadu", LAB)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the mission's text is empty"),
        ("Reach target [x, y]", r"write its coordinates in metres, e.g. \[1.2, 2.4\]"),
        ("Reach [9, 9]", r"target \[9, 9\] lies outside the 3.0 x 3.0 m arena"),
        ("Reach Checkpoint A within 5s in exactly 7s", "already has a time"),
        ("Reach Checkpoint A within 0s", "seconds is 0.0, must be a finite number > 0"),
        ("Reach Checkpoint A every 5s one times", "1 times: a recurring goal here needs 2 or more"),
        ("Visit checkpoints 1, 9 in order", "no 'checkpoint 9' in this scenario"),
        ("Visit any six different checkpoints", "different is 6, must be <= the number of places, 5"),
        ("Reach Checkpoint A while avoiding the center until goal 2", "there is no goal 2: this mission has 1"),
        (
            "Visit any two different checkpoints including Checkpoint A, Checkpoint B and Checkpoint C",
            "must name at most `different` places, 2",
        ),
    ],
)
def test_a_text_that_parses_but_makes_no_sense(text, message):
    with pytest.raises(MissionSyntaxError, match=message):
        parse_mission(text, LAB)


def test_places_are_those_of_the_scenario():
    assert parse_mission("Reach corals", REEF).constraints[0].places == ("corals",)
    with pytest.raises(MissionSyntaxError, match="known places"):
        parse_mission("Reach corals", LAB)
