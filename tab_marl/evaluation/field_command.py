"""The field of one mission on the command line: solved, drawn, told in words, and written to files."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tab_marl.evaluation.errors import UserError, user_input
from tab_marl.mission import InfeasibleMission, Mission, check_feasible, parse_mission, to_english
from tab_marl.world.grid import GridMap
from tab_marl.world.regions import Disc
from tab_marl.world.scenario import Scenario

if TYPE_CHECKING:
    from tab_marl.field import SoftConstraint, TabField

PICTURES = (".png", ".svg", ".pdf")
ANSWERS = (".json", ".csv")
START_CELL_METRES = 0.1
"""Cells that are tried as a nearer start."""


@dataclass(frozen=True)
class FieldRequest:
    """What `tab-marl field` was asked for."""

    mission: str
    scenario: str = "lab"
    preset: str = "default"
    picture: Path = Path("field.png")
    animation: Path | None = None
    save: Path | None = None
    answers: Path | None = None
    completes: float | None = None
    """Probability of completing the mission; None: it is completed."""
    passes: tuple[str, ...] = ()
    """Each "PLACE=PROBABILITY"."""
    start: str = "nearer"
    """`scenario`, `nearer` (moved only if the mission is impossible from there) or "x,y" in metres."""


def show_field(asked: FieldRequest) -> str:
    """Solve, write what was asked for, and say in words what the field says. Raises UserError."""
    from tab_marl.field import FieldOptions, FieldProblem, solve
    from tab_marl.field.answers.animation import check_film

    for path, kinds in ((asked.picture, PICTURES), (asked.answers, ANSWERS), (asked.save, (".npz",))):
        _check_target(path, kinds)
    with user_input():
        if asked.animation is not None:
            check_film(asked.animation)
            _check_target(asked.animation, (asked.animation.suffix.casefold(),))
        world = Scenario.preset(asked.scenario)
        mission = parse_mission(asked.mission, world)
        options = FieldOptions.preset(asked.preset)
        constraints = _constraints(asked, world)
        world, note = _with_start(world, mission, asked.start)
        field = solve(FieldProblem.from_mission(mission, world, options, constraints=constraints))
    lines = _words(field, mission, note)
    import matplotlib

    matplotlib.use("Agg")
    try:
        field.plot(asked.picture)
        lines.append(f"picture      {asked.picture}")
        if asked.animation is not None:
            with user_input():
                count = field.animate(asked.animation)
            lines.append(f"animation    {asked.animation} ({count} frames)")
        if asked.save is not None:
            field.save(asked.save)
            lines.append(f"field        {asked.save} (read it with tab_marl.TabField.load)")
        if asked.answers is not None:
            write_answers(field, mission, asked.answers)
            lines.append(f"answers      {asked.answers}")
    except OSError as error:
        raise UserError(f"{error.filename or asked.picture}: cannot be written: {error.strerror or error}") from None
    return "\n".join(lines)


def _constraints(asked: FieldRequest, world: Scenario) -> list[SoftConstraint]:
    from tab_marl.field import Completes, Passes, SoftConstraint

    found = []
    if asked.completes is not None and asked.completes != 1:
        if not 0 < asked.completes < 1:
            raise UserError(f"--completes is {asked.completes:g}, must lie in (0, 1]")
        found.append(SoftConstraint(Completes(), asked.completes))
    for text in asked.passes:
        place, _, number = text.rpartition("=")
        try:
            chance = float(number)
        except ValueError:
            chance = math.nan
        if not place or not 0 < chance < 1:
            raise UserError(
                f'--passes {text!r}: write "PLACE=PROBABILITY", a number between 0 and 1: "Checkpoint D=0.3"'
            )
        world.region(place.strip())  # an unknown place is named here
        found.append(SoftConstraint(Passes(place.strip()), chance))
    return found


def _with_start(world: Scenario, mission: Mission, start: str) -> tuple[Scenario, str | None]:
    """The scenario with the start asked for, and a note if that was not the scenario's own."""
    if start not in ("scenario", "nearer"):
        try:
            x, y = (float(part) for part in start.split(","))
        except ValueError:
            raise UserError(f'--start {start!r}: must be scenario, nearer, or a point in metres: "1.5,0.4"') from None
        if not (0 <= x <= world.width_metres and 0 <= y <= world.height_metres):
            raise UserError(
                f"--start {start}: lies outside the arena of {world.width_metres:g} x {world.height_metres:g} m"
            )
        world = replace(world, adversary_start=Disc(x, y, 0.01))
    try:
        check_feasible(mission, world)
        return world, None
    except InfeasibleMission as impossible:
        if start != "nearer":
            raise
        radius = float(getattr(world.adversary_start, "radius", START_CELL_METRES))
        x, y = _nearer_start(world, mission, radius, impossible)
        reason = str(impossible).removeprefix("the mission is impossible: ")
        note = f"moved to ({x:.2f}, {y:.2f}): {reason} (--start scenario refuses instead)"
        return replace(world, adversary_start=Disc(x, y, radius)), note


