"""Adversary models: hand-made cases with known answers, slow twins of the walking kernels, and one contract for all."""

import json
import math

import numpy as np
import pytest

from tab_marl.field.problem import FieldOptions
from tab_marl.mission.model import Constraint, Mission
from tab_marl.planning.models import walk_kernels as kernels
from tab_marl.planning.models.field_model import FieldModel
from tab_marl.planning.models.guarded import Guarded
from tab_marl.planning.models.interface import AdversaryModel, Sighting, TickObservation
from tab_marl.planning.models.mission_map import MissionMap
from tab_marl.planning.models.mixture import Mixture
from tab_marl.planning.models.pool import TrajectoryPool
from tab_marl.planning.models.shortest_path import ShortestPath, ShortestPathOptions, goal_choices
from tab_marl.planning.models.walker import MoveCounts, Walker
from tab_marl.world.regions import Disc
from tab_marl.world.scenario import Checkpoint, Scenario

RNG = np.random.default_rng
FAR = (50.0, 50.0)
"""An ego that is nowhere near."""

OPEN = Scenario(
    name="two goals",
    checkpoints=(
        Checkpoint("Checkpoint A", 0.5, 2.5, 0.18, 0.4),
        Checkpoint("Checkpoint B", 2.5, 2.5, 0.18, 0.4),
        Checkpoint("Checkpoint C", 1.5, 1.5, 0.1, 0.2),
    ),
    ego_start=Disc(2.8, 0.3, 0.1),
    adversary_start=Disc(1.4, 0.4, 0.05),
    horizon_seconds=40.0,
)
ANY = Mission((Constraint("deadline", ("Checkpoint A", "Checkpoint B"), seconds=20.0),), "M1")  # type: ignore[arg-type]
ONLY_A = Mission((Constraint("deadline", ("Checkpoint A",), seconds=20.0),), "M1")  # type: ignore[arg-type]
EXACT = Mission(
    (Constraint("eventually", ("Checkpoint A",)), Constraint("exact", ("Checkpoint B",), seconds=32.0)),  # type: ignore[arg-type]
    "M2",
)
COARSE = FieldOptions(cell_metres=0.1)
REACH = 0.11


def make(name: str, mission: Mission = ANY) -> AdversaryModel:
    if name == "S":
        return Walker(MissionMap.build(OPEN, mission), particles=1500)
    if name == "MLE":
        return Walker(MissionMap.build(OPEN, mission), MoveCounts(), feasible=True, learns=True, particles=1500)
    if name == "FP":
        return ShortestPath(OPEN, mission)
    if name == "TAB":
        return FieldModel(OPEN, mission, COARSE)
    if name == "mixture":
        return Mixture([FieldModel(OPEN, mission, COARSE), make("pool")], [0.5, 0.5])  # type: ignore[list-item]
    rng = RNG(5)
    ends = np.array([(0.5, 2.5), (2.5, 2.5)])[rng.integers(2, size=100)]
    share = np.minimum(np.arange(81) / 25, 1.0)[None, :, None]
    start = np.array([1.4, 0.4]) + rng.normal(0, 0.03, (100, 1, 2))
    return TrajectoryPool(OPEN, start + share * (ends[:, None] - start), np.full(100, 23, dtype=np.int32))


MODELS = ("S", "FP", "MLE", "TAB", "pool", "mixture")


@pytest.mark.parametrize("name", MODELS)
def test_every_model_follows_sightings_and_never_breaks(name: str) -> None:
    rng = RNG(0)
    model = make(name)
    model.start(TickObservation(0, FAR), rng)
    for tick in range(1, 60):
        sighting = None
        if tick in (14, 15, 40):  # the last one contradicts everything
            sighting = Sighting(1.45, 1.5 + 0.08 * (tick % 2), math.pi / 2, 0.2)
        if tick == 16:  # seen within the tick only
            sighting = Sighting(1.45, 1.62, math.pi / 2, 0.2, age_seconds=0.3)
        ego = (1.5, 0.9) if tick == 5 else FAR
        model.observe(TickObservation(tick, ego, sighting), rng)
        grid, occupancy = model.occupancy()
        assert occupancy.shape == (grid.cells,)
        assert occupancy.min() >= 0 and occupancy.sum() == pytest.approx(1.0)
        if tick in (14, 15, 40) and name not in ("pool", "mixture"):
            mean = occupancy @ grid.centres
            assert math.dist(mean, (sighting.x, sighting.y)) < 0.12
    paths = model.sample(50, 20, rng)
    assert paths.positions.shape == (50, 21, 2)
    assert paths.completed_tick.shape == (50,)
    assert np.isfinite(paths.positions).all()


