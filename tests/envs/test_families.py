"""What is played: sampled missions on a given map, difficulty, the ladder, ego tasks on drawn maps, aware adversaries."""

from __future__ import annotations

import itertools
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from tab_marl.envs.intercept import InterceptEnv
from tab_marl.envs.ladder import DifficultyLadder
from tab_marl.envs.opponents import follow_route
from tab_marl.envs.single_agent import adversary_env, ego_env
from tab_marl.mission.curriculum import Curriculum
from tab_marl.mission.feasibility import check_feasible
from tab_marl.mission.tasks import FAMILIES, MISSION_IDS, Task, sample_task
from tab_marl.world.regions import Box
from tab_marl.world.scenario import Scenario, UnknownName

STILL = np.array([-1.0, 0.0], dtype=np.float32)


@pytest.mark.parametrize("mission_id", MISSION_IDS)
def test_missions_on_a_given_map(mission_id: str) -> None:
    lab = Scenario.preset("lab")
    goals = set()
    for seed in range(4):
        task = sample_task(np.random.default_rng(seed), mission_id, "point", scenario=lab)
        assert (task.scenario.checkpoints, task.scenario.obstacles) == (lab.checkpoints, lab.obstacles)
        assert check_feasible(task.mission, task.scenario) < task.scenario.horizon_seconds
        goals.add(task.mission.goals[-1].places)
    assert len(goals) > 1, "goals are drawn, not the map's first"


def test_maps_that_cannot_hold_a_mission_say_so() -> None:
    lab = Scenario.preset("lab")
    two = replace(lab, checkpoints=lab.checkpoints[:2])
    for mission_id, family, needed in (("M5", "point", 3), ("M1", "ambiguous", 4)):
        with pytest.raises(ValueError, match=f"'lab' has 2 checkpoints that can be goals of .*, needs {needed}"):
            sample_task(np.random.default_rng(0), mission_id, family, scenario=two)
    walls = (Box(0.0, 1.3, 3.0, 1.7), Box(1.3, 0.0, 1.7, 3.0))
    walled = replace(lab, obstacles=walls, checkpoints=(*lab.checkpoints[:3], lab.checkpoints[4]))
    with pytest.raises(
        RuntimeError, match=r"no winnable point M5 task with slack 2 found on scenario 'lab' in 200 draws"
    ):
        sample_task(np.random.default_rng(0), "M5", slack=2, scenario=walled)


@pytest.mark.parametrize("family", FAMILIES)
def test_difficulty_orders_tasks(family: str) -> None:
    """Harder: less slack, larger arenas, more obstacles, longer ways."""
    curriculum = Curriculum()
    figures = []
    for difficulty in (0.0, 0.5, 1.0):
        tasks = [curriculum.sample_task(np.random.default_rng(s), difficulty, "M1", family) for s in range(4)]
        apart = [np.hypot(*np.subtract(t.scenario.ego_start.centre, t.scenario.adversary_start.centre)) for t in tasks]
        figures.append(
            (
                -tasks[0].slack,
                tasks[0].scenario.width_metres,
                np.mean([len(t.scenario.obstacles) for t in tasks]),
                min(apart),
            )
        )
        assert min(apart) >= (0.6, 1.0, 1.4)[round(2 * difficulty)] - 1e-9
    assert all(easy < hard for a, b in itertools.pairwise(figures) for easy, hard in zip(a[:3], b[:3], strict=True))
    assert figures[0][:3] == (-3.0, 2.4, 0) and figures[2][:3] == (-1.2, 3.6, 6)


def test_difficulty_drives_an_environment() -> None:
    env = InterceptEnv(scenario="random", mission="any", difficulty=0.0)
    for difficulty, width in ((0.0, 2.4), (1.0, 3.6), (0.5, 3.0)):
        env.set_difficulty(difficulty)
        assert env.difficulty == difficulty
        observations, _ = env.reset(seed=1)
        assert env.task.scenario.width_metres == width
        assert env.observation_space("ego_0").contains(observations["ego_0"])
    env.reset(seed=1, options={"difficulty": 1.0})
    assert env.task.scenario.width_metres == 3.6 and env.difficulty == 0.5, "for one episode only"
    seen = set()
    for seed in range(8):
        env.reset(seed=seed)
        seen.add(env.task.mission_id)
    assert len(seen) >= 3, "missions of any type"


def test_a_curriculum_of_ones_own() -> None:
    flat = Curriculum(slack=(2.0, 2.0), side_metres=(3.0, 3.0), obstacles=(1, 4), far_metres=(1.0, 1.0))
    env = InterceptEnv(scenario="random", difficulty=0.0, curriculum=flat)
    for difficulty, boxes in ((0.0, 1), (1.0, 4)):
        env.reset(seed=0, options={"difficulty": difficulty})
        assert (len(env.task.scenario.obstacles), env.task.slack) == (boxes, 2.0)


def test_bad_difficulties_are_refused() -> None:
    with pytest.raises(ValueError, match=r"difficulty is 1.5, must lie in 0..1"):
        InterceptEnv(scenario="random", difficulty=1.5)
    with pytest.raises(ValueError, match=r"difficulty is 0.5: it needs drawn tasks"):
        InterceptEnv(difficulty=0.5)
    with pytest.raises(ValueError, match="has no curriculum"):
        InterceptEnv(scenario="random").set_difficulty(0.3)
    with pytest.raises(TypeError, match="difficulty is 'hard', must be a number"):
        InterceptEnv(scenario="random", difficulty="hard")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"Curriculum.slack is \(1.0, 2.0\), must be > 1"):
        Curriculum(slack=(1.0, 2.0))
    with pytest.raises(ValueError, match="where it is sampled it must be one of"):
        InterceptEnv(sampled=True, mission="U5")
    with pytest.raises(UnknownName, match="did you mean 'surveillance'"):
        InterceptEnv(ego_task="surveilance")  # type: ignore[arg-type]


