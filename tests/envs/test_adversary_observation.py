"""The adversary's observation against a plain-Python twin, the mission automaton, and geometry."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tab_marl.envs import adversary_kernels as k
from tab_marl.envs import motion_kernels as motion
from tab_marl.envs.adversary_observation import OBSERVED, AdversaryObserver, AdversaryTask, observation_bounds
from tab_marl.envs.adversary_tables import later_windows, pack
from tab_marl.envs.lidar import Lidar
from tab_marl.envs.styles import STYLES, Style
from tab_marl.mission.automaton import UNBOUNDED, AutomatonState
from tab_marl.mission.compile import compile_mission
from tab_marl.mission.model import Constraint, ConstraintType, Mission
from tab_marl.mission.tasks import sample_task
from tab_marl.world.grid import GridMap, free_points
from tab_marl.world.regions import Box, Disc, Polygon
from tab_marl.world.scenario import Scenario

KINDS = [("M1", "ambiguous"), ("M2", "point"), ("M3", "point"), ("M4", "ambiguous"), ("M5", "point")]


def task_of(mission, family="point", style="direct", seed=0, slack=2.0):
    drawn = sample_task(np.random.default_rng(seed), mission, family, slack)
    return AdversaryTask.build(drawn.scenario, drawn.mission, STYLES[style], np.random.default_rng(seed + 1))


def twin(task, pose, v, w, location, clocks, via_passed, dropped):
    """What `observe` should say, from the route fields and the automaton in plain numpy."""
    x, y, theta = pose
    scenario, automaton, parts = task.scenario, task.automaton, task.parts
    robot, tick = scenario.adversary, automaton.tick_seconds
    pace = min(robot.max_speed, automaton.speed_limit[location])
    horizon = round(scenario.horizon_seconds / tick)
    own = total = math.inf
    own_target = total_target = None
    for c in range(3):
        if automaton.latest[location, c] < UNBOUNDED:
            own = min(own, (automaton.latest[location, c] - clocks[c]) * tick)
            if automaton.earliest[location, c] > 0 and not automaton.patient[location]:
                own_target = ((automaton.latest[location, c] + automaton.earliest[location, c]) / 2 - clocks[c]) * tick
    early, late = later_windows(automaton, horizon)[location]
    total = (late - clocks[0]) * tick
    if early > 0:
        total_target = ((late + early) / 2 - clocks[0]) * tick

    def way(route, at):
        (cell,), (after,) = route.targets(at, [(x, y)])
        if cell < 0:
            return np.array([x, y]), 20.0, 20.0
        target = route.grid.centres[cell]
        straight = math.hypot(target[0] - x, target[1] - y)
        near, counted = straight, False
        mask = int(automaton.masks(target)[0])
        if after != at and at < automaton.locations:
            counted = bool(automaton.progress[location, mask])
            shares = np.linspace(0, 1, 2001)
            on_line = np.array([x, y]) + shares[:, None] * (target - (x, y))
            changed = automaton.next_location[location, automaton.masks(on_line)] != location
            near = straight * shares[np.argmax(changed)]
        if after < 0:
            return target, near, near
        return target, straight + route.length[after, cell], near if counted else straight + route.to_visit[after, cell]

    if not dropped:
        at = automaton.locations + via_passed if via_passed < len(parts.via) else location
        target, length, visit = way(parts.styled, at)
        reserve = k.RESERVE_SECONDS + k.RESERVE_SHARE * length / pace
        dropped = not (visit / pace + reserve <= own and length / pace + reserve <= total)
    if dropped:
        target, length, visit = way(parts.plain, location)
    out = np.zeros(OBSERVED)
    body = np.array([[math.cos(theta), math.sin(theta)], [-math.sin(theta), math.cos(theta)]])
    towards = target - (x, y)
    out[0:2] = body @ towards / max(np.hypot(*towards), 1e-9)
    out[2] = min(np.hypot(*towards), 1.2) / 1.2
    out[3], out[4] = min(visit, 4) / 2, min(length, 8) / 4

    def timed(row, seconds):
        out[row], out[row + 1] = np.clip(seconds, -5, 20) / 10, math.tanh(seconds)

    timed(5, min(own - visit / pace, 20))
    timed(7, min(total - length / pace, 20))
    if own_target is not None:
        excess, exact = own_target - visit / pace, 1
    elif total_target is not None:
        excess, exact = total_target - length / pace, 1
    elif task.latents.arrival_fraction and not dropped:
        share, exact = task.latents.arrival_fraction, 0
        bounded = [c for c in range(3) if automaton.latest[location, c] < UNBOUNDED]
        if late < horizon or not bounded:
            allowed = min(late, horizon) * tick
            excess = min(share * allowed, allowed - 1.5) - clocks[0] * tick - length / pace
        else:
            c = min(bounded, key=lambda c: automaton.latest[location, c] - clocks[c])
            allowed = automaton.latest[location, c] * tick
            excess = min(share * allowed, allowed - 1.5) - clocks[c] * tick - visit / pace
    else:
        excess = None
    if excess is not None:
        out[9], out[12] = 1, exact
        timed(10, excess)
    out[13], out[14], out[15] = v / robot.max_speed, w / robot.max_turn_rate, pace / robot.max_speed
    out[16], out[17] = via_passed < len(parts.via) and not dropped, not dropped
    zones = [
        (region.distance((x, y)), region)
        for p, region in enumerate(automaton.regions)
        if automaton.next_location[location, 1 << p] == -2 or automaton.forbidden_until[location, 1 << p] > 0
    ]
    out[20] = 1
    if zones and min(zones, key=lambda z: z[0])[0] < 1:
        out[20], zone = min(zones, key=lambda z: z[0])
        arm = np.subtract(zone.centre, (x, y))
        out[18:20] = body @ arm / np.hypot(*arm)
    lidar = replace(Lidar.of(scenario), rays=12, longest=1.0)
    out[21:33] = lidar.scan(x, y, theta)
    real = task.tables.real[0]
    out[33:37] = real[k.SIDE], real[k.CAMERA_SHY], real[k.EDGE_NOISE], real[k.ARRIVAL_FRACTION]
    return out


@pytest.mark.parametrize("style", ["direct", "side", "via", "late", "camera-shy"])
@pytest.mark.parametrize(("mission", "family"), KINDS)
def test_observation_equals_its_plain_twin(mission, family, style):
    task = task_of(mission, family, style, seed=3)
    automaton, scenario = task.automaton, task.scenario
    rng = np.random.default_rng(0)
    points = GridMap.from_scenario(scenario, 0.1).centres
    checked = 0
    for _ in range(60):
        point = points[rng.integers(len(points))] + rng.uniform(-0.04, 0.04, 2)
        location = int(rng.integers(automaton.locations))
        clocks = tuple(int(c) for c in rng.integers(0, 40, 3))
        mask = int(automaton.masks(point)[0])
        if automaton.next_location[location, mask] != location or automaton.forbidden_until[location, mask] > 0:
            continue  # the automaton would not stay here with this label
        pose, v, w = (*point, rng.uniform(-3, 3)), rng.uniform(0, 0.22), rng.uniform(-1.8, 1.8)
        observer = AdversaryObserver(task)
        seen = observer.observe(*pose, v, w, location, clocks)
        expected = twin(
            task, pose, v, w, location, clocks, len(task.parts.via) if location != task.parts.via_home else 0, False
        )  # fmt: skip
        at_via = len(task.parts.via) and np.hypot(*(task.parts.via[0] - point)) <= k.VIA_METRES
        if not at_via:
            np.testing.assert_allclose(seen, expected, atol=4e-3)
            checked += 1
    assert checked >= 10


def test_observations_lie_within_their_bounds_and_use_them():
    low, high = observation_bounds()
    seen = []
    for seed, (mission, family) in enumerate(KINDS):
        task = task_of(mission, family, "camera-shy", seed)
        rng = np.random.default_rng(seed)
        for _ in range(200):
            pose = (*rng.uniform(0, 3, 2), rng.uniform(-3, 3))
            location = int(rng.integers(task.automaton.locations))
            clocks = tuple(int(c) for c in rng.integers(0, 900, 3))
            ego = tuple(rng.uniform(-1, 4, 2)) if rng.random() < 0.5 else None
            seen.append(
                AdversaryObserver(task).observe(*pose, rng.uniform(-1, 1), rng.uniform(-9, 9), location, clocks, ego)
            )
    array = np.array(seen)
    assert np.isfinite(array).all()
    assert (array >= low - 1e-6).all() and (array <= high + 1e-6).all()
    spread = array.max(axis=0) - array.min(axis=0)
    constant = {k.O_LIMIT, k.O_VIA, *range(k.O_LATENTS, k.O_LATENTS + 4)}
    assert set(np.flatnonzero(spread < 0.2)) <= constant


def test_labels_and_steps_are_those_of_the_mission_automaton():
    rng = np.random.default_rng(1)
    for seed, (mission, family) in enumerate(KINDS):
        task = task_of(mission, family, seed=seed)
        automaton, tables = task.automaton, task.tables
        points = rng.uniform(0, 3, (3000, 2))
        masks = automaton.masks(points)
        assert [k.task_label(tables, 0, x, y) for x, y in points] == masks.tolist()
        state = AutomatonState(automaton.initial, (-1, -1, -1))
        location, clocks = automaton.initial, np.full(3, -1, dtype=np.int32)
        walk = np.clip(np.cumsum(rng.normal(0, 0.08, (2500, 2)), axis=0) + 1.5, 0, 3)
        for x, y in walk:
            state = automaton.advance(state, int(automaton.masks((x, y))[0]))
            location, _ = k.task_advance(tables, 0, location, clocks, x, y)
            over = clocks[0] > round(task.scenario.horizon_seconds * 10)
            if over:
                assert location < 0
                break
            assert (location, tuple(clocks)) == (state.location, state.clocks)
            if location < 0:
                location, clocks = automaton.initial, np.full(3, -1, dtype=np.int32)
                state = AutomatonState(automaton.initial, (-1, -1, -1))


def test_region_distances_and_motion_against_the_world():
    shapes = (Box(1.0, 1.0, 1.6, 1.3), Disc(2.2, 2.0, 0.25), Polygon(((0.6, 2.0), (1.2, 2.1), (0.8, 2.6))))
    base = Scenario.preset("open")
    scenario = replace(base, name="shapes", obstacles=shapes)
    mission = Mission((Constraint(ConstraintType.DEADLINE, ("Checkpoint A",), seconds=40.0),))
    task = AdversaryTask.build(scenario, mission, Style(), np.random.default_rng(0))
    tables, rng = task.tables, np.random.default_rng(2)
    start = int(tables.number[0, k.REGION_AT] + tables.number[0, k.PROPOSITIONS])
    points = rng.uniform(0, 3, (2000, 2))
    for i, shape in enumerate(shapes):
        exact = shape.distance(points)
        signed = np.array(
            [k.region_distance(tables.disc, tables.region_first, tables.halfplanes, start + i, *p) for p in points]
        )
        assert ((signed <= 1e-12) == (exact == 0)).all()
        assert (signed <= exact + 1e-9).all()
        outward = [
            motion.outward(tables.disc, tables.region_first, tables.halfplanes, tables.corners, start + i, *p)
            for p in points
        ]
        outside = exact > 0
        np.testing.assert_allclose(np.array([o[2] for o in outward])[outside], exact[outside], atol=1e-9)
    # Free motion is the unicycle's; pushed out of obstacles nothing ends inside one.
    radius = scenario.adversary.radius_metres
    free = points[free_points(scenario, points, radius)]
    for x, y in free[:500]:
        theta, v, w = rng.uniform(-3, 3), rng.uniform(0, 0.22), rng.uniform(-1.8, 1.8)
        nx, ny, turned, _, touched = motion.drive(tables, 0, x, y, theta, v, w, radius, 0.01, 10)
        assert free_points(scenario, np.array([[nx, ny]]), radius - 2e-3)[0]
        if not touched:
            fine = np.array([x, y, theta])
            for _ in range(1000):
                fine += 1e-4 * np.array([v * math.cos(fine[2]), v * math.sin(fine[2]), w])
            np.testing.assert_allclose((nx, ny), fine[:2], atol=5e-6)
            assert math.cos(turned - fine[2]) > 1 - 1e-9


def test_later_windows_look_past_the_current_visit():
    scenario = Scenario.preset("lab")
    reach = Constraint(ConstraintType.EVENTUALLY, ("Checkpoint A",))
    then = Constraint(ConstraintType.EXACT, ("Checkpoint B",), seconds=30.0)
    automaton = compile_mission(Mission((reach, then)), scenario, 0.1)
    assert later_windows(automaton, 600).tolist() == [[270, 330], [0, 600]]
    alone = compile_mission(Mission((replace(then, seconds=20.0),)), scenario, 0.1)
    assert later_windows(alone, 500).tolist() == [[0, 500]]


def test_packing_several_tasks_serves_each_as_alone():
    tasks = [task_of(m, f, s, seed) for seed, ((m, f), s) in enumerate(zip(KINDS, STYLES, strict=False))]
    together = pack([task.parts for task in tasks] * 2)
    rng = np.random.default_rng(0)
    for i, task in enumerate(tasks * 2):
        x, y = task.scenario.adversary_start.centre
        for _ in range(5):
            theta = rng.uniform(-3, 3)
            clocks = np.array([3, 3, 3], dtype=np.int32)
            mine, theirs = np.zeros(OBSERVED, np.float32), np.zeros(OBSERVED, np.float32)
            arguments = (x, y, theta, 0.1, 0.2, task.parts.via_home, clocks)
            k.observe(task.tables, 0, *arguments, np.zeros(2, np.int32), False, 0.0, 0.0, mine)
            k.observe(together, i, *arguments, np.zeros(2, np.int32), False, 0.0, 0.0, theirs)
            np.testing.assert_array_equal(mine, theirs)


def test_a_seen_ego_is_given_in_the_body_frame():
    task = task_of("M1")
    x, y = task.scenario.adversary_start.centre
    seen = AdversaryObserver(task).observe(x, y, math.pi / 2, 0, 0, 0, (0, 0, 0), ego=(x - 0.3, y + 0.5))
    np.testing.assert_allclose(seen[k.O_EGO :], [1, 0.5, 0.3], atol=1e-6)
    blind = AdversaryObserver(task).observe(x, y, math.pi / 2, 0, 0, 0, (0, 0, 0))
    np.testing.assert_array_equal(blind[k.O_EGO :], 0)


def test_styles_are_dropped_when_time_runs_short_and_never_taken_up_again():
    task = next(t for t in (task_of("M1", "point", "via", seed) for seed in range(20)) if len(t.parts.via))
    x, y = task.scenario.adversary_start.centre
    observer = AdversaryObserver(task)
    deadline = int(task.automaton.latest[0, 0])
    assert observer.observe(x, y, 0, 0, 0, 0, (0, 0, 0))[k.O_STYLED] == 1
    late = (deadline - 20, deadline - 20, deadline - 20)
    assert observer.observe(x, y, 0, 0, 0, 0, late)[k.O_STYLED] == 0
    assert observer.style_dropped
    assert observer.observe(x, y, 0, 0, 0, 0, (0, 0, 0))[k.O_STYLED] == 0
    observer.reset()
    assert observer.observe(x, y, 0, 0, 0, 0, (0, 0, 0))[k.O_VIA] == 1


def test_no_style_without_slack():
    for style in STYLES:
        task = task_of("M1", "point", style, seed=2, slack=1.02)
        assert task.parts.styled is task.parts.plain
        assert task.latents.arrival_fraction == 0 and task.strength in (0, 1)


def test_ended_missions_observe_nothing():
    task = task_of("M1")
    assert not AdversaryObserver(task).observe(1, 1, 0, 0, 0, -1, (5, 5, 5)).any()


def test_building_is_quick():
    """Generous bounds (4 x what it takes on an idle core): an accidental quadratic loop is what this is for."""
    import time

    for mission, bound in (("M1", 0.06), ("M5", 0.24)):
        drawn = [sample_task(np.random.default_rng(s), mission) for s in range(4)]
        seconds = []
        for task in drawn:
            began = time.perf_counter()
            AdversaryTask.build(task.scenario, task.mission, STYLES["side"], np.random.default_rng(0))
            seconds.append(time.perf_counter() - began)
        assert min(seconds) < bound
