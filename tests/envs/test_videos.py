"""Films by both libraries' own recorders, and a window, without a display."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import imageio_ffmpeg
import numpy as np
import pettingzoo
import pygame
import pytest
from gymnasium.wrappers import RecordVideo
from pettingzoo.utils.wrappers import RecordVideo as RecordVideoAec
from pettingzoo.utils.wrappers import RecordVideoParallel

import tab_marl  # noqa: F401, registers the environments
from tab_marl.envs.intercept import InterceptEnv

STEPS = 8


def film(folder: Path) -> tuple[tuple[int, int], int, np.ndarray]:
    """(width, height), frames and the last picture of the one film in a folder."""
    (path,) = folder.glob("*.mp4")
    reader = imageio_ffmpeg.read_frames(str(path), pix_fmt="rgb24")
    size = next(reader)["size"]
    pictures = [np.frombuffer(frame, dtype=np.uint8).reshape(size[1], size[0], 3) for frame in reader]
    return size, len(pictures), pictures[-1]


def check(folder: Path, last: np.ndarray, frames: int) -> None:
    size, found, picture = film(folder)
    assert size == (last.shape[1], last.shape[0])
    assert abs(found - frames) <= 1
    assert np.abs(picture.astype(int) - last).mean() < 4, "the film shows what render gave"


def test_gymnasium(tmp_path) -> None:
    env = RecordVideo(
        gymnasium.make("tab_marl/Ego-v0", render_mode="rgb_array", max_cycles=STEPS), str(tmp_path), disable_logger=True
    )
    env.reset(seed=0)
    over = False
    while not over:
        _, _, terminated, truncated, _ = env.step(np.array([1.0, 0.2], dtype=np.float32))
        over = terminated or truncated
    last = env.render()
    env.close()
    check(tmp_path, last, STEPS + 1)


def test_pettingzoo_parallel(tmp_path) -> None:
    env = pettingzoo.make("parallel", "tab_marl/intercept-v0", render_mode="rgb_array", max_cycles=STEPS)
    env = RecordVideoParallel(env, str(tmp_path))
    env.reset(seed=0)
    while env.agents:
        env.step({agent: np.array([1.0, 0.2], dtype=np.float32) for agent in env.agents})
    last = env.render()
    env.close()
    check(tmp_path, last, STEPS + 1)


def test_pettingzoo_aec(tmp_path) -> None:
    env = pettingzoo.make("aec", "tab_marl/intercept-v0", render_mode="rgb_array", max_cycles=STEPS)
    env = RecordVideoAec(env, str(tmp_path))
    env.reset(seed=0)
    for _agent in env.agent_iter():
        *_, terminated, truncated, _ = env.last()
        env.step(None if terminated or truncated else np.array([1.0, 0.2], dtype=np.float32))
    env.close()
    size, frames, _ = film(tmp_path)
    assert size == (1040, 720) and frames >= STEPS


@pytest.mark.parametrize("scenario", ["lab", "reef"])
def test_a_window_shows_what_the_array_holds(scenario) -> None:
    pictures = {}
    for mode in ("rgb_array", "human"):
        env = InterceptEnv(mission="M4", scenario=scenario, render_mode=mode, show_lidar=True)
        env.reset(seed=0)
        for _ in range(2):
            env.step({agent: np.array([1.0, 0.1], dtype=np.float32) for agent in env.agents})
        pictures[mode] = env.render()
        if mode == "human":
            assert pictures[mode] is None
            surface = pygame.display.get_surface()
            pictures[mode] = np.transpose(pygame.surfarray.array3d(surface), (1, 0, 2)).copy()
        env.close()
    np.testing.assert_array_equal(pictures["rgb_array"], pictures["human"])
