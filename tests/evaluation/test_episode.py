"""Real episodes: bookkeeping against an independent referee, determinism, errors that become rows."""

import dataclasses
import math

import numpy as np
import pytest

from tab_marl.agents.adversaries import ScriptedAdversary
from tab_marl.agents.planners import make_planner
from tab_marl.envs.intercept_v0 import parallel_env
from tab_marl.evaluation import episode
from tab_marl.evaluation.adversaries import SCRIPTED
from tab_marl.evaluation.episode import play_unit, run_episode
from tab_marl.evaluation.errors import Interrupted
from tab_marl.evaluation.units import Job, Unit
from tab_marl.mission import parse_mission
from tab_marl.mission.tasks import Task
from tab_marl.world.scenario import Scenario


def lab_task(text="Reach Checkpoint A within 16s", **changes):
    scenario = dataclasses.replace(Scenario.preset("lab"), **changes)
    return Task(scenario, parse_mission(text, scenario), "M1", "point", 1.8)


class Parked:
    """An ego that never moves."""

    name, full_observation, fallbacks = "parked", False, 0

    def __init__(self):
        self.decision_seconds = []

    def reset(self, task, rng):
        self.decision_seconds = []

    def act(self, observation):
        return np.array([-1.0, 0.0], dtype=np.float32)

    def belief_image(self):
        return None

    def learned_state(self):
        return None

    def restore(self, state):
        pass


def test_an_unhindered_adversary_completes_its_mission():
    task = lab_task(horizon_seconds=20.0)
    played = run_episode(task, Parked(), ScriptedAdversary(), 5, trace=True, index=7)
    row = played.row
    assert (row.planner, row.adversary, row.seed, row.mission) == ("parked", "scripted", 7, "M1")
    assert row.completed and not row.intercepted and not row.failed and row.censored
    assert row.physics_steps == row.horizon_steps == 2000
    # By an independent look at the trace: the first control step with the centre inside the disc.
    goal = task.scenario.region("Checkpoint A")
    steps = [k for k, p in enumerate(played.trace.poses) if math.dist(p[3:5], goal.centre) <= goal.radius + 1e-9]
    assert row.completed_step == 10 * steps[0] <= 1600
    assert ("mission completed") in [text for _, text in played.trace.events]
    assert len(played.trace.poses) == 201


def test_interception_is_counted_in_physics_steps():
    scenario = Scenario.preset("lab")
    beside = dataclasses.replace(scenario.region("Checkpoint A"), radius=0.05)
    task = lab_task(ego_start=beside, horizon_seconds=20.0)  # parked at the goal: the adversary drives into it
    played = run_episode(task, Parked(), ScriptedAdversary(), 5, trace=True)
    row = played.row
    assert row.intercepted and row.physics_steps < 1600
    last = played.trace.poses[-1]
    assert math.dist(last[0:2], last[3:5]) <= scenario.interception_metres + 1e-9
    before = played.trace.poses[-2]
    assert math.dist(before[0:2], before[3:5]) > scenario.interception_metres
    assert 10 * (len(played.trace.poses) - 2) < row.physics_steps <= 10 * (len(played.trace.poses) - 1)
    assert played.trace.events[-1] == (row.physics_steps / 100, "intercepted")


def test_a_broken_deadline_is_a_failed_mission():
    row = run_episode(lab_task("Reach Checkpoint A within 9s", horizon_seconds=20.0), Parked(), Idle(), 1).row
    assert row.failed and not row.completed and not row.intercepted


class Idle(ScriptedAdversary):
    def act(self, observation):
        return np.array([-1.0, 0.0], dtype=np.float32)


