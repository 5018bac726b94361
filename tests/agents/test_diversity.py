"""Figures of behaviour on hand-made ways, sides of obstacles by hand, and a test of styles that can fail."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.distance import jensenshannon

from tab_marl.agents.adversaries import ScriptedAdversary
from tab_marl.agents.measures.diversity import (
    FIGURES,
    SPREAD,
    Behaviour,
    Yardstick,
    behaviour,
    field_samples,
    occupancy_distance,
    own_figure,
    style_test,
)
from tab_marl.agents.measures.homotopy import Sides, winding_number
from tab_marl.agents.measures.rollouts import run_bank
from tab_marl.agents.measures.validation import HeldOut
from tab_marl.agents.training.env import build_bank
from tab_marl.envs.styles import STYLES
from tab_marl.mission import parse_mission
from tab_marl.mission.tasks import Task
from tab_marl.world.regions import Box, Disc
from tab_marl.world.scenario import Scenario

FRESH = 515


def walk(*corners: tuple[float, float], metres: float = 0.022) -> np.ndarray:
    """A path along straight lines, a point per step of 0.1 s at full speed."""
    points = [np.array(corners[:1])]
    for a, b in pairwise(corners):
        n = max(1, round(math.dist(a, b) / metres))
        points.append(np.linspace(a, b, n + 1)[1:])
    return np.concatenate(points)


BETWEEN = Box(1.3, 1.2, 1.7, 1.7)


def task(obstacle: Box = BETWEEN, seconds: float = 30.0) -> Task:
    """From the left to Checkpoint D on the right, a box between; the upper way is a little longer."""
    lab = Scenario.preset("lab")
    far = replace(lab.checkpoints[3], name="Checkpoint D", x=2.6, y=1.4)
    others = tuple(replace(c, y=2.8, x=0.4 + 0.5 * i) for i, c in enumerate(lab.checkpoints) if i != 3)
    scenario = replace(
        lab, checkpoints=(*others, far), obstacles=(obstacle,), adversary_start=Disc(0.4, 1.4, 0.1), horizon_seconds=60.0
    )  # fmt: skip
    return Task(scenario, parse_mission(f"Reach Checkpoint D within {seconds:g}s", scenario), "M1", "point", 2.0)


BELOW = walk((0.4, 1.4), (1.3, 1.0), (1.7, 1.0), (2.6, 1.4))
ABOVE = walk((0.4, 1.4), (1.3, 1.9), (1.7, 1.9), (2.6, 1.4))


def test_winding_numbers() -> None:
    angles = np.linspace(0, 2 * np.pi, 60)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    assert winding_number(ring, np.zeros(2)) == 1 and winding_number(ring[::-1], np.zeros(2)) == -1
    assert winding_number(ring, np.array([3.0, 0.0])) == 0
    assert winding_number(np.concatenate([ring, ring]), np.zeros(2)) == 2


def test_which_side_a_way_takes() -> None:
    """Below the box is shorter; above it is the other side, wherever exactly."""
    sides = Sides(task(), 30.0)
    assert len(sides.two_sided("Checkpoint D")) == 1
    assert sides.took_shortest(BELOW, "Checkpoint D") == 1.0
    assert sides.took_shortest(ABOVE, "Checkpoint D") == 0.0
    round_about = walk((0.4, 1.4), (0.3, 2.6), (2.7, 2.6), (2.6, 1.4))
    assert sides.took_shortest(round_about, "Checkpoint D") == 0.0
    # Goes to the other side, thinks better of it, and comes back.
    back = walk((0.4, 1.4), (1.2, 1.9), (1.0, 1.4), (1.3, 1.0), (1.7, 1.0), (2.6, 1.4))
    assert sides.took_shortest(back, "Checkpoint D") == 1.0


def test_a_contrary_adversary_takes_the_other_side() -> None:
    """Where there is one; the style is in the route, so a script that follows it shows it."""
    y = Yardstick.of(task())
    for name, expected in (("direct", 1.0), ("contrary", 0.0)):
        bank = build_bank([y.task], STYLES[name], 0)
        rollouts = run_bank(ScriptedAdversary(STYLES[name]), bank, np.array([0]), np.random.default_rng(0))
        path = rollouts.positions[0, : rollouts.end[0] + 1].astype(np.float64)
        assert rollouts.completed[0] and y.sides.took_shortest(path, "Checkpoint D") == expected


def test_there_are_no_two_sides_without_room_time_or_reason() -> None:
    wall = task(Box(1.3, 1.2, 1.7, 3.0))
    assert Sides(wall, 30.0).two_sided("Checkpoint D") == [], "the box reaches the wall above"
    assert Sides(task(seconds=12.0), 12.0).two_sided("Checkpoint D") == [], "no time for the longer way"
    aside = task(Box(1.3, 0.2, 1.7, 0.5))
    assert Sides(aside, 30.0).two_sided("Checkpoint D") == [], "the way below would be half as long again"
    assert math.isnan(Sides(wall, 30.0).took_shortest(BELOW, "Checkpoint D"))


def test_figures_of_hand_made_ways() -> None:
    y = Yardstick.of(task())
    below, above = (y.figures(path, 10.0, ("Checkpoint D",)) for path in (BELOW, ABOVE))
    assert (below["shortest side"], above["shortest side"]) == (1.0, 0.0)
    length = np.hypot(*np.diff(ABOVE, axis=0).T).sum()
    # The plain way ends where it enters the disc.
    assert 1.0 < below["length / shortest"] < above["length / shortest"] - 0.02 < 1.1
    assert above["time used / allowed"] == pytest.approx((len(ABOVE) - 1) / 10 / 30, abs=0.01)
    assert above["time used / allowed"] == pytest.approx(length / 0.22 / 30, abs=0.02)
    camera = y.task.scenario.checkpoints[-1].camera_metres
    assert below["seconds in cameras"] == pytest.approx(camera / 0.22, abs=0.3)
    assert below["seconds in other cameras"] == 0.0
    assert math.isnan(below["nearest place first"]), "there is one place only"


def test_choices_are_compared_with_those_of_the_shortest_way() -> None:
    scenario = task().scenario
    mission = parse_mission("Reach any of Checkpoint A or Checkpoint D within 40s", scenario)
    y = Yardstick.of(Task(scenario, mission, "M1", "ambiguous", 2.0))
    nearest = y.shortest_places(np.array([0.4, 1.4]))
    assert nearest == ("Checkpoint A",)
    assert y.figures(walk((0.4, 1.4), (0.4, 2.8)), 10.0, nearest)["nearest place first"] == 1.0
    other = y.figures(BELOW, 10.0, ("Checkpoint D",))
    assert other["nearest place first"] == other["places of the shortest way"] == 0.0


@pytest.fixture(scope="module")
def seen() -> tuple[list[Yardstick], dict[str, Behaviour]]:
    """The scripted follower in several styles on a few tasks."""
    held_out = HeldOut.draw(15, FRESH)
    yardsticks = [Yardstick.of(t) for t in held_out.tasks]
    names = ("direct", "late", "camera-shy", "side", "via", "wander", "fickle", "habits")
    return yardsticks, {n: behaviour(ScriptedAdversary(STYLES[n], n), held_out, yardsticks) for n in names}


def test_every_style_moves_its_own_figure_when_a_script_follows_it(seen) -> None:
    """Styles are in the routes: whoever follows them shows them."""
    _, found = seen
    for name in ("late", "side", "via", "wander", "fickle", "habits"):
        test = style_test(found[name], [found["direct"], found["direct"]], STYLES[name])
        assert test is not None and test.needed == 0.0, name
        assert test.low > 0 and test.counts == (test.success >= 0.9), (name, test)
        assert test.low <= test.moved <= test.high
    assert own_figure(STYLES["direct"]) is None
    assert style_test(found["direct"], [found["late"], found["side"]], STYLES["direct"]) is None


def test_a_style_that_moves_nothing_does_not_count(seen) -> None:
    """Nor one whose figure lies within what two controls differ by, nor one that fails its missions."""
    _, found = seen
    direct, late = found["direct"], found["late"]
    same = style_test(direct, [direct, direct], STYLES["late"])
    assert same is not None and same.moved == 0.0 and not same.counts
    within = style_test(late, [direct, late], STYLES["late"])
    assert within is not None and within.needed > 0.1 and not within.counts
    backwards = style_test(direct, [late, late], STYLES["late"])
    assert backwards is not None and backwards.high < 0 and not backwards.counts
    half = replace(late, completed=np.arange(late.completed.size).reshape(late.completed.shape) % 2 == 0)
    failing = style_test(half, [direct, direct], STYLES["late"])
    assert failing is not None and failing.success < 0.9 and not failing.counts
    with pytest.raises(ValueError, match="1 controls: a style is judged against two or more"):
        style_test(late, [direct], STYLES["late"])


def test_controls_are_judged_by_what_the_style_drew(seen) -> None:
    """A direct way takes the drawn turning sense about half of the time, and hardly any via point."""
    _, found = seen
    drawn = found["side"].figure("side as drawn")
    chance = found["direct"].figure("side as drawn", found["side"])
    assert np.nanmean(drawn) > np.nanmean(chance) + 0.15
    assert np.nanmean(found["direct"].figure("via points reached", found["via"])) < 0.3
    assert np.nanmean(found["via"].figure("via points reached")) > 0.9


def test_figures_are_paired_by_task_and_start(seen) -> None:
    yardsticks, found = seen
    for d in range(2):
        for i in range(len(yardsticks)):
            starts = {tuple(b.paths[d][i][0]) for b in found.values()}
            assert len(starts) == 1
    assert found["direct"].mean("length / shortest") < 1.1 < found["via"].mean("length / shortest")
    assert found["direct"].quantiles("time used / allowed")[2] <= 1.0
    assert np.mean(found["wander"].figure(SPREAD)) > 2 * np.mean(found["direct"].figure(SPREAD))


def test_occupancy_distance_is_scipys(seen) -> None:
    yardsticks, found = seen
    one, other = found["direct"], found["via"]
    assert occupancy_distance(one, one, yardsticks) == 0.0
    theirs = []
    for i, y in enumerate(yardsticks):
        shares = []
        for b in (one, other):
            total = np.zeros((15, 15))
            for d in range(2):
                edges = np.linspace(0, y.task.scenario.width_metres, 16)
                h = np.histogram2d(*b.paths[d][i].T, bins=(edges, edges))[0]
                total += h / h.sum()
            shares.append(total.ravel())
        theirs.append(jensenshannon(*shares, base=2))
    assert occupancy_distance(one, other, yardsticks) == pytest.approx(np.mean(theirs), abs=1e-9)


def test_samples_of_the_field_are_measured_like_anybody(seen) -> None:
    yardsticks, _ = seen
    few = [yardsticks[i] for i in (0, 3, 5)]
    samples = field_samples(few, 1)
    assert samples.completed.all() and set(samples.figures) == set(FIGURES)
    assert samples.mean("length / shortest") > 1.2, "it wanders"
    assert (samples.figures["time used / allowed"] <= 1.1).all()
    for d in range(2):
        for y, path in zip(few, samples.paths[d], strict=True):
            ends = [y.task.scenario.place(p).distance(path[-1:])[0] for p in y.task.mission.goals[-1].places]
            assert min(ends) < 0.1, "within a cell of the goal"