def _nearer_start(
    world: Scenario, mission: Mission, radius: float, impossible: InfeasibleMission
) -> tuple[float, float]:
    """The centre nearest to the scenario's, along free paths, of a start disc that allows the mission all over."""
    grid = GridMap.from_scenario(world, START_CELL_METRES)
    away = grid.distances(grid.cells_of([world.adversary_start.centre]))
    around = radius * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    for cell in np.argsort(away, kind="stable"):
        centre = grid.centres[cell]
        if all(_possible(world, mission, point) for point in centre + around):
            return float(centre[0]), float(centre[1])
    raise impossible


def _possible(world: Scenario, mission: Mission, point: np.ndarray) -> bool:
    try:
        check_feasible(mission, world, point)
    except InfeasibleMission:
        return False
    return True


def _words(field: TabField, mission: Mission, note: str | None) -> list[str]:
    problem = field.problem
    world = problem.scenario
    assert isinstance(world, Scenario)
    step, done = world.step_seconds, field.completion_probability
    size = f"{problem.reference.states} states x {len(problem.automaton.delta)} mission states"
    chance = np.exp(field.log_partition)
    reached = [int(np.argmax(done >= share * done[-1] - 1e-9)) * step for share in (0.1, 0.5, 0.9)]
    lines = [
        f"mission      {to_english(mission, world)}",
        f"scenario     {world.name}, {size}, {problem.horizon} ticks of {step:g} s",
    ]
    if note is not None:
        lines.append(f"start        {note}")
    if field.report is None:
        lines.append(
            f"log Z        {field.log_partition:.3f} (unguided motion completes it with probability {chance:.2g})"
        )
    else:
        lines += [f"constraint   {line}" for line in str(field.report).splitlines()]
    of_all = "" if done[-1] > 0.9995 else f" (of the {done[-1]:.0%} that complete it)"
    lines.append(f"completion   10 % by {reached[0]:g} s, half by {reached[1]:g} s, 90 % by {reached[2]:g} s{of_all}")
    stages = field.stage_times
    if len(stages) > 1:
        medians = [f"{name} {_quantile(times, 0.5) * step:g} s" for name, times in stages.items()]
        lines.append(f"half way by  {', '.join(medians)}")
    if len(field.branch_shares) > 1:
        shares = ", ".join(f"{place} {100 * share:.0f} %" for place, share in field.branch_shares.items())
        lines.append(f"goes to      {shares}")
    best = field.most_likely_path()
    lines.append(f"likeliest    {(len(best) - 1) * step:g} s long, log-probability {best.log_probability:.2f}")
    return lines


def _quantile(times: np.ndarray, share: float) -> int:
    return int(np.argmax(np.cumsum(times) >= share * times.sum() - 1e-12))


def answers_of(field: TabField, mission: Mission) -> dict[str, Any]:
    """What the field says, as plain numbers."""
    from tab_marl.field import Passes

    problem = field.problem
    world = problem.scenario
    assert isinstance(world, Scenario)
    best = field.most_likely_path()
    passes = {}
    for checkpoint in world.checkpoints:
        try:
            passes[checkpoint.name] = field.probability(Passes(checkpoint.name))
        except ValueError:  # no free cell lies in it
            passes[checkpoint.name] = 0.0
    return {
        "mission": to_english(mission, world),
        "scenario": world.name,
        "start_metres": list(world.adversary_start.centre),
        "tick_seconds": world.step_seconds,
        "log_partition": field.log_partition,
        "kl_to_reference_nats": field.kl_to_reference,
        "path_entropy_nats": field.path_entropy,
        "completes": field.completes,
        "completed_by_tick": field.completion_probability.tolist(),
        "stage_completed_at_tick": {name: times.tolist() for name, times in field.stage_times.items()},
        "shares_of_alternatives": field.branch_shares,
        "passes_before_completing": passes,
        "likeliest_path": {"log_probability": best.log_probability, "metres": best.positions.tolist()},
        "constraints": None if field.report is None else asdict(field.report),
    }


def write_answers(field: TabField, mission: Mission, path: Path) -> None:
    """All answers as JSON, or the table by tick as CSV. Raises OSError."""
    if path.suffix.casefold() == ".json":
        path.write_text(json.dumps(answers_of(field, mission), indent=1) + "\n", encoding="utf-8")
        return
    stages: Mapping[str, Sequence[float]] = {name: times.tolist() for name, times in field.stage_times.items()}
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["tick", "seconds", "completed", *(f"{name} at this tick" for name in stages)])
        for tick, done in enumerate(field.completion_probability):
            row = [f"{times[tick]:.9g}" for times in stages.values()]
            table.writerow([tick, f"{tick * field.problem.step_seconds:g}", f"{done:.9g}", *row])


def _check_target(path: Path | None, kinds: tuple[str, ...]) -> None:
    """Before any work: is the name of a known kind, and can it be written?"""
    if path is None:
        return
    if path.suffix.casefold() not in kinds:
        raise UserError(
            f"{path}: cannot write {path.suffix or 'such'} files here; end the name in {' or '.join(kinds)}"
        )
    if path.is_dir():
        raise UserError(f"{path}: is a folder; give the name of a file in it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        existed = path.exists()
        path.open("ab").close()
        if not existed:
            path.unlink()
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}; choose another folder") from None
