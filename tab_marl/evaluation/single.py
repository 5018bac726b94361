"""One thing at a time for the command line: an episode, a training run, the zoo."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from tab_marl.evaluation.errors import UserError, require_known, user_input

FILM_STRIDE = 2
"""Every second control step becomes a frame."""


def watch_episode(
    mission: str, family: str, scenario: str, planner: str, adversary: str | None, seed: int, out: Path | None
) -> str:
    """Play one episode to a window or a file; returns how it ended."""
    from tab_marl.agents.planners import PLANNERS, PlannerOptions, make_planner
    from tab_marl.envs.task_source import task_source
    from tab_marl.evaluation import film
    from tab_marl.evaluation.adversaries import opponent, precedents, resolve_opponents
    from tab_marl.evaluation.episode import run_episode
    from tab_marl.evaluation.report.replaying import outcome
    from tab_marl.mission import to_english

    (planner,) = require_known("planner", (planner,), PLANNERS)
    played_by = next(iter(resolve_opponents((adversary,) if adversary else ())))
    policy = opponent(played_by)
    if out is None:
        if not (sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise UserError("there is no display to open a window on; write a film with --out episode.gif")
    else:
        film.check_target(out)
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    with user_input():
        task = task_source(None, mission, scenario, family)(np.random.default_rng(seed))
    agent = make_planner(planner, PlannerOptions(precedents=precedents(played_by)))
    frames: list[film.Frame] = []

    def on_step(env: Any) -> None:
        if env.episode.control_steps == 0:
            env.set_field(agent.belief_image if planner != "random" else None, f"belief of {planner}")
        if out is not None and (env.episode.control_steps % FILM_STRIDE == 0 or not env.agents):
            frames.append(env.render())

    played = run_episode(
        task, agent, policy, seed, on_step=on_step, render_mode="human" if out is None else "rgb_array"
    )
    lines = [
        f"mission    {to_english(task.mission, task.scenario)}",
        f"played by  {planner} against {policy.name}, seed {seed}",
        f"outcome    {outcome(played.row)}",
    ]
    if out is not None:
        count = film.write_film(frames, out, task.scenario.control_hertz // FILM_STRIDE)
        lines.append(f"film       {out} ({count} frames)")
    return "\n".join(lines)
