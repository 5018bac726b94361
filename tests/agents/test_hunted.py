"""The hunted world: what being caught costs, the same seed's same episodes, and going on after a kill."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tab_marl.agents.adversaries import ScriptedAdversary
from tab_marl.agents.hunted.egos import hunter_names, hunting_options
from tab_marl.agents.hunted.env import REWARDS, HuntedVecEnv, hunted_env, hunted_tasks
from tab_marl.agents.hunted.play import play_hunted
from tab_marl.agents.planner_memory import PlannerMemory
from tab_marl.agents.planners import PlannerOptions, make_planner
from tab_marl.agents.training.env import HELD_OUT, draw_tasks
from tab_marl.agents.training.settings import TrainingSettings
from tab_marl.envs.adversary_observation import AdversaryTask
from tab_marl.envs.batched import Bank, BatchedWorld, Prices
from tab_marl.envs.batched_arenas import BatchedArenas
from tab_marl.envs.styles import Style
from tab_marl.mission.tasks import Task
from tab_marl.planning.pursuit.itineraries import PursuitOptions
from tab_marl.world.scenario import UnknownName

SEEN = 0.8


@pytest.fixture(scope="module")
def tasks() -> list[Task]:
    return draw_tasks(HELD_OUT, 8, 4, ("M1", "M4"), ("ambiguous", "point"))


@pytest.fixture(scope="module")
def built(tasks: list[Task]) -> list[AdversaryTask]:
    return hunted_tasks(tasks, Style("fickle", order_metres=6.0), 0, 2, SEEN)


def kinds(tasks: list[Task], draws: int = 2) -> list[str]:
    return [task.mission_id for task in tasks for _ in range(draws)]


def test_being_caught_ends_the_episode_and_costs_what_is_said(tasks: list[Task], built: list[AdversaryTask]) -> None:
    # The twin is the unopposed batched world: it pays the same until the robots meet.
    free = replace(REWARDS, collision=0.0)
    env = HuntedVecEnv(built, kinds(tasks), 12, 0, "pursue", rewards=free)
    prices = Prices(touch=0.0, tick=0.0, visit=1.0, completed=free.completed, failed=free.failed)
    twin = BatchedWorld(Bank.of(built), 12, np.random.default_rng(0), prices)
    policy = ScriptedAdversary()
    observation = env.reset()
    twin.task[:] = env.arenas.task
    from tab_marl.envs import batched_kernels

    starts = env.arenas.robots[:, 1, :3].copy()
    twin.ghost[:] = (1e6, 1e6, 0, 0, 0)
    batched_kernels.start_many(
        twin.bank.tables, twin.task, starts, twin.state, twin.location, twin.clocks, twin.memory, twin.ghost, 0.0,
        twin.potential, twin.observation,
    )  # fmt: skip
    first = np.ones(12, dtype=bool)
    caught = completed = 0
    for _ in range(700):
        action = policy.act(observation)
        observation, reward, done, infos = env.step(action)
        twin.step(action)
        # Metres a step can bring: top speed x 0.1 s, over the route's grid.
        for i in np.flatnonzero(first & done):
            if infos[i]["intercepted"]:
                caught += 1
                assert reward[i] == pytest.approx(free.intercepted, abs=0.12)
            else:
                completed += infos[i]["completed"]
                assert reward[i] == pytest.approx(twin.reward[i], abs=1e-4)
        going = first & ~done
        np.testing.assert_allclose(reward[going], twin.reward[going], atol=1e-4)
        first = going
        if not first.any():
            break
    assert caught >= 2
    assert completed >= 1
    assert not first.any()


@pytest.mark.parametrize("opponent", ["pursue", "FP-POMCP+TAB-POMCP"])
def test_same_seed_same_episodes_and_a_kill_changes_nothing(
    tasks: list[Task], built: list[AdversaryTask], opponent: str
) -> None:
    policy = ScriptedAdversary()

    def make(seed: int) -> HuntedVecEnv:
        return HuntedVecEnv(built, kinds(tasks), 3, seed, opponent)

    def play(env: HuntedVecEnv, steps: int) -> list[np.ndarray]:
        found = []
        for _ in range(steps):
            observation, reward, done, _ = env.step(policy.act(env.observation))
            found += [observation, reward, done]
        return found

    one, two, other = make(0), make(0), make(1)
    for env in (one, two, other):
        env.reset()
    early, again, differs = play(one, 25), play(two, 25), play(other, 25)
    assert all(np.array_equal(a, b) for a, b in zip(early, again, strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(early, differs, strict=True))
    arrays, text = one.snapshot()
    fresh = make(5)
    fresh.restore(arrays, text)
    assert fresh.recently_caught is not one.recently_caught
    assert all(fresh.recent[kind] is not one.recent[kind] for kind in one.recent)
    assert np.array_equal(fresh.observation, one.observation)
    late, resumed = play(one, 40), play(fresh, 40)
    assert all(np.array_equal(a, b) for a, b in zip(late, resumed, strict=True))
    assert fresh.snapshot()[1]["random"] == one.snapshot()[1]["random"]
    np.testing.assert_equal(fresh.success(), one.success())
    assert fresh.recently_caught == one.recently_caught


@pytest.mark.parametrize("name", ["FP-POMCP", "TAB-POMCP"])
def test_keeping_what_depends_on_the_task_changes_no_decision(
    tasks: list[Task], built: list[AdversaryTask], name: str
) -> None:
    search = PursuitOptions.for_milliseconds(5)
    memory = PlannerMemory()
    policy = ScriptedAdversary()

    def controls(options: PlannerOptions) -> np.ndarray:
        arenas = BatchedArenas(built[:1], 1)
        planner = make_planner(name, options)
        planner.reset(tasks[0], np.random.default_rng(3))
        ego, adversary = arenas.begin(np.arange(1), np.random.default_rng(4))
        found = []
        for _ in range(30):
            found.append(planner.act(ego[0]))
            outcome = arenas.step(found[-1][None], policy.act(adversary))
            ego, adversary = outcome.ego, outcome.adversary
        return np.array(found)

    alone = controls(PlannerOptions(pursuit=search))
    for _ in range(2):  # the second time everything comes from the memory
        assert np.array_equal(controls(PlannerOptions(pursuit=search, memory=memory)), alone)
    scenario, mission = tasks[0].scenario, tasks[0].mission
    options = PlannerOptions().tab_field
    assert memory.field(scenario, mission, options) is memory.field(scenario, mission, options)


def test_whole_episodes_are_the_same_whoever_plays_beside_them(built: list[AdversaryTask]) -> None:
    policy = ScriptedAdversary()
    together = play_hunted(policy, built[:4], ["pursue"] * 4, [1, 2, 3, 4])
    alone = play_hunted(policy, built[2:3], ["pursue"], [3])
    assert alone.end[0] == together.end[2]
    assert np.array_equal(alone.positions[0], together.positions[2, : alone.end[0] + 1])
    assert not (together.completed & together.caught).any()


def test_adversaries_see_the_ego_that_hunts_them(built: list[AdversaryTask], tasks: list[Task]) -> None:
    env = HuntedVecEnv(built, kinds(tasks), 8, 0, "pursue")
    env.reset()
    seen = 0
    for _ in range(150):
        observation, *_ = env.step(np.zeros((8, 2), dtype=np.float32))
        gap = np.hypot(*(env.arenas.robots[:, 0, :2] - env.arenas.robots[:, 1, :2]).T)
        shown = observation[:, 37] > 0
        assert (gap[shown] <= SEEN).all()
        seen += shown.sum()
    assert seen > 20


def test_settings_make_the_hunted_world(tasks: list[Task]) -> None:
    env = hunted_env(TrainingSettings(opponent="pursue", tasks=7, robots=2, missions=("M1",), families=("point",)))
    assert len(env.weights) == len(env.kinds) == 12  # two tasks, six draws each
    assert env.arenas.bank.tasks[0].scenario == env.arenas.bank.tasks[5].scenario


def test_unknown_egos_are_refused() -> None:
    assert hunter_names("pursue + TAB-POMCP") == ("pursue", "TAB-POMCP")
    with pytest.raises(UnknownName, match="TAB-POMCP"):
        hunter_names("TAB-POMPC")
    with pytest.raises(ValueError, match="sees the adversary always"):
        hunter_names("oracle")
    assert hunting_options().memory is not None