@pytest.mark.parametrize("name", MODELS)
def test_no_sampled_adversary_outruns_the_robot(name: str) -> None:
    model, rng = make(name), RNG(1)
    model.start(TickObservation(0, FAR), rng)
    steps = np.hypot(*np.moveaxis(np.diff(model.sample(60, 30, rng).positions, axis=1), -1, 0))
    # Cells of 0.1 m: single moves are rounded, the average is not.
    assert steps.max() <= REACH + (0.12 if name in ("TAB", "mixture") else 1e-6)
    assert steps.mean() <= REACH * (1.05 if name == "TAB" else 1.0) + 1e-6


@pytest.mark.parametrize("name", ["FP", "MLE", "TAB"])
@pytest.mark.parametrize("mission", [ANY, EXACT], ids=["any of two", "exact"])
def test_models_that_know_the_mission_complete_it_in_time(name: str, mission: Mission) -> None:
    model, rng = make(name, mission), RNG(2)
    model.start(TickObservation(0, FAR), rng)
    paths = model.sample(100, 79, rng)
    done = paths.completed_tick
    first, last = (1, 40) if mission is ANY else (57, 71)
    textbook = done[done >= 0]
    assert len(textbook) >= 95
    assert textbook.min() >= first and textbook.max() <= last


def test_unseen_means_not_under_a_camera_and_not_beside_the_ego() -> None:
    for name in ("S", "MLE", "TAB"):
        model, rng = make(name), RNG(3)
        model.start(TickObservation(0, FAR), rng)
        for tick in range(1, 12):
            model.observe(TickObservation(tick, (1.4, 1.1)), rng)
        now = model.sample(200, 1, rng).positions[:, 0]
        slack = 0.05 if name == "TAB" else 0.0
        assert (np.hypot(*(now - (1.4, 1.1)).T) > OPEN.interception_metres - slack).all()
        assert OPEN.seen(now).mean() < 0.02


def test_the_shortest_path_goes_straight_and_arrives_when_it_must() -> None:
    model, rng = make("FP", ONLY_A), RNG(0)
    model.start(TickObservation(0, FAR), rng)
    paths = model.sample(200, 60, rng)
    metres = math.dist((1.4, 0.4), (0.5, 2.5)) - 0.18
    ticks = metres / REACH
    assert np.median(paths.completed_tick) == pytest.approx(ticks, abs=2)
    k = int(np.argmin(np.abs(paths.completed_tick - ticks)))
    track = paths.positions[k, : paths.completed_tick[k]]
    length = np.hypot(*np.diff(track, axis=0).T).sum()
    assert length <= 1.06 * math.dist(track[0], track[-1])


def test_the_shortest_path_waits_outside_for_an_exact_time() -> None:
    model, rng = make("FP", EXACT), RNG(0)
    model.start(TickObservation(0, FAR), rng)
    paths = model.sample(50, 79, rng)
    assert np.median(paths.completed_tick) == pytest.approx((32 - 3.2) / 0.5, abs=2)
    before = paths.positions[:, 45:55]
    assert np.median(np.hypot(*np.moveaxis(before - (2.5, 2.5), -1, 0))) == pytest.approx(0.18, abs=0.12)


def test_fp_believes_the_nearer_goal_until_the_heading_says_otherwise() -> None:
    model, rng = ShortestPath(OPEN, ANY), RNG(0)
    model.start(TickObservation(0, FAR), rng)

    def share_of_b() -> float:
        gaps = np.hypot(*np.moveaxis(model.sample(200, 40, rng).positions - (2.5, 2.5), -1, 0))
        return float((gaps.min(axis=1) < 0.25).mean())

    assert share_of_b() < 0.15  # A is nearer
    for tick in range(1, 5):
        model.observe(TickObservation(tick, FAR), rng)
    for tick in range(5, 12):
        at = (1.4 + 0.05 * tick, 0.4 + 0.098 * tick)
        model.observe(TickObservation(tick, FAR, Sighting(*at, 1.1, 0.22)), rng)
    assert share_of_b() > 0.85
    assert model.fallbacks == 0


