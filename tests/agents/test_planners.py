"""The planners as agents: one contract for all eight, played in the environment's kinematics."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from tab_marl.agents.planners import PLANNERS, PRECEDENTS, PlannerOptions, goal_places, make_planner
from tab_marl.agents.pretraining import pretrained, untrained
from tab_marl.envs.ego_observation import observe_ego
from tab_marl.envs.physics import Motion
from tab_marl.mission.model import Constraint, Mission
from tab_marl.mission.tasks import Task, sample_task
from tab_marl.planning.models.drawn_ways import WaysOptions
from tab_marl.planning.models.field_model import FieldModel
from tab_marl.planning.models.mixture import Mixture
from tab_marl.planning.models.pool import TrajectoryPool
from tab_marl.planning.pursuit.decide import PursuitOptions
from tab_marl.world.kernels import steer, unicycle_step
from tab_marl.world.regions import Disc
from tab_marl.world.scenario import Checkpoint, Scenario, UnknownName

GOAL = (0.6, 2.4)
WAIT = Task(
    Scenario(
        name="one goal",
        checkpoints=(Checkpoint("Checkpoint A", *GOAL), Checkpoint("Checkpoint B", 2.4, 1.2)),
        ego_start=Disc(0.9, 2.0, 0.1),
        adversary_start=Disc(2.5, 0.5, 0.1),
        horizon_seconds=30.0,
    ),
    Mission((Constraint("deadline", ("Checkpoint A",), seconds=25.0),), "M1"),  # type: ignore[arg-type]
    "M1",
    "point",
    1.9,
)
SMALL = PlannerOptions(
    pursuit=PursuitOptions(paths=80, simulations=60), particles=500,
    rollouts=lambda task, rng: straight_lines(task, rng),
)  # fmt: skip
GOAL_AWARE = tuple(name for name in PLANNERS if name not in ("S-POMCP", "random"))


def straight_lines(task: Task, rng: np.random.Generator):
    """A population: to the goal over some point on the map, at various speeds."""
    start, ticks = np.array(task.scenario.adversary_start.centre), task.scenario.horizon_ticks
    paths, done = [], []
    for _ in range(80):
        corners = np.array([start, rng.uniform(0.2, 2.8, 2), GOAL])
        at = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
        metres = rng.uniform(0.08, 0.11) * np.arange(ticks + 1)
        paths.append(np.stack([np.interp(metres, at, corners[:, axis]) for axis in (0, 1)], axis=1))
        done.append(int(np.argmax(metres >= at[-1] - 0.18)) or -1)
    return np.array(paths), np.array(done, dtype=np.int32)


def play(agent, task: Task, seed: int, via: tuple[float, float] | None = None, seconds: float | None = None):
    """One episode of kinematic robots: the adversary drives to `via`, then to the goal. Returns (outcome, ego track)."""
    scenario = task.scenario
    rng = np.random.default_rng(seed)
    agent.reset(task, np.random.default_rng(seed))
    ego = (*scenario.ego_start.centre, rng.uniform(-3, 3))
    adversary, targets = (*scenario.adversary_start.centre, 2.0), [p for p in (via, GOAL) if p is not None]
    speeds, track = (0.0, 0.0), [ego]
    for step in range(round((seconds or scenario.horizon_seconds) * scenario.control_hertz)):
        seen = agent.full_observation or bool(scenario.seen(adversary[:2]))
        view = Motion(*adversary, *speeds) if seen else None
        ranges = np.ones(scenario.sensors.lidar_rays)
        left = scenario.horizon_seconds - step / scenario.control_hertz
        action = agent.act(
            observe_ego(Motion(*ego, 0.0, 0.0), step / scenario.control_hertz, left, view, ranges, (0.22, 0.22))
        )
        assert action.shape == (2,) and (np.abs(action) <= 1).all()
        ego = unicycle_step(*ego, (action[0] + 1) / 2 * 0.22, action[1] * 1.82, 0.1)
        speeds = steer(*adversary, *targets[0], 0.22, 1.82, 0.1)
        adversary = unicycle_step(*adversary, *speeds, 0.1)
        if len(targets) > 1 and math.dist(adversary[:2], targets[0]) < 0.05:
            targets.pop(0)
        track.append(ego)
        if math.dist(ego[:2], adversary[:2]) <= scenario.interception_metres:
            return "met", track
        if math.dist(adversary[:2], GOAL) <= 0.18:
            return "completed", track
    return "horizon", track


@pytest.mark.parametrize("name", PLANNERS)
def test_the_contract(name: str) -> None:
    agent = make_planner(name, SMALL)
    assert agent.name == name
    assert agent.full_observation == (name == "oracle")
    _outcome, track = play(agent, WAIT, seed=3, seconds=6.0)
    again = make_planner(name, SMALL)
    assert play(again, WAIT, seed=3, seconds=6.0)[1] == track
    assert len(agent.decision_seconds) >= 1
    assert isinstance(agent.fallbacks, int)
    image = agent.belief_image()
    if name == "random":
        assert image is None
    else:
        assert len(agent.decision_seconds) == pytest.approx(len(track) / 5, abs=1)
        assert image is not None and np.nansum(image) == pytest.approx(1.0)
    state = json.loads(json.dumps(agent.learned_state()))
    assert state is None, "no planner takes anything from one episode into the next"


@pytest.mark.parametrize("ego_task", ["avoidance", "surveillance"])
@pytest.mark.parametrize("name", ["S-POMCP", "FP-POMCP", "TAB-POMCP", "population-POMCP"])
def test_every_model_takes_the_other_tasks(name: str, ego_task: str) -> None:
    """No adversary in reach: the avoiding ego makes for its goal, the watching one for the adversary; both plan."""
    scenario = WAIT.scenario.for_task(ego_task, Disc(0.3, 0.3, 0.2) if ego_task == "avoidance" else None)  # type: ignore[arg-type]
    agent = make_planner(name, SMALL)
    _outcome, track = play(agent, replace(WAIT, scenario=scenario), seed=5, seconds=4.0)
    assert agent.decision.plan is None
    moved = {"avoidance": (0.3, 0.3), "surveillance": (2.5, 0.5)}[ego_task]
    assert math.dist(track[-1][:2], moved) < math.dist(track[0][:2], moved) - 0.2


def test_the_parts_of_a_decision_are_those_of_its_time() -> None:
    agent = make_planner("TAB-POMCP", SMALL)
    play(agent, WAIT, seed=2, seconds=4.0)
    parts = np.array(agent.decision_parts)
    assert parts.shape == (len(agent.decision_seconds), 4)
    assert (parts > 0).all()
    assert parts.sum() <= np.sum(agent.decision_seconds) + 1e-3


@pytest.mark.parametrize("name", GOAL_AWARE)
def test_where_waiting_at_the_only_goal_wins_it_is_won(name: str) -> None:
    """The sanity bar: the ego is there first, whatever way the adversary takes."""
    agent = make_planner(name, SMALL)
    for seed, via in enumerate([None, (2.6, 2.4), (0.5, 0.6)]):
        assert play(agent, WAIT, seed, via)[0] == "met", (name, via)


def test_mle_begins_every_episode_with_the_development_policies_moves() -> None:
    """What it counts within an episode is its own, and gone with the episode."""
    agent = make_planner("MLE-POMCP", SMALL)
    first = pretrained().to_json()
    play(agent, WAIT, seed=1, via=(2.4, 1.2), seconds=8.0)
    assert agent.moves.to_json() != first  # type: ignore[attr-defined]
    assert np.sum(agent.moves.counts) > np.sum(first["counts"]) + 2  # type: ignore[attr-defined]
    agent.reset(WAIT, np.random.default_rng(0))
    assert agent.moves.to_json() == first  # type: ignore[attr-defined]


def test_mle_carries_moves_where_that_is_asked_for_and_forgets_on_request() -> None:
    agent = make_planner("MLE-POMCP", replace(SMALL, moves=untrained(), carries_moves=True))
    play(agent, WAIT, seed=1, via=(2.4, 1.2), seconds=8.0)
    learned = agent.learned_state()
    assert learned is not None and np.sum(learned["counts"]) > 2
    agent.reset(WAIT, np.random.default_rng(0))
    assert agent.learned_state() == learned
    again = make_planner("MLE-POMCP", replace(SMALL, moves=untrained(), carries_moves=True))
    again.restore(json.loads(json.dumps(learned)))
    assert again.learned_state() == learned
    agent.restore(None)
    state = agent.learned_state()
    assert state is not None and np.sum(state["counts"]) == 0


@pytest.mark.parametrize("mission", ["M1", "M2", "M3", "M4", "M5"])
def test_goal_places_are_waypoints_for_every_mission_type(mission: str) -> None:
    task = sample_task(np.random.default_rng(12345), mission, "ambiguous")
    places = goal_places(task)
    assert len(places) >= 3
    agent = make_planner("random", SMALL)
    agent.reset(task, np.random.default_rng(0))
    for place in places:
        assert np.hypot(*(agent.routes.waypoints - place).T).min() < 0.2  # type: ignore[attr-defined]


def test_with_precedents_the_belief_is_partly_theirs() -> None:
    plain, shown = make_planner("TAB-POMCP", replace(SMALL, ways=None)), make_planner(PRECEDENTS, SMALL)
    play(plain, WAIT, seed=3, seconds=3.0)
    play(shown, WAIT, seed=3, seconds=3.0)
    model = shown._model
    assert isinstance(model, Mixture) and plain._model is not None
    field, mixed = plain.belief_image(), shown.belief_image()
    assert 0 < model.weights[1] < 1 and np.nansum(mixed) == pytest.approx(1.0)
    assert np.nanmax(np.abs(mixed - field)) > 1e-4


def test_tab_pomcp_expects_drawn_ways_beside_its_field_unless_told_not_to() -> None:
    both, alone = make_planner("TAB-POMCP", SMALL), make_planner("TAB-POMCP", replace(SMALL, ways=None))
    for agent in (both, alone):
        play(agent, WAIT, seed=3, seconds=3.0)
    assert isinstance(both._model, Mixture) and isinstance(alone._model, FieldModel)
    field, ways = both._model.models
    assert isinstance(field, FieldModel) and isinstance(ways, TrajectoryPool)
    assert len(ways.positions) == WaysOptions().drivers * WaysOptions().starts_each
    assert 0 < both._model.weights[1] < 1
    assert np.nanmax(np.abs(both.belief_image() - alone.belief_image())) > 1e-4


def test_unknown_planners_are_refused_with_the_nearest_name() -> None:
    with pytest.raises(UnknownName, match="did you mean 'TAB-POMCP'"):
        make_planner("TAB-POMPC")
    with pytest.raises(ValueError, match=r"PlannerOptions.particles is 0"):
        PlannerOptions(particles=0)
