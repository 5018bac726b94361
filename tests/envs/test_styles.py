"""Styles: what is drawn, and that each bends the route the way it says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tab_marl.envs.adversary_observation import AdversaryTask
from tab_marl.envs.styles import STYLES, Style
from tab_marl.mission.parse import parse_mission
from tab_marl.mission.tasks import sample_task
from tab_marl.world.regions import Box, Disc
from tab_marl.world.scenario import UnknownName


def build(style, seed, mission="M1", family="point", slack=2.4, draw=0):
    task = sample_task(np.random.default_rng(seed), mission, family, slack)
    return AdversaryTask.build(task.scenario, task.mission, style, np.random.default_rng((seed, draw)))


def start_path(task, route):
    first = route.via_locations[0] if route.via_locations else task.parts.via_home
    cells, _ = route.path(first, task.scenario.adversary_start.centre)
    return route.grid.centres[cells]


def winding(task, path):
    x, y = path.T - 1.5
    return np.diff(np.unwrap(np.arctan2(y, x))).sum()


def test_draws_are_reproducible_and_cover_their_ranges():
    style = Style("all", side=0.5, via=0.5, via_points_max=2, arrival_fraction=(0.6, 0.9))
    drawn = [style.draw(np.random.default_rng(s)) for s in range(400)]
    assert drawn[:5] == [style.draw(np.random.default_rng(s)) for s in range(5)]
    sides = np.array([d.side for d in drawn])
    assert {-1, 0, 1} == set(sides.tolist())
    assert 0.4 < (sides == 0).mean() < 0.6
    assert 0.15 < (sides == 1).mean() < 0.35
    assert {d.via_points for d in drawn} == {0, 1, 2}
    fractions = np.array([d.arrival_fraction for d in drawn])
    assert 0.6 <= fractions.min() < 0.63 and 0.87 < fractions.max() <= 0.9
    assert len({d.seed for d in drawn}) > 390


def test_side_turns_the_drawn_way_where_the_plain_route_does_not():
    turned = {"styled": [], "plain": []}
    for seed in range(30):
        task = build(STYLES["side"], seed)
        for name, route in (("styled", task.parts.styled), ("plain", task.parts.plain)):
            turn = winding(task, start_path(task, route))
            if abs(turn) > 0.3:
                turned[name].append(np.sign(turn) == task.latents.side)
    assert np.mean(turned["styled"]) >= 0.75
    assert 0.3 <= np.mean(turned["plain"]) <= 0.7


def test_via_points_lie_on_the_styled_way_and_off_the_goals():
    lengthened = 0
    for seed in range(12):
        task = build(replace(STYLES["via"], via_points_max=2), seed, "M4")
        path = start_path(task, task.parts.styled)
        for point in task.parts.via:
            assert np.hypot(*(path - point).T).min() <= 0.16
            assert int(task.automaton.masks(point)[0]) == 0
        plain = start_path(task, task.parts.plain)
        lengthened += len(task.parts.via) > 0 and len(path) > len(plain) + 2
    assert lengthened >= 8


def test_camera_shy_ways_spend_fewer_cells_under_cameras():
    under = {"styled": 0, "plain": 0}
    for seed in range(20):
        task = build(STYLES["camera-shy"], seed)
        for name, route in (("styled", task.parts.styled), ("plain", task.parts.plain)):
            under[name] += int(task.scenario.seen(start_path(task, route)).sum())
    assert under["styled"] < 0.75 * under["plain"]


def test_contrary_goes_round_the_other_side_if_that_costs_no_more_than_it_is_willing_to_pay():
    """A box between start and goal, its middle below the line between them: below is about 0.7 m longer than above."""
    task = sample_task(np.random.default_rng(0), "M1", "point", 2.0)
    goal = task.scenario.checkpoints[0]
    scenario = replace(
        task.scenario,
        checkpoints=(replace(goal, x=2.6, y=1.5), *task.scenario.checkpoints[1:]),
        obstacles=(Box(1.3, 0.7, 1.7, 1.7),),
        adversary_start=Disc(0.4, 1.5, 0.1),
    )
    mission = parse_mission(f"Reach {goal.name} within 50 s", scenario)

    def way(metres):
        task = AdversaryTask.build(scenario, mission, Style(contrary_metres=metres), np.random.default_rng(0))
        return start_path(task, task.parts.styled)

    def metres_of(path):
        return np.hypot(*np.diff(path, axis=0).T).sum()

    above, below = way(0.0), way(3.0)
    between = {name: path[np.abs(path[:, 0] - 1.5) < 0.15, 1] for name, path in (("above", above), ("below", below))}
    assert (between["above"] > 1.7).all() and (between["below"] < 0.7).all()
    detour = metres_of(below) - metres_of(above)
    assert 0.4 < detour < 1.2
    for metres in (0.4 * detour, 0.8 * detour, 1.25 * detour, 2.0 * detour):
        goes_below = way(metres)[:, 1].min() < 0.7
        assert goes_below == (metres > detour), (metres, detour)


def test_wander_takes_another_way_each_time_and_fickle_another_goal():
    ways = [start_path(t, t.parts.styled) for t in (build(STYLES["wander"], 4, draw=d) for d in range(6))]
    assert len({way.tobytes() for way in ways}) >= 4
    ends = []
    for draw in range(24):
        task = build(STYLES["fickle"], 3, family="ambiguous", draw=draw)
        ends.append(int(task.automaton.masks(start_path(task, task.parts.styled)[-1])[0]))
    plain = build(Style(), 3, family="ambiguous")
    (nearest,) = {int(plain.automaton.masks(start_path(plain, plain.parts.plain)[-1])[0])}
    assert len(set(ends)) >= 3
    assert ends.count(nearest) < 20


def test_every_styled_way_fits_into_the_time_allowed():
    for style in STYLES.values():
        for seed, mission in enumerate(("M1", "M3", "M4", "M5")):
            task = build(style, seed, mission, "ambiguous", slack=1.5)
            route = task.parts.styled
            first = route.via_locations[0] if route.via_locations else task.parts.via_home
            (start,) = route.grid.cells_of(task.scenario.adversary_start.centre)
            latest = task.automaton.latest[task.parts.via_home]
            assert route.to_visit[first, start] / 0.22 <= 0.9 * min(latest) * 0.1
            assert route.length[first, start] / 0.22 <= 0.9 * task.scenario.horizon_seconds


def test_bad_styles_are_refused():
    with pytest.raises(ValueError, match=r"Style.side is 1.5, must be a probability"):
        Style(side=1.5)
    with pytest.raises(ValueError, match="camera_shy is -1"):
        Style(camera_shy=-1)
    with pytest.raises(ValueError, match="via_points_max is 3"):
        Style(via_points_max=3)
    with pytest.raises(ValueError, match="arrival_fraction"):
        Style(arrival_fraction=(0.9, 0.5))
    with pytest.raises(UnknownName, match="did you mean 'direct'"):
        Style.preset("dirct")