def test_fp_recovers_when_nobody_comes() -> None:
    """The camera at A should have seen it long ago: then it was delayed, or goes elsewhere."""
    model, rng = ShortestPath(OPEN, ONLY_A), RNG(0)
    model.start(TickObservation(0, FAR), rng)
    for tick in range(1, 30):
        model.observe(TickObservation(tick, FAR), rng)
    now = model.sample(200, 1, rng).positions[:, 0]
    assert OPEN.seen(now).mean() < 0.05
    assert model.sample(200, 50, rng).completed_tick.max() > 0


def test_goal_choices_narrow_one_choice_at_a_time() -> None:
    three = Mission((Constraint("eventually", ("Checkpoint A", "Checkpoint B", "Checkpoint C"), different=2),))  # type: ignore[arg-type]
    found = goal_choices(three, 8)
    assert found[0] == three
    assert {c.constraints[0].places for c in found[1:]} == {
        ("Checkpoint B", "Checkpoint C"), ("Checkpoint A", "Checkpoint C"), ("Checkpoint A", "Checkpoint B"),
    }  # fmt: skip
    assert [c.constraints[0].places for c in goal_choices(ANY, 8)[1:]] == [("Checkpoint A",), ("Checkpoint B",)]
    assert goal_choices(ONLY_A, 8) == (ONLY_A,)


def test_uniform_moves_are_uniform_in_the_disc() -> None:
    model = Walker(MissionMap.build(OPEN, ANY), particles=4000)
    rng = RNG(7)
    model.start(TickObservation(0, FAR, Sighting(1.5, 0.9, 0.0, 0.0)), rng)
    moved = model.sample(4000, 1, rng).positions
    step = moved[:, 1] - moved[:, 0]
    radius = np.hypot(*step.T) / REACH
    # Uniform in a disc: P(r < x) = x^2, and no direction is preferred.
    for x in (0.25, 0.5, 0.75):
        assert (radius < x).mean() == pytest.approx(x * x, abs=0.03)
    assert np.abs(step.mean(axis=0)).max() < 0.004


def test_counted_moves_are_learned_and_survive_a_round_trip() -> None:
    moves, rng = MoveCounts(), RNG(8)
    model = Walker(MissionMap.build(OPEN, ONLY_A), moves, feasible=True, learns=True, particles=500)
    heading = math.atan2(2.1, -0.9)
    for _ in range(3):
        model.start(TickObservation(0, FAR, Sighting(1.4, 0.4, heading, 0.22)), rng)
        for tick in range(1, 12):
            x, y = 1.4 + 0.1 * tick * math.cos(heading), 0.4 + 0.1 * tick * math.sin(heading)
            model.observe(TickObservation(tick, FAR, Sighting(x, y, heading, 0.2)), rng)
    assert moves.counts.sum() == pytest.approx(33)
    assert moves.counts[[15, 0, 1], 3].sum() > 30  # along the way, fast
    # What was learned shows in what is expected: straight on, against everywhere before.
    model.start(TickObservation(0, FAR, Sighting(1.4, 0.4, heading, 0.2)), rng)
    step = np.diff(model.sample(300, 1, rng).positions, axis=1)[:, 0]
    assert (step @ [math.cos(heading), math.sin(heading)]).mean() > 0.06
    state = json.loads(json.dumps(model.learned_state()))
    again = MoveCounts.from_json(state)
    assert again.cumulative() == pytest.approx(moves.cumulative())
    assert make("S").learned_state() is None  # type: ignore[attr-defined]


@pytest.mark.parametrize("counts", [[1.0, 2.0], [[-1.0]]])
def test_a_broken_learned_state_is_refused(counts: object) -> None:
    with pytest.raises(ValueError, match="counts"):
        MoveCounts.from_json({"prior_moves": 8.0, "along_share": 0.5, "counts": counts})