def test_the_ladder_rises_with_success_and_falls_without() -> None:
    """The adversary wins by completing its mission: at once, by a decree, or never."""
    won = True
    env = DifficultyLadder(
        adversary_env("static", scenario="random", difficulty=0.0, max_cycles=1),
        window=3, step=0.25, easier_share=0.0, success=lambda info: won,
    )  # fmt: skip
    levels = []
    for episode in range(15):
        won = episode < 9
        _, info = env.reset(seed=episode)
        levels.append(info["difficulty"])
        env.step(STILL)
    assert levels == [0.0] * 3 + [0.25] * 3 + [0.5] * 3 + [0.75] * 3 + [0.5] * 3
    assert env.difficulty == 0.25


def test_the_ladder_mixes_in_easier_tasks_and_does_not_count_them() -> None:
    env = DifficultyLadder(
        gymnasium.make("tab_marl/Adversary-curriculum-v0", max_cycles=1), start=0.8, easier_share=0.5, window=1000
    )
    drawn = []
    for seed in range(30):
        _, info = env.reset(seed=seed)
        drawn.append(info["difficulty"])
        env.step(STILL)
    easier = [level for level in drawn if level < 0.8]
    assert 8 <= len(easier) <= 22 and max(drawn) == 0.8 and min(drawn) < 0.3
    assert len(env._window) == 30 - len(easier)
    assert env.reset(seed=4)[1]["difficulty"] == drawn[4]
    assert env.reset(options={"difficulty": 0.1})[1]["difficulty"] == 0.1


def test_the_ladders_judges() -> None:
    """A real win: the follower completes an easy mission while the ego stands still; the standing ego has not won."""
    ladder = DifficultyLadder(adversary_env("static", scenario="random", difficulty=0.0), window=1, step=0.1)
    observation, info = ladder.reset(seed=1)
    over = False
    while not over:
        observation, _, terminated, truncated, info = ladder.step(follow_route(observation, 0.182))
        over = terminated or truncated
    assert info["mission_status"] == "completed" and ladder.difficulty == 0.1
    ladder = DifficultyLadder(ego_env("static", scenario="random", difficulty=0.0, max_cycles=2), 0.5, window=1)
    ladder.reset(seed=1)
    ladder.step(STILL), ladder.step(STILL)
    assert ladder.difficulty == 0.45
    with pytest.raises(ValueError, match="needs an environment with a curriculum"):
        DifficultyLadder(ego_env())
    with pytest.raises(ValueError, match=r"fall is 0.9 and rise is 0.8"):
        DifficultyLadder(ladder.env, fall=0.9)


@pytest.mark.parametrize("ego_task", ["avoidance", "surveillance"])
def test_ego_tasks_on_drawn_maps(ego_task: str) -> None:
    env = InterceptEnv(scenario="random", mission="any", ego_task=ego_task)  # type: ignore[arg-type]
    for seed in range(4):
        observations, infos = env.reset(seed=seed)
        assert env.observation_space("ego_0").contains(observations["ego_0"])
        assert env.task.scenario.ego_task == env.ego_task == ego_task
        assert ("arrived" in infos["ego_0"]) == (ego_task == "avoidance")


def test_the_scripted_ego_arrives(reach_a: Task) -> None:
    """Round the obstacles of drawn maps; nobody is in its way."""
    arrived = 0
    for seed in range(3):
        env = adversary_env("arrive", scenario="random", ego_task="avoidance", end_on_completion=False)
        env.reset(seed=seed)
        over, info = False, {}
        while not over:
            *_, terminated, truncated, _ = env.step(STILL)
            over = terminated or truncated
        arrived += env.inner.episode.arrived
        assert not env.inner.episode.arena.touching[0], info
    assert arrived >= 2
    with pytest.raises(ValueError, match="the scripted ego 'arrive' needs a goal"):
        adversary_env("arrive", task=reach_a).reset(seed=0)


def test_aware_adversaries_by_argument() -> None:
    near = {"ego_start": (1.5, 1.0, 0.0), "adversary_start": (1.5, 0.4, 0.0)}
    for metres, expected in ((None, 0.0), (1.0, 1.0), (0.5, 0.0)):
        env = InterceptEnv(adversary_sees_ego_metres=metres)
        observations, _ = env.reset(seed=0, options=near)
        assert observations["adversary_0"][37] == expected
    with pytest.raises(ValueError, match="adversary_sees_ego_metres is -1"):
        InterceptEnv(adversary_sees_ego_metres=-1.0)


def test_an_episode_of_another_ego_task_ends_with_it_not_with_the_mission() -> None:
    ends = {
        task: ego_env(scenario=scenario).inner.end_on_completion
        for task, scenario in (
            ("interception", "lab"),
            ("avoidance", "lab-avoidance"),
            ("surveillance", "lab-surveillance"),
        )
    }
    assert ends == {"interception": True, "avoidance": False, "surveillance": False}
    assert ego_env(scenario="lab-surveillance", end_on_completion=True).inner.end_on_completion
