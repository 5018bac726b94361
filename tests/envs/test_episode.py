"""Interception, collisions, cameras and the mission within one episode."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tab_marl.envs import episode as module
from tab_marl.envs.episode import Episode, check_start, draw_starts
from tab_marl.mission.monitor import Monitor
from tab_marl.mission.tasks import Task
from tab_marl.world.grid import free_points
from tab_marl.world.regions import Disc
from tab_marl.world.scenario import Scenario

STILL = (0.0, 0.0)
AHEAD = (0.22, 0.0)


def begin(task: Task, ego: tuple[float, float, float], adversary: tuple[float, float, float]) -> Episode:
    return Episode(task, Monitor(task.mission, task.scenario, 0.1), ego, adversary)


@pytest.mark.parametrize("gap", [0.3051, 0.35, 0.4217, 0.7, 1.003])
def test_interception_at_the_exact_substep(reach_a: Task, gap: float) -> None:
    """Head on, the gap shrinks by 4.4 mm a substep: the count follows."""
    episode = begin(reach_a, (1.0 + gap, 0.6, math.pi), (1.0, 0.6, 0.0))
    for _ in range(100):
        if episode.step(AHEAD, AHEAD).intercepted:
            break
    assert episode.intercepted
    assert episode.physics_steps == math.ceil((gap - 0.3) / (2 * 0.22 * 0.01) - 1e-9)
    assert episode.seconds == pytest.approx(episode.physics_steps / 100)


def test_watching_every_substep_changes_nothing(reach_a: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    """Far apart, substeps are not checked: the same chase with every substep checked ends at the same one."""
    outcomes = []
    for margin in (module.CLOSING_MARGIN, 1e9):
        monkeypatch.setattr(module, "CLOSING_MARGIN", margin)
        met = []
        for seed in range(30):
            rng = np.random.default_rng(seed)
            episode = begin(reach_a, (1.4, 1.7, rng.uniform(-3, 3)), (1.2, 0.7, rng.uniform(-3, 3)))
            for _ in range(300):
                commands = [(rng.uniform(0.1, 0.22), rng.uniform(-1, 1)) for _ in range(2)]
                if episode.step(*commands).intercepted:
                    break
            met.append((episode.intercepted, episode.physics_steps, episode.motion))
        outcomes.append(met)
    assert outcomes[0] == outcomes[1]
    assert sum(met[0] for met in outcomes[0]) > 5, "too few meetings: the test shows nothing"


def test_one_lasting_contact_is_one_collision(reach_a: Task) -> None:
    episode = begin(reach_a, (2.8, 2.5, 0.0), (0.4, 0.4, 0.0))
    events = [episode.step(AHEAD, STILL) for _ in range(30)]
    assert sum(e.ego_collided for e in events) == 1
    assert not any(e.adversary_collided for e in events)
    for _ in range(2):  # back off by turning round, return: a second collision
        for v, w, steps in ((0.0, math.pi / 2, 20), (0.22, 0.0, 10)):
            events = [episode.step((v, w), STILL) for _ in range(steps)]
    events += [episode.step(AHEAD, STILL) for _ in range(10)]
    assert sum(e.ego_collided for e in events) == 1


def test_mission_is_completed_when_the_adversary_enters(reach_a: Task) -> None:
    """Straight up from y = 1.9 into the disc of radius 0.18 around (0.5, 2.5): 0.42 m, seen on the first tick within."""
    episode = begin(reach_a, (2.6, 2.6, 0.0), (0.5, 1.9, math.pi / 2))
    completed = [episode.step(STILL, AHEAD).completed for _ in range(40)]
    tick = math.ceil((0.6 - 0.18) / 0.022)
    assert completed.index(True) == tick - 1
    assert sum(completed) == 1
    assert episode.completed_seconds == pytest.approx(tick / 10)
    assert episode.mission_progress() == (0, 0)


def test_status_matches_a_monitor_on_the_trail(reach_a: Task) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        episode = begin(reach_a, (2.6, 2.6, 0.0), (0.5, 1.7, rng.uniform(-3, 3)))
        statuses = [episode.monitor.status]
        for _ in range(250):
            episode.step(STILL, (0.08, rng.uniform(-1.8, 1.8)))
            assert not episode.intercepted
            statuses.append(episode.monitor.status)
        replayed = Monitor(reach_a.mission, reach_a.scenario, 0.1)
        trail = episode.trails[1]
        assert statuses == [replayed.reset(trail[0]), *(replayed.step(p) for p in trail[1:])]


def test_cameras(reach_a: Task) -> None:
    episode = begin(reach_a, (2.6, 2.6, 0.0), (0.5, 1.9, math.pi / 2))
    assert episode.seen_by == () and episode.last_seen is None
    while not episode.seen_by:
        episode.step(STILL, AHEAD)
    assert episode.seen_by == (0,)
    y = episode.motion[1].y
    assert 2.5 - 0.45 <= y < 2.5 - 0.45 + 0.022
    assert episode.last_seen == (0.5, y, episode.seconds) or episode.last_seen[0] == pytest.approx(0.5)


def test_starts_are_free_apart_and_seeded(mixed: Scenario) -> None:
    crowded = replace(mixed, ego_start=Disc(0.6, 0.5, 0.4), adversary_start=Disc(0.4, 0.4, 0.35))
    for seed in range(50):
        ego, adversary = draw_starts(crowded, np.random.default_rng(seed))
        assert free_points(crowded, [ego[:2]], 0.105)[0] and free_points(crowded, [adversary[:2]], 0.105)[0]
        assert crowded.ego_start.contains([ego[:2]])[0] and crowded.adversary_start.contains([adversary[:2]])[0]
        assert math.dist(ego[:2], adversary[:2]) > crowded.interception_metres
        assert (ego, adversary) == draw_starts(crowded, np.random.default_rng(seed))


def test_impossible_starts_say_why(mixed: Scenario) -> None:
    rng = np.random.default_rng(0)
    together = replace(mixed, ego_start=Disc(0.4, 0.4, 0.1), adversary_start=Disc(0.4, 0.4, 0.1))
    with pytest.raises(ValueError, match=r"no pair of starts farther apart than interception_metres = 0.3"):
        draw_starts(together, rng)
    blocked = replace(mixed, ego_start=Disc(0.8, 1.4, 0.1))
    with pytest.raises(ValueError, match=r"ego_start .* has no free point for a robot of radius 0.105"):
        draw_starts(blocked, rng)
    with pytest.raises(ValueError, match=r"options\['ego_start'\].*touches a wall or an obstacle"):
        check_start(mixed, (0.8, 1.4, 0.0), "ego_start")
    with pytest.raises(ValueError, match=r"three finite numbers"):
        check_start(mixed, (0.8, math.nan, 0.0), "adversary_start")