def test_the_pool_weighs_by_agreement_and_never_depletes() -> None:
    model, rng = make("pool"), RNG(9)
    model.start(TickObservation(0, FAR), rng)
    for tick in range(1, 12):
        model.observe(TickObservation(tick, FAR), rng)
    towards_b = (1.4 + 1.1 * 12 / 25, 0.4 + 2.1 * 12 / 25)
    model.observe(TickObservation(12, FAR, Sighting(*towards_b, 1.1, 0.22)), rng)
    ends = model.sample(200, 20, rng).positions[:, -1]
    assert (np.hypot(*(ends - (2.5, 2.5)).T) < 0.3).mean() > 0.9
    model.observe(TickObservation(13, FAR, Sighting(0.2, 0.2, 0.0, 0.0)), rng)  # where no trajectory is
    assert model.fallbacks == 1
    assert np.isfinite(model.weights).all() and model.weights.sum() == pytest.approx(1.0)  # type: ignore[attr-defined]
    # Futures start where it was seen.
    assert np.hypot(*(model.sample(50, 5, rng).positions[:, 0] - (0.2, 0.2)).T).max() < 1e-9


def test_completed_hypotheses_are_left_out_while_others_are_possible() -> None:
    for name in ("FP", "pool", "MLE"):
        model, rng = make(name), RNG(10)
        model.start(TickObservation(0, FAR), rng)
        for tick in range(1, 24):
            model.observe(TickObservation(tick, FAR), rng)
        assert (model.sample(100, 40, rng).completed_tick != 0).all()


def test_follow_way_matches_a_slow_twin() -> None:
    m = MissionMap.build(OPEN, EXACT)
    for delay, pace in ((0, 1.0), (5, 1.0), (0, 0.7)):
        clocks = np.full(3, -1, dtype=np.int32)
        location = kernels.read_label(m.automaton.initial, clocks, m.mask_at(1.4, 0.4), m.rules)
        positions, locations = np.empty((81, 2)), np.empty(81, dtype=np.int32)
        states = np.empty((81, 3), dtype=np.int32)
        done = kernels.follow_way(
            1.4, 0.4, location, clocks, delay, pace, REACH, m.rules, m.ways, m.ground, positions, locations, states
        )
        state = m.automaton.first(int(m.automaton.masks((1.4, 0.4))[0]))
        x, y, expected = 1.4, 0.4, -1
        for t in range(1, 81):
            if state.location >= 0 and t > delay:
                left = pace * REACH
                for _ in range(4):
                    cell = m.ways.nearest[int(y / 0.1), int(x / 0.1)]
                    to = m.grid.centres[m.ways.target[state.location, cell]]
                    gap = math.dist((x, y), to)
                    if gap < 1e-9 or left < 1e-9:
                        break
                    share = min(left, gap) / gap
                    ahead = (x + share * (to[0] - x), y + share * (to[1] - y))
                    mask = m.mask_at(*ahead)
                    if m.automaton.advance(state, mask).location == -2:
                        break
                    x, y = ahead
                    left -= share * gap
                    if m.automaton.next_location[state.location, mask] != state.location:
                        break
            before, state = state, m.automaton.advance(state, m.mask_at(x, y))
            if before.location >= 0 and state.location == -1:
                expected = t
            assert positions[t] == pytest.approx((x, y), abs=1e-9)
            assert locations[t] == state.location
            if state.location >= 0:
                assert tuple(states[t]) == state.clocks
        assert done == expected


def test_walkers_stay_on_free_ground() -> None:
    lab = Scenario.preset("lab")
    model = Walker(MissionMap.build(lab, ONLY_A), particles=300)
    rng = RNG(11)
    model.start(TickObservation(0, FAR), rng)
    positions = model.sample(100, 60, rng).positions.reshape(-1, 2)
    ground = model.map.ground
    rows, columns = (positions[:, ::-1] / ground.square_metres).astype(int).T
    assert ground.free[rows, columns].all()


@pytest.mark.parametrize("bad", [{"doubt": 0.0}, {"least_evidence": 1.0}, {"paces": (1.0,)}])
def test_bad_shortest_path_options_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="ShortestPathOptions"):
        ShortestPathOptions(**bad)  # type: ignore[arg-type]


