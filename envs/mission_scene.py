"""A mission as something to look at: one short line and the regions of each stage, and the places to keep out of."""

from __future__ import annotations

from dataclasses import dataclass

from tab_marl.mission.model import Constraint, ConstraintType, Mission, Place, place_name
from tab_marl.world.regions import Disc, Region
from tab_marl.world.scenario import Scenario


@dataclass(frozen=True)
class Stage:
    """One goal of the mission."""

    text: str
    regions: tuple[Region, ...]
    visits: int
    """Counted visits that complete it."""


@dataclass(frozen=True)
class MissionScene:
    """What a picture of a mission shows."""

    text: str
    """The mission in English."""
    stages: tuple[Stage, ...]
    avoided: tuple[Region, ...]
    """Regions that some constraint forbids."""


def mission_scene(mission: Mission, scenario: Scenario, text: str) -> MissionScene:
    """The scene of a mission whose English is `text`."""
    stages = tuple(
        Stage(_stage_text(goal), tuple(_region(p, scenario) for p in goal.places), goal.visits)
        for goal in mission.goals
    )
    forbidden = [p for c in mission.beside if c.avoid for p in c.places] + [
        p for g in mission.goals for p in g.restricted
    ]
    return MissionScene(text, stages, tuple(_region(p, scenario) for p in dict.fromkeys(forbidden)))


def _region(place: Place, scenario: Scenario) -> Region:
    if isinstance(place, str):
        return scenario.region(place)
    return Disc(*place, scenario.target_radius_metres)


def _stage_text(goal: Constraint) -> str:
    names = [place_name(p) for p in goal.places]
    if goal.different > 1:
        text = f"{goal.different} of {_listed(names)}"
    elif len(names) > 1:
        text = f"any of {_listed(names)}"
    else:
        text = _listed(names)
    if goal.recurrences > 1:
        every = "every" if goal.type is ConstraintType.DEADLINE else "exactly every"
        return f"{text}, {every} {goal.seconds:g} s, {goal.recurrences} times" if goal.seconds else text
    if goal.seconds is not None:
        within = "at exactly" if goal.type is ConstraintType.EXACT else "within"
        text += f", {within} {goal.seconds:g} s"
    if goal.max_gap_seconds is not None:
        text += f", at most {goal.max_gap_seconds:g} s {'apart' if goal.visits > 1 else 'after the last'}"
    return text


def _listed(names: list[str]) -> str:
    """Checkpoints and bare points share their first word; other names stand by themselves."""
    for kind, prefix in (("checkpoint", "Checkpoint "), ("target", "[")):
        if all(name.startswith(prefix) for name in names):
            shown = [name.removeprefix("Checkpoint ") for name in names]
            return (
                names[0] if kind == "checkpoint" and len(names) == 1 else f"{_plural(kind, names)} {', '.join(shown)}"
            )
    return ", ".join(names)


def _plural(word: str, names: list[str]) -> str:
    return word + "s" if len(names) > 1 else word
