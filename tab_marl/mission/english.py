"""From constraint tuples back to English that `parse_mission` reads."""

from __future__ import annotations

from collections.abc import Sequence

from tab_marl.mission.model import Constraint, ConstraintType, Mission, Place, place_name, plain_number
from tab_marl.mission.parse import COUNTS, DEFAULT_RECURRENCES
from tab_marl.mission.places import MissionWorld


def to_english(mission: Mission, scenario: MissionWorld | None = None) -> str:
    """The mission in one sentence; with a scenario, all its checkpoints together are called "checkpoints".

    Reading it back gives the same mission, goals first and then what runs beside them.
    """
    checkpoints: tuple[Place, ...] = () if scenario is None else tuple(c.name for c in scenario.checkpoints)
    beside = [_beside(mission, c, at_start=not mission.goals) for c in mission.beside]
    if not mission.goals:
        return " and ".join([_capital(beside[0]), *beside[1:]])
    text = _plan(mission.goals, checkpoints)
    if beside:
        comma = "," if "," in text or mission.beside[0].type is ConstraintType.UNTIL else ""
        text += f"{comma} while {' and '.join(beside)}"
    return text


def _plan(goals: tuple[Constraint, ...], checkpoints: tuple[Place, ...]) -> str:
    gap = goals[0].max_gap_seconds
    if gap is None or any(goal.max_gap_seconds != gap for goal in goals):
        return _in_sequence(goals, checkpoints, own_gaps=True)
    if len(goals) > 1 and _plain(goals[-1]):
        earlier = goals[:-1]
        if len(earlier) > 1 and all(_plain(goal) for goal in earlier):
            visits = f"{_listed([goal.places[0] for goal in earlier], 'and')} in order"
        else:
            visits = ", then ".join(_goal(goal, checkpoints, own_gap=False) for goal in earlier)
        text = f"Reach {_the(goals[-1].places[0])} after visiting {visits}"
    else:
        text = _in_sequence(goals, checkpoints, own_gaps=False)
    named = [place for goal in goals for place in goal.places if isinstance(place, str)]
    between = "checkpoints" if any(p.casefold().startswith("checkpoint") for p in named) else "visits"
    return f"{text}, taking no more than {_seconds(gap)} between {between}"


def _plain(goal: Constraint) -> bool:
    """A single place, nothing asked beyond reaching it (a gap apart)."""
    return goal == Constraint(ConstraintType.EVENTUALLY, goal.places[:1], max_gap_seconds=goal.max_gap_seconds)


def _in_sequence(goals: tuple[Constraint, ...], checkpoints: tuple[Place, ...], own_gaps: bool) -> str:
    together = _each_within(goals)
    texts = [
        _goal(goal, checkpoints, own_gap=own_gaps, own_time=number >= together) for number, goal in enumerate(goals)
    ]
    verb = "Visit" if len(goals[0].places) > 1 else "Reach"
    text = f"{verb} {texts[0]}"
    for number in range(1, len(goals)):
        if number == together:
            text += f", each within {_seconds(goals[0].seconds)}"
        text += _joiner(goals, number) + texts[number]
    if together == len(goals):
        text += f", each within {_seconds(goals[0].seconds)}"
    return text


def _each_within(goals: tuple[Constraint, ...]) -> int:
    """How many goals at the beginning share "each within"; 0 if fewer than two do."""
    count = 0
    for goal in goals:
        timed = goal.type is ConstraintType.DEADLINE and goal.since == "previous" and goal.recurrences == 1
        if not timed or goal.seconds != goals[0].seconds:
            break
        count += 1
    return count if count > 1 else 0


def _joiner(goals: tuple[Constraint, ...], number: int) -> str:
    goal = goals[number]
    if number == len(goals) - 1:
        place = goal.places[0]
        if len(goal.places) == 1 and isinstance(place, str) and not place.casefold().startswith("checkpoint"):
            return ", and end at "
        if len(goals) == 2 and _plain(goals[0]):
            return " and then "
    return ", then "


