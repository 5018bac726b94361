"""What the monitor tells people: time left, progress, and why a mission failed."""

from __future__ import annotations

import math

import pytest

from tab_marl.mission.monitor import Monitor
from tab_marl.mission.parse import parse_mission
from tab_marl.world.scenario import Scenario

OPEN = Scenario.preset("open")
A, B, D = (0.5, 2.5), (2.5, 2.45), (1.5, 1.5)
OUT = (0.3, 1.4)


def failed(text, points, speed=None, tick=0.1):
    monitor = Monitor(parse_mission(text, OPEN), OPEN, tick)
    monitor.reset(points[0])
    for point in points[1:]:
        monitor.step(point, speed)
    assert monitor.status == "failed"
    return monitor.why_failed


@pytest.mark.parametrize(
    ("text", "points", "why"),
    [
        ("Reach Checkpoint A while avoiding the center", [OUT] * 32 + [D], "entered the central zone at 3.2 s"),
        ("Reach Checkpoint A while avoiding the center", [D], "began inside the central zone at 0 s"),
        ("Reach Checkpoint A within 5s", [OUT] * 52, "missed Checkpoint A: deadline 5 s"),
        ("Reach Checkpoint A, then Checkpoint B within 5s", [OUT] * 52, "missed Checkpoint B: deadline 5 s"),
        (
            "Reach Checkpoint A in exactly 5s",
            [OUT] * 20 + [A],
            "entered Checkpoint A at 2 s, before its time window opened at 4.5 s",
        ),
        ("Reach Checkpoint A in exactly 5s", [OUT] * 60, "missed Checkpoint A: time window closed at 5.5 s"),
        (
            "Reach Checkpoint A every 2s",
            [A] + [OUT] * 30,
            "missed Checkpoint A (visit 2 of 3): at most 2 s after the previous visit",
        ),
        ("Reach Checkpoint A every 2s", [OUT] * 30, "missed Checkpoint A (visit 1 of 3): at most 2 s after the start"),
        (
            "Reach Checkpoint A, then Checkpoint B within 2s after the previous goal",
            [A] + [OUT] * 30,
            "missed Checkpoint B: at most 2 s after the previous goal",
        ),
        ("Reach Checkpoint B while staying in the left half", [OUT, B], "left the left half at 0.1 s"),
        ("Reach Checkpoint B without entering the center", [OUT, OUT, D], "entered the central zone at 0.2 s"),
        (
            "Reach Checkpoint A, then Checkpoint B, while avoiding the center until 1s and avoiding Checkpoint D",
            [A] + [OUT] * 20 + [D],
            "entered Checkpoint D at 2.1 s",
        ),
    ],
)
def test_why_it_failed(text, points, why):
    assert failed(text, points) == why


def test_the_speed_limit_is_checked_where_speeds_are_given():
    text = "Reach Checkpoint A no faster than 0.1 m/s, then Checkpoint B"
    assert failed(text, [OUT, OUT], speed=0.2) == "drove 0.20 m/s at 0.1 s, where at most 0.1 m/s is allowed"
    monitor = Monitor(parse_mission(text, OPEN), OPEN, 0.1)
    monitor.reset(OUT)
    assert monitor.speed_limit == 0.1
    assert monitor.step(OUT, 0.101) == "active"  # a body overshoots a little
    assert monitor.step(A, 0.1) == "active"
    assert monitor.speed_limit == math.inf
    assert monitor.step(B, 0.2) == "completed"


def test_progress_and_time_left():
    monitor = Monitor(parse_mission("Reach Checkpoint A within 5s, then Checkpoint B within 9s", OPEN), OPEN, 0.5)
    monitor.reset(OUT)
    assert monitor.progress == (0, 2)
    assert monitor.seconds_left == 5.0
    monitor.step(OUT)
    assert monitor.seconds_left == 4.5
    assert monitor.clocks == (1, 1, 1)
    monitor.step(A)
    assert monitor.progress == (1, 2)
    assert monitor.seconds_left == 8.0
    assert monitor.clocks == (2, 0, 0)
    assert monitor.step(B) == "completed"
    assert monitor.progress == (2, 2)
    assert monitor.seconds_left == 0.0
    assert monitor.step(OUT) == "completed"  # stays so
    assert monitor.reset(OUT) == "active"
    assert monitor.progress == (0, 2)


def test_no_bound_is_an_infinite_time_left():
    monitor = Monitor(parse_mission("Reach Checkpoint A", OPEN), OPEN, 0.5)
    monitor.reset(OUT)
    assert monitor.seconds_left == math.inf


def test_misuse():
    mission = parse_mission("Reach Checkpoint A", OPEN)
    monitor = Monitor(mission, OPEN, 0.5)
    with pytest.raises(RuntimeError, match=r"before Monitor.reset"):
        monitor.step(OUT)
    with pytest.raises(ValueError, match=r"tick_seconds is 0.5, must equal the monitor's 0.1"):
        Monitor(mission, OPEN, 0.1, monitor.automaton)
