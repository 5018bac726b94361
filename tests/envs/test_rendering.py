"""Pictures show what they should where they should."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tab_marl.envs import drawing as d
from tab_marl.envs.heat import heat_image
from tab_marl.envs.intercept import InterceptEnv
from tab_marl.envs.mission_scene import mission_scene
from tab_marl.envs.physics import Motion
from tab_marl.envs.rendering import MAP_PIXELS, MARGIN_PIXELS, Frame, Renderer
from tab_marl.mission import parse_mission
from tab_marl.mission.tasks import Task
from tab_marl.world.grid import GridMap
from tab_marl.world.scenario import Scenario

EGO, ADVERSARY = Motion(2.6, 2.0, 0.4, 0.1, 0.0), Motion(1.5, 0.6, 1.0, 0.1, 0.0)


@pytest.fixture
def renderer(mixed: Scenario) -> Renderer:
    mission = parse_mission("Reach Checkpoint A and then Checkpoint B while avoiding the central zone", mixed)
    return Renderer(mixed, mission_scene(mission, mixed, "Reach Checkpoint A and then Checkpoint B"))


def pixel(picture: np.ndarray, x: float, y: float) -> np.ndarray:
    """Mean colour of 3 x 3 pixels around a point in metres (the arena is 3 m wide)."""
    scale = MAP_PIXELS / 3.0
    column, row = round(MARGIN_PIXELS + x * scale), round(MARGIN_PIXELS + (3.0 - y) * scale)
    return picture[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).mean(axis=0)


def near(colour: np.ndarray, wanted: tuple[int, int, int], within: float = 30.0) -> bool:
    return bool(np.abs(colour - wanted).max() <= within)


def test_robots_and_obstacles_are_where_they_are(renderer: Renderer) -> None:
    picture = renderer.array(Frame(EGO, ADVERSARY, 1.0, seen_by=(1,)))
    assert picture.shape == (720, 1040, 3) and picture.dtype == np.uint8
    behind = (EGO.x - 0.08 * math.cos(EGO.theta), EGO.y - 0.08 * math.sin(EGO.theta))
    assert near(pixel(picture, *behind), d.EGO)
    behind = (ADVERSARY.x - 0.08 * math.cos(ADVERSARY.theta), ADVERSARY.y - 0.08 * math.sin(ADVERSARY.theta))
    assert near(pixel(picture, *behind), d.ADVERSARY)
    assert near(pixel(picture, 2.1, 1.4), d.SOLID) and near(pixel(picture, 0.8, 1.4), d.SOLID)
    assert near(pixel(picture, 1.45, 2.3), d.SOLID)
    assert near(pixel(picture, 0.3, 0.75), d.FLOOR, 8)


def test_heading_shows(renderer: Renderer) -> None:
    """The light nose lies ahead."""
    picture = renderer.array(Frame(EGO._replace(theta=math.pi / 2), ADVERSARY, 1.0))
    ahead, behind = pixel(picture, EGO.x, EGO.y + 0.04), pixel(picture, EGO.x, EGO.y - 0.07)
    assert ahead.min() > 200 and near(behind, d.EGO)


def test_an_unseen_adversary_is_pale(renderer: Renderer) -> None:
    behind = (ADVERSARY.x - 0.08 * math.cos(ADVERSARY.theta), ADVERSARY.y - 0.08 * math.sin(ADVERSARY.theta))
    seen, unseen = (pixel(renderer.array(Frame(EGO, ADVERSARY, 1.0, seen_by=by)), *behind) for by in ((1,), ()))
    assert unseen[1] - seen[1] > 80 and unseen[2] - seen[2] > 80


def test_a_camera_lights_up(renderer: Renderer) -> None:
    point = (2.5, 0.5 + 0.35)  # in camera B, outside the checkpoint
    dark, lit = (pixel(renderer.array(Frame(EGO, ADVERSARY, 1.0, seen_by=by)), *point) for by in ((), (1,)))
    assert lit[2] < dark[2] - 30 and abs(lit[0] - dark[0]) < 25, "towards yellow"


def test_goals_forbidden_zone_and_stage(renderer: Renderer) -> None:
    centre_a, centre_b = (0.5, 2.5), (2.5, 0.55)
    first = renderer.array(Frame(EGO, ADVERSARY, 1.0))
    second = renderer.array(Frame(EGO, ADVERSARY, 1.0, stage=1))
    green = lambda colour: colour[1] - colour[0]
    assert green(pixel(first, *centre_a)) > 15 > green(pixel(first, *centre_b))
    assert green(pixel(second, *centre_b)) > 15 > green(pixel(second, *centre_a))
    zone = first[
        round(24 + 1.5 * 224) - 40 : round(24 + 1.5 * 224) + 40, round(24 + 1.5 * 224) - 40 : round(24 + 1.5 * 224) + 40
    ]
    assert zone[..., 0].mean() - zone[..., 1].mean() > 5, "reddish"


def test_trail(renderer: Renderer) -> None:
    trail = np.column_stack([np.linspace(1.0, 2.6, 50), np.full(50, 1.8)])
    picture = renderer.array(Frame(EGO, ADVERSARY, 5.0, ego_trail=trail))
    bare = renderer.array(Frame(EGO, ADVERSARY, 5.0))
    assert pixel(bare, 1.7, 1.8)[0] - pixel(picture, 1.7, 1.8)[0] > 60
    near_end, far_end = pixel(picture, 2.35, 1.8)[0], pixel(picture, 1.05, 1.8)[0]
    assert near_end < far_end, "it fades with age"


def test_heat_is_where_the_mass_is(renderer: Renderer, mixed: Scenario) -> None:
    grid = GridMap.from_scenario(mixed, 0.05)
    mass = np.exp(-((grid.centres - (2.0, 2.6)) ** 2).sum(axis=1) / 0.02)
    picture = renderer.array(Frame(EGO, ADVERSARY, 1.0, heat=grid.image(mass, 0.0)))
    assert near(pixel(picture, 2.0, 2.6), d.HEAT, 75)
    assert near(pixel(picture, 1.0, 0.3), d.FLOOR, 8)


def test_ends_are_announced(renderer: Renderer) -> None:
    frames = [
        Frame(EGO, ADVERSARY, 9.0),
        Frame(EGO, ADVERSARY, 9.0, intercepted=True),
        Frame(EGO, ADVERSARY, 9.0, over=True),
    ]
    banners = [renderer.array(frame)[45:70, 250:470].reshape(-1, 3).mean(axis=0) for frame in frames]
    assert near(banners[1], d.EGO, 60) and near(banners[2], d.ADVERSARY, 60)
    assert not near(banners[0], d.EGO, 60)


def test_environment_pictures_and_field(reach_a: Task) -> None:
    env = InterceptEnv(task=reach_a, render_mode="rgb_array")
    env.reset(seed=0)
    plain = env.render()
    assert plain is not None
    grid = GridMap.from_scenario(reach_a.scenario, 0.1)
    uniform = np.full(grid.cells, 1.0 / grid.cells)
    images = []
    for field in (uniform, (grid, uniform), grid.image(uniform, 0.0), lambda: (grid, uniform)):
        env.set_field(field, "belief")
        images.append(env.render())
    assert all(np.array_equal(images[0], image) for image in images)
    assert not np.array_equal(images[0], plain)
    env.set_field(None)
    assert np.array_equal(env.render(), plain)
    with pytest.raises(ValueError, match=r"shape \(3,\) fits neither"):
        env.set_field(np.ones(3))
    with pytest.raises(ValueError, match=r"must be \[cells\]"):
        env.set_field((grid, np.ones(3)))
    env.close()


def test_pictures_do_not_disturb_the_episode(reach_a: Task) -> None:
    ends = []
    for mode in (None, "rgb_array", "human"):
        env = InterceptEnv(task=replace(reach_a), render_mode=mode, show_lidar=True)
        env.metadata = {**env.metadata, "render_fps": 10_000}
        env.reset(seed=0)
        for _ in range(5):
            env.step({agent: np.array([0.3, 0.2]) for agent in env.agents})
            if mode is not None:
                env.render()
        ends.append(env.episode.motion)
        env.close()
        env.close()
    assert ends[0] == ends[1] == ends[2]


def test_heat_of_a_callable_that_has_nothing_yet(reach_a: Task) -> None:
    env = InterceptEnv(task=reach_a, render_mode="rgb_array")
    env.reset(seed=0)
    plain = env.render()
    env.set_field(lambda: None)
    assert np.array_equal(env.render(), plain)


def test_bare_values_pick_their_grid(mixed: Scenario) -> None:
    for metres in (0.1, 0.05):
        grid = GridMap.from_scenario(mixed, metres)
        values = np.random.default_rng(0).random(grid.cells)
        assert np.array_equal(heat_image(values, mixed), grid.image(values, 0.0))