def test_a_pool_of_the_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match="positions has shape"):
        TrajectoryPool(OPEN, np.zeros((3, 2)), np.zeros(3, dtype=np.int32))
    with pytest.raises(ValueError, match="completed_tick has shape"):
        TrajectoryPool(OPEN, np.zeros((3, 5, 2)), np.zeros(2, dtype=np.int32))


def test_the_guard_weighs_up_as_the_model_is_contradicted() -> None:
    m = MissionMap.build(OPEN, ONLY_A)
    model, rng = Guarded(ShortestPath(OPEN, ONLY_A), m, prior=0.05), RNG(12)
    model.start(TickObservation(0, FAR), rng)
    assert model.share == pytest.approx(0.05, abs=0.01)
    shares = []
    for tick in range(1, 26):
        # The ego stands where the shortest path goes, and meets nobody.
        model.observe(TickObservation(tick, (1.15, 1.0)), rng)
        shares.append(model.share)
    assert shares[-1] > 0.3
    paths = model.sample(400, 30, rng)
    now = paths.positions[:, 0]
    assert (np.hypot(*(now - (1.15, 1.0)).T) > 0.2).all()
    # Within reach of the start, and still able to complete.
    assert np.hypot(*(now - (1.4, 0.4)).T).max() < 26 * REACH + 0.3
    assert (paths.completed_tick >= 0).mean() > 0.5
    # A sighting ends all doubt about where it is, though not about where it goes.
    model.observe(TickObservation(26, FAR, Sighting(0.7, 2.1, 2.0, 0.2)), rng)
    assert model.share == pytest.approx(0.05)
    assert np.hypot(*(model.sample(200, 5, rng).positions[:, 0] - (0.7, 2.1)).T).max() < 0.2
    model.observe(TickObservation(27, FAR, Sighting(0.75, 2.1, 2.0, 0.2, age_seconds=0.2)), rng)
    assert model.share == pytest.approx(0.05, abs=0.01)


def test_the_guard_lets_go_when_it_is_too_late_for_the_mission() -> None:
    m = MissionMap.build(OPEN, ONLY_A)
    model, rng = Guarded(make("pool", ONLY_A), m, prior=0.9), RNG(13)  # type: ignore[arg-type]
    model.start(TickObservation(0, FAR), rng)
    for tick in range(1, 45):
        model.observe(TickObservation(tick, FAR), rng)
    assert (model.sample(100, 20, rng).completed_tick == -1).all()
    with pytest.raises(ValueError, match="guard's prior is 0"):
        Guarded(make("FP"), m, prior=0.0)  # type: ignore[arg-type]


def test_after_completion_the_adversary_wanders() -> None:
    m, rng = MissionMap.build(OPEN, ONLY_A), RNG(14)
    pool = make("pool")
    assert isinstance(pool, TrajectoryPool)
    before = pool.positions.copy()
    pool.wander_after_completion(m, rng)
    assert (pool.positions[:, :24] == before[:, :24]).all()
    steps = np.hypot(*np.moveaxis(np.diff(pool.positions[:, 23:], axis=1), -1, 0))
    assert 0.05 < steps.mean() < 0.09 and steps.max() <= REACH + 1e-9


def test_a_place_visited_between_two_ticks_counts() -> None:
    """The environment's monitor looks ten times a second; so must whoever follows the mission by sightings."""
    m = MissionMap.build(OPEN, EXACT)
    edge = ((0.79, 2.5), (0.67, 2.5), (0.79, 2.55))  # in A's disc for a moment
    assert m.label(m.automaton.initial, edge[2]) == int(m.automaton.masks(edge[2])[0])
    mask = m.label(m.automaton.initial, edge[2], edge)
    assert m.automaton.next_location[m.automaton.initial, mask] not in (m.automaton.initial, -2)
    for name in ("MLE", "FP", "TAB"):
        model, rng = make(name, EXACT), RNG(15)
        model.start(TickObservation(0, FAR), rng)
        for tick in range(1, 30):
            model.observe(TickObservation(tick, FAR), rng)
        model.observe(TickObservation(30, FAR, Sighting(*edge[2], 0.5, 0.2), edge), rng)
        after = model.sample(40, 40, rng).positions
        # A is done: it goes on to B, and never back.
        assert (np.hypot(*np.moveaxis(after[:, -1] - (2.5, 2.5), -1, 0)) < 1.0).mean() > 0.8
