"""Several egos and adversaries: one against one is the paper's environment, and what several add, by hand."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tab_marl.envs.ego_observation import ego_rows, parse_adversaries
from tab_marl.envs.intercept import InterceptEnv
from tab_marl.envs.opponents import follow_route
from tab_marl.envs.single_agent import adversary_env, ego_env
from tab_marl.envs.team import TeamEnv
from tab_marl.mission import Constraint, ConstraintType, Mission
from tab_marl.mission.feasibility import check_feasible
from tab_marl.mission.tasks import MISSION_IDS, Task, sample_task
from tab_marl.mission.teams import APART_METRES, TeamTask, joined, sample_team_task
from tab_marl.world.regions import Disc
from tab_marl.world.scenario import Scenario

FORWARD = np.array([1.0, 0.0], dtype=np.float32)
STILL = np.array([-1.0, 0.0], dtype=np.float32)
DOT = 1e-6
"""Radius of a start region that is a point."""


def standing(task: Task, egos: list[tuple[float, float]], adversaries: list[tuple[float, float]]) -> TeamTask:
    """Robots at these places, each adversary with the mission of `task`."""
    tasks = [
        replace(task, scenario=replace(task.scenario, adversary_start=Disc(x, y, DOT))) for x, y in adversaries
    ]  # fmt: skip
    return joined(tasks, [Disc(x, y, DOT) for x, y in egos])


def face(env: TeamEnv, agent: str, heading: float) -> None:
    """Turn an agent on the spot until it looks that way; all others stand still."""
    i = env.possible_agents.index(agent)
    for _ in range(40):
        error = math.remainder(heading - env.episode.motions[i].theta, math.tau)
        if abs(error) < 1e-6:
            return
        turn = np.array([-1.0, np.clip(error / 0.182, -1.0, 1.0)])
        env.step({a: turn if a == agent else STILL for a in env.agents})


@pytest.mark.parametrize("mission_id", ["M1", "M3", "M5"])
def test_one_against_one_is_the_papers_environment(mission_id: str) -> None:
    """Same observations, rewards, endings and infos to the last bit, until interception or the horizon."""
    intercepted = 0
    for seed in range(4):
        task = sample_task(np.random.default_rng(seed), mission_id)
        paper = InterceptEnv(task=replace(task, scenario=replace(task.scenario, interception_metres=0.6)))
        task = replace(task, scenario=replace(task.scenario, interception_metres=0.6))
        paper.reset(seed=seed)
        starts = [(m.x, m.y, m.theta) for m in paper.episode.motion]
        observations, _ = paper.reset(seed=seed, options={"ego_start": starts[0], "adversary_start": starts[1]})
        team = TeamEnv(1, 1, task=joined([task], [task.scenario.ego_start]))
        team.reset(seed=seed)
        _begin_at(team, starts)
        assert team.observation_space("ego_0") == paper.observation_space("ego_0")
        assert team.state_space == paper.state_space
        rng = np.random.default_rng(seed)
        assert np.array_equal(team.state(), paper.state())
        while paper.agents:
            actions = {
                "ego_0": np.array([1.0, rng.uniform(-1, 1)]),
                "adversary_0": follow_route(observations["adversary_0"], 0.182),
            }
            observations, rewards, *ends, infos = paper.step(actions)
            shown, paid, *endings, told = team.step(actions)
            for agent in ("ego_0", "adversary_0"):
                assert np.array_equal(shown[agent], observations[agent])
            assert paid == pytest.approx(rewards, abs=1e-12) and endings == ends and team.agents == paper.agents
            assert np.array_equal(team.state(), paper.state())
            common = ("physics_steps", "collided", "mission_status", "why_failed", "completed_seconds", "intercepted")
            assert {k: told["adversary_0"][k] for k in common} == {k: infos["adversary_0"][k] for k in common}
        intercepted += paper.episode.intercepted
    assert intercepted > 0 or mission_id != "M1"


def _begin_at(team: TeamEnv, starts: list[tuple[float, float, float]]) -> None:
    """Begin the running episode anew at given poses."""
    from tab_marl.envs.team_episode import TeamEpisode

    episode = team.episode
    team._episode = TeamEpisode(episode.team, episode.monitors, starts[:1], starts[1:])
    for side in team._sides:
        side._observer.reset()
    team._observe()


def test_each_adversary_is_intercepted_by_itself(reach_a: Task) -> None:
    """The second ego catches the second adversary, which leaves; the others drive on until the first is caught as well."""
    env = TeamEnv(2, 2, task=standing(reach_a, [(2.7, 0.3), (1.5, 0.6)], [(2.7, 1.5), (0.9, 0.6)]))
    env.reset(seed=0)
    face(env, "ego_1", math.pi)
    infos: dict[str, Any] = {}
    while len(env.agents) == 4:
        living = list(env.agents)
        shown, rewards, terminations, truncations, infos = env.step(
            {a: FORWARD if a == "ego_1" else STILL for a in living}
        )
    gone = env.episode.motions[3]
    assert env.agents == ["ego_0", "ego_1", "adversary_0"]
    assert terminations == {"ego_0": False, "ego_1": False, "adversary_0": False, "adversary_1": True}
    assert not any(truncations.values())
    assert infos["adversary_1"]["intercepted"] and not infos["adversary_0"]["intercepted"]
    assert (infos["ego_0"]["interceptions"], infos["ego_1"]["interceptions"]) == (0, 1)
    assert env.episode.captor == [None, 1] and infos["ego_0"]["in_play"] == 1
    # Both egos are paid for it; the adversary pays.
    assert rewards["ego_0"] == pytest.approx(50 - 0.2) and rewards["ego_1"] == pytest.approx(50 - 0.2 - 0.02 * 0.22**2)
    assert rewards["adversary_1"] == pytest.approx(-50.02) and rewards["adversary_0"] == pytest.approx(-0.02)
    # The body has left: the ego drives through where it stood, and sees nothing there any more.
    for _ in range(30):
        shown, *_ = env.step({a: FORWARD if a == "ego_1" else STILL for a in env.agents})
        assert set(shown) == {"ego_0", "ego_1", "adversary_0"}
    ego = env.episode.motions[1]
    assert ego.x < gone.x - 0.2 and abs(ego.y - 0.6) < 1e-6
    rows = [row.name for row in ego_rows(env.task.scenario, 2, 2)]
    assert shown["ego_0"][rows.index("adversary 0 in play")] == 1.0
    assert shown["ego_0"][rows.index("adversary 1 in play")] == 0.0
    assert shown["ego_0"][rows.index("other ego 0 x")] == pytest.approx(ego.x)
    face(env, "ego_0", math.pi / 2)
    while env.agents:
        _, rewards, terminations, _, infos = env.step({a: FORWARD if a == "ego_0" else STILL for a in env.agents})
    assert all(terminations.values()) and set(terminations) == {"ego_0", "ego_1", "adversary_0"}
    assert infos["ego_0"]["interceptions"] == 1 and infos["ego_0"]["in_play"] == 0
    assert rewards["ego_1"] == pytest.approx(50 - 0.2)
    with pytest.raises(RuntimeError, match="the episode is over"):
        env.step({"ego_0": STILL})


def test_copies_after_an_interception_go_on_exactly(reach_a: Task) -> None:
    """Restoring replays the removal of the body as well."""
    env = TeamEnv(2, 2, task=standing(reach_a, [(2.7, 0.3), (1.5, 0.6)], [(2.7, 1.5), (0.9, 0.6)]))
    env.reset(seed=0)
    face(env, "ego_1", math.pi)
    while len(env.agents) == 4:
        env.step({a: FORWARD if a == "ego_1" else STILL for a in env.agents})
    for _ in range(5):
        env.step({a: FORWARD for a in env.agents})
    twin = pickle.loads(pickle.dumps(env))
    for _ in range(40):
        a, b = (e.step({agent: FORWARD for agent in e.agents}) for e in (env, twin))
        assert a[1:] == b[1:] and np.array_equal(env.state(), twin.state())


def test_each_adversary_has_its_own_mission(reach_a: Task) -> None:
    """Left alone, one completes and stays; with `end_on_completion` it leaves, and the egos are charged once for each."""
    reach_b = Mission((Constraint(ConstraintType.DEADLINE, ("Checkpoint B",), seconds=12.0),), "reach B")
    for ends in (False, True):
        team = standing(reach_a, [(2.6, 2.6), (2.0, 2.6)], [(0.5, 1.9), (1.5, 0.4)])
        team = replace(team, tasks=(team.tasks[0], replace(team.tasks[1], mission=reach_b)))
        env = TeamEnv(2, 2, task=team, end_on_completion=ends)
        env.reset(seed=0)
        face(env, "adversary_0", math.pi / 2)
        total, last = 0.0, {}
        while env.agents and env.episode.seconds < 13.0:
            _, rewards, terminations, _, infos = env.step(
                {a: FORWARD if a == "adversary_0" and env.episode.motions[2].y < 2.4 else STILL for a in env.agents}
            )
            last.update(infos), last.update({f"end {a}": t for a, t in terminations.items()})
            total += rewards["ego_0"]
        assert last["adversary_0"]["mission_status"] == "completed"
        assert (
            last["adversary_1"]["mission_status"] == "failed" and "deadline 12 s" in last["adversary_1"]["why_failed"]
        )
        assert last["end adversary_0"] == last["end adversary_1"] == ends
        spent = env.episode.control_steps * 0.2
        assert total == pytest.approx(-50.0 - spent, abs=3.0), "one mission completed, one failed"
        assert bool(env.agents) != ends, "the egos' episode ends when nobody is left in play"


def test_egos_see_every_adversary_under_a_camera(reach_a: Task) -> None:
    places = [(0.5, 2.5), (1.5, 0.6), (2.5, 0.5)]
    env = TeamEnv(1, 3, task=standing(reach_a, [(2.7, 2.7)], places))
    observations, _ = env.reset(seed=0)
    seen = parse_adversaries(observations["ego_0"], 3)
    assert [a is not None for a in seen] == [True, False, True]
    assert (seen[2].x, seen[2].y) == pytest.approx(places[2], abs=1e-5)  # type: ignore[union-attr]
    oracle = TeamEnv(1, 3, task=standing(reach_a, [(2.7, 2.7)], places), full_observation=True)
    observations, _ = oracle.reset(seed=0)
    assert all(a is not None for a in parse_adversaries(observations["ego_0"], 3))


def test_an_adversary_notices_the_nearest_ego(reach_a: Task) -> None:
    team = standing(reach_a, [(1.4, 0.6), (0.9, 0.6), (2.7, 2.7)], [(0.4, 0.6)])
    env = TeamEnv(3, 1, task=team, adversary_sees_ego_metres=1.2)
    observations, _ = env.reset(seed=0)
    noticed, forward, left = observations["adversary_0"][37:40]
    assert noticed == 1.0 and math.hypot(forward, left) == pytest.approx(0.5, abs=1e-4)


@pytest.mark.parametrize("robots", [(2, 2), (3, 1), (1, 3)])
def test_drawn_teams_are_apart_and_their_missions_possible(robots: tuple[int, int]) -> None:
    egos, adversaries = robots
    for seed in range(3):
        rng = np.random.default_rng(seed)
        ids = [MISSION_IDS[(seed + j) % 5] for j in range(adversaries)]
        team = sample_team_task(rng, ids, egos)
        assert team == sample_team_task(np.random.default_rng(seed), ids, egos)
        starts = [*team.ego_starts, *(t.scenario.adversary_start for t in team.tasks)]
        for i, a in enumerate(starts):
            assert all(math.dist(a.centre, b.centre) >= APART_METRES for b in starts[i + 1 :])
        for task, mission_id in zip(team.tasks, ids, strict=True):
            assert task.mission_id == mission_id
            assert check_feasible(task.mission, task.scenario) <= task.scenario.horizon_seconds


def test_teams_on_a_preset_fit_each_adversarys_own_start() -> None:
    env = TeamEnv(3, 4, mission=("M1", "M2", "M4", "M5"))
    env.reset(seed=0)
    deadlines = [task.mission for task in env.task.tasks]
    assert [m.name for m in deadlines] == ["M1", "M2", "M4", "M5"]
    for task in env.task.tasks:
        assert check_feasible(task.mission, task.scenario) <= task.scenario.horizon_seconds
    assert len({task.scenario.adversary_start for task in env.task.tasks}) == 4


@pytest.mark.parametrize("make", [ego_env, adversary_env])
def test_the_view_of_one_robot_in_a_team(make: Any) -> None:
    """Every other robot has a player of its own; the scripted ones do what they are for."""
    env = make(scenario="random", mission="any", egos=2, adversaries=2)
    assert len({id(player) for player in env._players.values()}) == 3
    observation, _ = env.reset(seed=3)
    moved = [(m.x, m.y) for m in env.inner.episode.motions]
    over = False
    while not over:
        observation, _, terminated, truncated, _ = env.step(STILL)
        assert env.observation_space.contains(observation)
        over = terminated or truncated
    ways = [math.dist(a, (m.x, m.y)) for a, m in zip(moved, env.inner.episode.motions, strict=True)]
    own = env.inner.possible_agents.index(f"{env.side}_0")
    assert ways[own] < 1e-9 and max(ways) > 0.5
    with pytest.raises(RuntimeError, match="the episode is over"):
        env.step(STILL)


def test_pursuers_of_a_team_catch_waiting_adversaries(reach_a: Task) -> None:
    """Each goes for the seen adversary that is nearest to itself."""
    team = standing(reach_a, [(1.5, 2.75), (1.5, 0.3)], [(0.5, 2.5), (2.5, 0.5)])
    env = TeamEnv(2, 2, task=team)
    from tab_marl.envs.opponents import Pursue

    players = [Pursue(2), Pursue(2)]
    observations, _ = env.reset(seed=0)
    for player in players:
        player.reset(env.task_of("ego_0"), np.random.default_rng(0))
    while env.agents and env.episode.seconds < 20:
        egos = {f"ego_{k}": players[k].act(observations[f"ego_{k}"]) for k in range(2)}
        observations, *_ = env.step({a: egos.get(a, STILL) for a in env.agents})
    assert env.episode.captor == [0, 1]


def test_misuse_is_told(reach_a: Task) -> None:
    with pytest.raises(ValueError, match=r"egos is 0, must lie in 1..16"):
        TeamEnv(0, 1)
    with pytest.raises(ValueError, match="mission has 3 entries, must be one for each of the 2 adversaries"):
        TeamEnv(mission=("M1", "M2", "M3"))
    with pytest.raises(ValueError, match="'perimeter', which widens a mission's goal"):
        TeamEnv(scenario="random", family="perimeter")
    with pytest.raises(ValueError, match="teams play interception only"):
        TeamEnv(scenario="lab-surveillance")
    with pytest.raises(ValueError, match="no room for a robot beside the"):
        TeamEnv(16, 16)
    with pytest.raises(ValueError, match="for 1 egos and 2 adversaries, the environment for 2 and 2"):
        TeamEnv(2, 2, task=standing(reach_a, [(2.6, 2.6)], [(0.4, 0.4), (0.4, 1.0)]))
    other = replace(reach_a, scenario=replace(Scenario.preset("lab"), name="other"))
    with pytest.raises(ValueError, match=r"tasks\[1\] is on another scenario"):
        TeamTask((reach_a, other), (Disc(1, 1, 0.1),))
    with pytest.raises(ValueError, match="leave no places for 2 egos"):
        TeamEnv(2, 1, task=standing(reach_a, [(2.6, 2.6), (2.6, 2.55)], [(0.4, 0.4)])).reset(seed=0)
