"""One thing at a time for the command line: an episode, a training run, the zoo."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from tab_marl.evaluation.errors import UserError, require_known, user_input

FILM_STRIDE = 2
"""Every second control step becomes a frame."""


def watch_episode(
    mission: str, family: str, scenario: str, planner: str, adversary: str | None, seed: int, out: Path | None
) -> str:
    """Play one episode to a window or a file; returns how it ended."""
    from tab_marl.agents.planners import PLANNERS, make_planner
    from tab_marl.envs.task_source import task_source
    from tab_marl.evaluation import film
    from tab_marl.evaluation.episode import opponent, resolve_opponents, run_episode
    from tab_marl.evaluation.report.replaying import outcome
    from tab_marl.mission import to_english

    (planner,) = require_known("planner", (planner,), PLANNERS)
    policy = opponent(next(iter(resolve_opponents((adversary,) if adversary else ()))))
    if out is None:
        if not (sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise UserError("there is no display to open a window on; write a film with --out episode.gif")
    else:
        film.check_target(out)
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    with user_input():
        task = task_source(None, mission, scenario, family)(np.random.default_rng(seed))
    agent = make_planner(planner)
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


def train_policy(
    style: str | None, config: Path | None, changes: Mapping[str, Any], out: Path | None, console: Console
) -> None:
    """Train, or continue, a policy with a progress bar; exports it when done."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from tab_marl.agents.training import Progress as Stand
    from tab_marl.agents.training import train
    from tab_marl.agents.training_settings import TrainingSettings
    from tab_marl.agents.zoo import export_policy

    if style is not None and config is not None:
        raise UserError("give --style or --config, not both: the file holds a style")
    with user_input():
        base = (
            TrainingSettings.from_toml(config) if config is not None else TrainingSettings.for_style(style or "direct")
        )
        settings = replace(base, **{name: value for name, value in changes.items() if value is not None})
    folder = out if out is not None else Path("runs/train") / settings.name
    with Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"), TimeElapsedColumn(),
        TextColumn("left"), TimeRemainingColumn(), TextColumn("{task.fields[note]}"), console=console,
    ) as bar:  # fmt: skip
        tasks = bar.add_task("tasks   ", total=settings.tasks, note="")
        steps = bar.add_task("training", total=settings.steps, note="", start=False)

        def show(stand: Stand) -> None:
            if stand.phase == "tasks":
                bar.update(tasks, completed=stand.done, total=stand.total)
                return
            bar.start_task(steps)
            success = " ".join(
                f"{mission} {100 * share:.0f} %" for mission, share in stand.success.items() if np.isfinite(share)
            )
            bar.update(steps, completed=stand.done, note=f"{stand.steps_per_second:.0f} steps/s  {success}")

        try:
            model = train(settings, folder, show)
        except KeyboardInterrupt:
            raise UserError(f"interrupted: the same command continues the run in {folder}") from None
    path = export_policy(model, settings, folder)
    console.print(f"policy: {path}; logs: tensorboard --logdir {folder}", highlight=False)
