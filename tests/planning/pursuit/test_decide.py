"""The tree over route changes: equal to the routes' values without changes, and right where the right answer is known."""

import math

import numpy as np
import pytest
from numba import njit

from tab_marl.planning.models.interface import SampledPaths
from tab_marl.planning.pursuit import decide_kernels
from tab_marl.planning.pursuit.decide import PursuitOptions, decide, pursuit_model
from tab_marl.planning.pursuit.interception import value_routes
from tab_marl.planning.pursuit.routes import Itinerary, RouteMap
from tab_marl.world.regions import Disc
from tab_marl.world.scenario import Checkpoint, Scenario

LAB = Scenario.preset("lab")
MAP = RouteMap.build(LAB)
POSE = (2.0, 2.7, -1.0)
RNG = np.random.default_rng


def wandering(count: int, ticks: int, seed: int) -> SampledPaths:
    rng = RNG(seed)
    heading = rng.uniform(-np.pi, np.pi, (count, 1)) + np.cumsum(rng.normal(0, 0.2, (count, ticks)), axis=1)
    moves = 0.11 * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    start = rng.uniform(0.3, 2.7, (count, 1, 2))
    positions = np.clip(np.concatenate([start, start + np.cumsum(moves, axis=1)], axis=1), 0.1, 2.9)
    completed = np.where(rng.random(count) < 0.7, rng.integers(3, ticks, count), -1).astype(np.int32)
    return SampledPaths(positions, completed)


def test_without_route_changes_the_tree_gives_the_routes_values() -> None:
    sampled = wandering(60, 40, seed=1)
    options = PursuitOptions(tree_seconds=0.0, switches=0, simulations=2000, keep_bonus=0.0)
    decision = decide(MAP, POSE, sampled, None, options, RNG(0))
    assert decision.plan is not None
    assert decision.plan.values == pytest.approx(decision.values.mean, abs=1e-4)
    assert (
        decision.route
        == decide(MAP, POSE, sampled, None, PursuitOptions(method="routes", keep_bonus=0.0), RNG(0)).route
    )


@pytest.mark.parametrize("macro_seconds", [0.5, 1.0, 3.0])
def test_steps_and_rollout_add_up_to_the_open_loop_return(macro_seconds: float) -> None:
    """Keeping one route, cut into macro-actions anywhere, is worth what the scan over whole routes says, path by path."""
    sampled = wandering(40, 40, seed=2)
    options = PursuitOptions(macro_seconds=macro_seconds, switches=0, completion_weight=1.0)
    candidates = [Itinerary.plain(w) for w in (0, 5, MAP.stay)] + [Itinerary(17, 9, 60), Itinerary(MAP.stay, 6, 3)]
    table = MAP.itinerary_table(POSE, 40, candidates)
    values = value_routes(table, sampled.positions, sampled.completed_tick, LAB.rewards, 0.3)
    model = pursuit_model(MAP, POSE, sampled, values, candidates, options)
    step, rollout = njit(decide_kernels.step), njit(decide_kernels.rollout)
    outcomes = {"met": 0, "not met": 0}
    for a in range(len(candidates)):
        for k in range(40):
            for macros in (0, 1, 3, 100):
                state = np.array([float(k), 0.0, *POSE, -1.0])
                total, over = 0.0, False
                for _ in range(macros):
                    _seen, reward, over = step(state, a, model.data, np.zeros(1, dtype=np.uint64))
                    total += reward
                    if over:
                        break
                if not over:
                    total += rollout(state, a, 0, macros, 100, 1.0, model.data, np.zeros(1, dtype=np.uint64))
                control = model.data.baseline[a] - values.returns[a, k] if macros else 0.0
                assert total - control == pytest.approx(values.returns[a, k], abs=1e-3)
            outcomes["met" if values.met[a, k] >= 0 else "not met"] += 1
    assert min(outcomes.values()) > 20


