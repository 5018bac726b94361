"""Missions as TOML and JSON: the constraint tuples by field name, fields at their default left out."""

from __future__ import annotations

import dataclasses
import difflib
import json
import tomllib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import TypeAdapter, ValidationError

from tab_marl.mission.model import Constraint, ConstraintType, Mission
from tab_marl.mission.parse import parse_mission
from tab_marl.world.scenario import Scenario


class MissionFormatError(ValueError):
    """A mission file that cannot be read: says which field, its value, and what it must be."""


def mission_to_json(mission: Mission) -> str:
    """Indented JSON."""
    return json.dumps(_plain(mission), indent=2) + "\n"


def mission_to_toml(mission: Mission) -> str:
    """TOML, one ``[[constraints]]`` table per constraint."""
    return tomli_w.dumps(_plain(mission))


def mission_from_json(text: str) -> Mission:
    """Raises MissionFormatError."""
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise MissionFormatError(f"not JSON: {error}") from None
    return _mission(data)


def mission_from_toml(text: str) -> Mission:
    """Raises MissionFormatError."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise MissionFormatError(f"not TOML: {error}") from None
    return _mission(data)


def load_mission(path: str | Path, scenario: Scenario) -> Mission:
    """Read a mission from a ``.toml``, ``.json`` or ``.txt`` (English) file. Raises MissionFormatError, OSError."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise MissionFormatError(f"{path}: not a text file in UTF-8 ({error.reason} at byte {error.start})") from None
    readers: dict[str, Callable[[str], Mission]] = {
        ".toml": mission_from_toml,
        ".json": mission_from_json,
        ".txt": lambda english: parse_mission(english, scenario),
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise MissionFormatError(f"{path}: ends in {path.suffix!r}, must be one of {', '.join(readers)}")
    try:
        return reader(text)
    except ValueError as error:
        raise MissionFormatError(f"{path}: {error}") from None


@lru_cache(maxsize=1)
def _adapter() -> TypeAdapter[Mission]:
    return TypeAdapter(Mission)


def _plain(mission: Mission) -> dict[str, Any]:
    """Only lists, dicts, strings and numbers; fields at their default left out."""
    data: dict[str, Any] = {"name": mission.name} if mission.name else {}
    data["constraints"] = [_plain_constraint(constraint) for constraint in mission.constraints]
    return data


def _plain_constraint(constraint: Constraint) -> dict[str, Any]:
    found: dict[str, Any] = {"type": str(constraint.type)}
    for field in dataclasses.fields(Constraint):
        value = getattr(constraint, field.name)
        if field.name == "type" or value == field.default:
            continue
        found[field.name] = [p if isinstance(p, str) else list(p) for p in value] if isinstance(value, tuple) else value
    return found


def _mission(data: object) -> Mission:
    try:
        return _adapter().validate_python(data)
    except ValidationError as error:
        lines: dict[str, str] = {}
        for one in error.errors():
            line = _line(dict(one))
            lines.setdefault(line.split(":")[0], line)  # one complaint per field
        raise MissionFormatError("; ".join(lines.values())) from None


def _line(error: dict[str, Any]) -> str:
    """One of pydantic's errors as "field: value, remedy"."""
    steps = [s for s in error["loc"] if not (isinstance(s, str) and (s == "str" or s.startswith("tuple[")))]
    where = "".join(f"[{s}]" if isinstance(s, int) else f".{s}" for s in steps).removeprefix(".") or "the mission"
    kind, value = error["type"], error["input"]
    owner = Constraint if steps[:1] == ["constraints"] else Mission
    known = [f.name for f in dataclasses.fields(owner)]
    if kind in ("unexpected_keyword_argument", "extra_forbidden"):
        near = difflib.get_close_matches(str(steps[-1]), known, n=1)
        return f"{where}: no such field, " + (f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}")
    if kind in ("missing", "missing_argument"):
        return f"{where}: missing, must be given"
    if kind == "value_error":
        return f"{where}: {error['msg'].removeprefix('Value error, ')}"
    if kind == "enum":
        return f"{where}: is {value!r}, must be one of {', '.join(ConstraintType)}"
    if kind == "tuple_type" and len(steps) < 4:
        of = "constraint tables" if steps == ["constraints"] else "region names and points [x, y]"
        return f"{where}: is {value!r}, must be a list of {of}"
    if {"places", "including", "restricted"} & set(steps):
        where = f"constraints[{steps[1]}].{steps[2]}[{steps[3]}]"
        value = value if len(steps) < 5 else "a list of another length"
        return f"{where}: is {value!r}, must be a region's name or a point [x, y] in metres"
    must = error["msg"].replace("Input should be ", "must be ")
    return f"{where}: is {value!r}, {must}"