def _goal(goal: Constraint, checkpoints: tuple[Place, ...], own_gap: bool, own_time: bool = True) -> str:
    parts = [_target(goal, checkpoints)]
    if own_time and goal.seconds is not None:
        parts.append(_time(goal, goal.seconds))
    if own_gap and goal.max_gap_seconds is not None:
        parts.append(f"at most {_seconds(goal.max_gap_seconds)} apart")
    if goal.speed_limit is not None:
        parts.append(f"no faster than {plain_number(goal.speed_limit)} m/s")
    if goal.restricted:
        parts.append(f"without entering {_listed(goal.restricted, 'or')}")
    comma = "," if " including " in parts[0] and len(parts) > 1 else ""
    return " ".join([parts[0] + comma, *parts[1:]])


def _time(goal: Constraint, seconds: float) -> str:
    exact = goal.type is ConstraintType.EXACT
    if goal.recurrences > 1:
        usual = goal.different if goal.different > 1 else DEFAULT_RECURRENCES
        often = "twice" if goal.recurrences == 2 else f"{_count(goal.recurrences)} times"
        times = "" if goal.recurrences == usual else f" {often}"
        return f"{'exactly ' if exact else ''}every {_seconds(seconds)}{times}"
    word = "present at exactly" if goal.presence else "in exactly" if exact else "within"
    return f"{word} {_seconds(seconds)}{' after the previous goal' if goal.since == 'previous' else ''}"


def _target(goal: Constraint, checkpoints: tuple[Place, ...]) -> str:
    places, including = goal.places, goal.including
    if goal.different == 1 and not including:
        if places == checkpoints and len(places) > 1:
            return "any checkpoint"
        if len(places) == 1:
            return _the(places[0])
        return f"any of {_listed(places, 'or')}"
    if not including and goal.different == len(places):
        return f"{_listed(places, 'and')} in any order"
    if including and len(including) == goal.different - 1 and places == _merged(including, checkpoints):
        return f"{_listed([*including, None], 'and')} in any order"
    if places == checkpoints:
        text = f"any {_count(goal.different)} different checkpoints"
    else:
        text = f"any {_count(goal.different)} different of {_set(places, checkpoints)}"
    return text + (f" including {_listed(including, 'and')}" if including else "")


def _merged(first: tuple[Place, ...], checkpoints: tuple[Place, ...]) -> tuple[Place, ...] | None:
    return tuple(dict.fromkeys((*first, *checkpoints))) if checkpoints else None


def _set(places: tuple[Place, ...], checkpoints: tuple[Place, ...]) -> str:
    """The places, with an unbroken run of all the scenario's checkpoints called "the checkpoints"."""
    width = len(checkpoints)
    for begin in range(len(places) - width + 1 if width > 1 else 0):
        if places[begin : begin + width] == checkpoints:
            names = [_the(p) for p in places[:begin]] + ["the checkpoints"] + [_the(p) for p in places[begin + width :]]
            return _joined(names, "and")
    return _listed(places, "and")


def _beside(mission: Mission, constraint: Constraint, at_start: bool) -> str:
    if not constraint.places:
        return f"never {'go' if at_start else 'going'} faster than {plain_number(constraint.speed_limit or 0.0)} m/s"
    verb = ("avoid" if at_start else "avoiding") if constraint.avoid else ("stay in" if at_start else "staying in")
    text = f"{verb} {_listed(constraint.places, 'or')}"
    if constraint.seconds is not None:
        text += f" until {_seconds(constraint.seconds)}"
    elif constraint.until_goal is not None:
        text += f" until {_goal_reference(mission, constraint.until_goal)}"
    return text


def _goal_reference(mission: Mission, index: int) -> str:
    goal = mission.constraints[index]
    first = next(i for i in mission.goal_indices if mission.constraints[i].places == goal.places)
    if len(goal.places) == 1 and first == index:
        return f"reaching {_the(goal.places[0])}"
    return f"goal {mission.goal_indices.index(index) + 1} is completed"


def _listed(places: Sequence[Place | None], word: str) -> str:
    """None stands for another checkpoint."""
    return _joined(["another checkpoint" if p is None else _the(p) for p in places], word)


def _joined(names: list[str], word: str) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {word} {names[-1]}"


def _the(place: Place) -> str:
    if not isinstance(place, str):
        return f"target {place_name(place)}"
    name = place
    return f"the {name}" if name[0].islower() else name


def _count(count: int) -> str:
    return COUNTS[count] if count < len(COUNTS) else str(count)


def _seconds(seconds: float | None) -> str:
    return f"{plain_number(seconds or 0.0)}s"


def _capital(text: str) -> str:
    return text[0].upper() + text[1:]