def test_macro_actions_stop_when_a_camera_begins_to_see() -> None:
    camera = LAB.checkpoints[3]
    line = np.stack([np.linspace(camera.x - 1.2, camera.x, 21), np.full(21, camera.y)], axis=1)
    sampled = SampledPaths(line[None], np.array([-1], dtype=np.int32))
    candidates = [Itinerary.plain(MAP.stay)]
    table = MAP.itinerary_table(POSE, 20, candidates)
    values = value_routes(table, sampled.positions, sampled.completed_tick, LAB.rewards, 0.3)
    options = PursuitOptions(macro_seconds=30.0, branch_on_sightings=True)
    model = pursuit_model(MAP, POSE, sampled, values, candidates, options)
    state = np.array([0.0, 0.0, *POSE, -1.0])
    seen, _reward, over = njit(decide_kernels.step)(state, 0, model.data, np.zeros(1, dtype=np.uint64))
    entered = int(np.argmax(np.hypot(*(line - (camera.x, camera.y)).T) <= camera.camera_metres))
    assert seen != decide_kernels.UNSEEN and not over
    assert state[1] == entered


def fork() -> tuple[RouteMap, SampledPaths]:
    """The adversary comes from the south to a camera at the fork and goes on to the west or to the east, evenly.

    The ego stands in the middle: it can reach either goal after the camera has told which, but not both.
    """
    scenario = Scenario(
        name="fork",
        checkpoints=(
            Checkpoint("Checkpoint A", 0.3, 1.5, 0.18, 0.2),
            Checkpoint("Checkpoint B", 2.7, 1.5, 0.18, 0.2),
            Checkpoint("Checkpoint C", 0.9, 0.3, 0.05, 0.3),
            Checkpoint("Checkpoint D", 2.1, 0.3, 0.05, 0.3),
        ),
        ego_start=Disc(1.5, 1.5, 0.1),
        adversary_start=Disc(1.5, 0.3, 0.1),
    )
    paths = []
    for side in (-1, 1):
        corners = np.array([(1.5, 0.3), (1.5 + side * 1.2, 0.3), (1.5 + side * 1.2, 1.4)])
        lengths = np.hypot(*np.diff(corners, axis=0).T)
        at = np.minimum(np.arange(41) * 0.1, lengths.sum())
        knots = np.concatenate([[0], np.cumsum(lengths)])
        paths.append(np.stack([np.interp(at, knots, corners[:, 0]), np.interp(at, knots, corners[:, 1])], axis=1))
    positions = np.repeat(np.array(paths), 100, axis=0)
    return RouteMap.build(scenario), SampledPaths(positions, np.full(200, 24, dtype=np.int32))


def test_two_goals_the_tree_sees_that_waiting_for_the_camera_wins_both() -> None:
    routes, sampled = fork()
    pose = (1.5, 1.5, -math.pi / 2)
    options = PursuitOptions(candidates=12, simulations=3000)
    flat = decide(routes, pose, sampled, None, PursuitOptions(method="routes"), RNG(0))
    # A route that is kept meets one branch only: half the paths.
    assert 0.45 <= flat.values.met_share.max() <= 0.55
    tree = decide(routes, pose, sampled, None, options, RNG(0))
    assert tree.plan is not None
    best = tree.plan.values.max()
    assert best > flat.values.mean.max() + 25
    # And it cannot be better than meeting every path at once.
    assert best < 50
    # Whatever it does first leaves both goals within reach: the goals are 1.2 m away, the camera tells after 5 s.
    first = routes.table(pose, 2).positions[tree.route, 2]
    assert abs(first[0] - 1.5) < 0.25


def test_more_simulations_do_not_make_the_fork_worse() -> None:
    routes, sampled = fork()
    found = {}
    for simulations in (300, 6000):
        options = PursuitOptions(simulations=simulations)
        plans = [decide(routes, (1.5, 1.5, 0.0), sampled, None, options, RNG(seed)).plan for seed in range(3)]
        found[simulations] = np.mean([plan.values.max() for plan in plans if plan is not None])
    assert found[6000] > found[300] - 1.0


def test_the_present_route_is_kept_unless_another_is_clearly_better() -> None:
    sampled = wandering(60, 40, seed=3)
    options = PursuitOptions(method="routes", keep_bonus=1000.0)
    assert decide(MAP, POSE, sampled, Itinerary.plain(7), options, RNG(0)).route == 7


@pytest.mark.parametrize("bad", [{"paths": 0}, {"macro_seconds": 0.0}, {"exploration": -1.0}, {"method": "magic"}])
def test_bad_options_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=f"PursuitOptions.{next(iter(bad))} is"):
        PursuitOptions(**bad)  # type: ignore[arg-type]
