"""Draw a picture and an animation of every environment for its page: docs/images/environments/NAME.png and .webp.

python scripts/draw_environments.py            # all; or names of environments
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pettingzoo
import typer
from PIL import Image
from rich.progress import track

import tab_marl  # noqa: F401, registers the environments
from tab_marl.envs.opponents import make_opponent
from tab_marl.envs.registration import ENVIRONMENTS, Environment

OUT = Path(__file__).resolve().parent.parent / "docs" / "images" / "environments"
STEPS_PER_FRAME, FRAME_MILLISECONDS = 4, 80
ANIMATION_WIDTH = 560
MOST_FRAMES = 80
COLOURS = 200
SEED = 3


def players(env: Any) -> dict[str, Any]:
    """A scripted player for every robot: adversaries follow their routes, egos do what they are paid for."""
    task = getattr(env, "ego_task", "interception")
    found = {}
    for agent in env.possible_agents:
        name = "follow" if agent.startswith("adversary") else "arrive" if task == "avoidance" else "pursue"
        side = agent.split("_")[0]
        adversaries = sum(a.startswith("adversary") for a in env.possible_agents)
        found[agent] = make_opponent(name, side, adversaries)
    return found


def frames(environment: Environment) -> list[np.ndarray]:
    """An episode in pictures."""
    env: Any = pettingzoo.make(
        "parallel", environment.pettingzoo_id, render_mode="rgb_array", show_lidar=True, actions="continuous"
    )
    if "curriculum" in environment.name:
        env.set_difficulty(0.6)
    env = env.unwrapped
    observations, _ = env.reset(seed=SEED)
    cast = players(env)
    for agent, player in cast.items():
        task = env.task_of(agent) if hasattr(env, "task_of") else env.task
        getattr(player, "reset", lambda *_: None)(task, env.spawn_generator())
    pictures, step = [env.render()], 0
    while env.agents:
        actions = {agent: cast[agent].act(observations[agent]) for agent in env.agents}
        observations, *_ = env.step(actions)
        step += 1
        if step % STEPS_PER_FRAME == 0 or not env.agents:
            pictures.append(env.render())
    return pictures[:: max(1, -(-len(pictures) // MOST_FRAMES))] + pictures[-1:] * 12


def main(names: list[str] | None = typer.Argument(None)) -> None:  # noqa: B008, typer's way
    OUT.mkdir(parents=True, exist_ok=True)
    chosen = [e for e in ENVIRONMENTS if not names or e.name in names]
    for environment in track(chosen, "drawing"):
        pictures = [Image.fromarray(p) for p in frames(environment)]
        middle = pictures[int(0.6 * (len(pictures) - 12))]
        middle.quantize(COLOURS, dither=Image.Dither.NONE).save(OUT / f"{environment.name}.png", optimize=True)
        height = round(ANIMATION_WIDTH * middle.height / middle.width)
        small = [p.resize((ANIMATION_WIDTH, height), Image.Resampling.LANCZOS) for p in pictures]
        stream = io.BytesIO()
        small[0].save(
            stream, "WEBP", save_all=True, append_images=small[1:], duration=FRAME_MILLISECONDS, loop=0, quality=40,
            method=4, minimize_size=True,
        )  # fmt: skip
        (OUT / f"{environment.name}.webp").write_bytes(stream.getvalue())


if __name__ == "__main__":
    typer.run(main)