def test_same_seed_same_row_and_trace_and_a_trace_changes_nothing():
    task = lab_task(horizon_seconds=12.0)
    first = run_episode(task, make_planner("TAB-POMCP"), ScriptedAdversary(), 3, trace=True)
    again = run_episode(task, make_planner("TAB-POMCP"), ScriptedAdversary(), 3, trace=True)
    bare = run_episode(task, make_planner("TAB-POMCP"), ScriptedAdversary(), 3)
    assert first.row == again.row == bare.row
    assert first.trace.poses == again.trace.poses
    # A belief is recorded one step after each decision, unless the episode ended with that step.
    assert [k for k, _ in first.trace.beliefs] == list(range(0, len(first.trace.poses) - 2, 5))
    for _, image in first.trace.beliefs:
        assert image.shape == (30, 30) and image.sum() == pytest.approx(1.0, abs=1e-6)
    assert first.timing.decisions == len(range(0, len(first.trace.poses) - 1, 5))
    other = run_episode(task, make_planner("TAB-POMCP"), ScriptedAdversary(), 4, trace=True)
    assert other.trace.poses[0] != first.trace.poses[0]


def test_the_environment_sees_the_same_starts_whoever_plans():
    task = lab_task()
    starts = {
        run_episode(task, planner, ScriptedAdversary(), 9, trace=True, max_steps=2).trace.poses[0]
        for planner in (Parked(), make_planner("random"), make_planner("oracle"))
    }
    assert len({pose[:6] for pose in starts}) == 1
    env = parallel_env(task=task)
    env.reset(seed=9)
    assert (env.episode.motion[0].x, env.episode.motion[1].x) in {(p[0], p[3]) for p in starts}


def job(**changes):
    base = Job(Unit("M1", "point", 0), ("random",), 11, None, (SCRIPTED,), "default")
    return dataclasses.replace(base, **changes)


def test_an_episode_that_breaks_down_is_a_row(monkeypatch):
    def broken(name, options=None):
        if name == "FP-POMCP":
            raise RuntimeError("the wheels\ncame off")
        return make_planner(name, options)

    monkeypatch.setattr(episode, "make_planner", broken)
    bad, good = play_unit(job(planners=("FP-POMCP", "random")))
    assert bad.row.error == "RuntimeError: the wheels came off"
    assert bad.row.physics_steps == bad.row.horizon_steps == good.row.horizon_steps > 0
    assert (bad.row.seed, bad.row.adversary, bad.row.slack) == (0, "scripted", good.row.slack)
    assert "came off" in bad.timing.traceback
    assert good.row.error is None


def test_a_workers_first_episode_is_the_row_that_any_other_would_be(monkeypatch):
    """It is warmed up with its own first moments: other options or another seed may break down where it does not."""

    def planner(name, options=None):
        if options is None:
            raise RuntimeError("other options")
        return make_planner(name, options)

    def env(**arguments):
        made = parallel_env(**arguments)
        reset = made.reset

        def reset_unless_0(seed):
            if seed == 0:
                raise RuntimeError("another seed")
            return reset(seed=seed)

        made.reset = reset_unless_0
        return made

    (usual,) = play_unit(job())
    monkeypatch.setattr(episode, "make_planner", planner)
    monkeypatch.setattr(episode, "parallel_env", env)
    monkeypatch.setattr(episode, "_warmed", set())
    (first,) = play_unit(job())
    assert first.row == usual.row and first.row.error is None


def test_a_task_that_cannot_be_drawn_is_a_row(monkeypatch):
    def nothing(*_):
        raise RuntimeError("no winnable task")

    monkeypatch.setattr(episode, "sample_task", nothing)
    (played,) = play_unit(job())
    assert played.row.error == "RuntimeError: no winnable task" and math.isnan(played.row.slack)


def test_nothing_learned_of_one_adversary_is_carried_to_the_next():
    """A planner's data come from the development policies; a table's rows do not depend on one another."""
    (first,) = play_unit(job(planners=("MLE-POMCP",)))
    (again,) = play_unit(job(planners=("MLE-POMCP",), learned=first.row.learned))
    assert first.row.learned is None and again.row == first.row
    (broken,) = play_unit(job(planners=("MLE-POMCP",), adversaries=("/no/such/folder",)))
    assert broken.row.error.startswith("PolicyError")


def test_stopping_is_not_an_error():
    with pytest.raises(Interrupted):
        run_episode(lab_task(), Parked(), ScriptedAdversary(), 0, should_stop=lambda: True)
