"""A population of adversaries as a TOML file: what all members share, and what each of them is.

    [defaults]
    tasks = 360

    [[member]]
    style = "side"                     # a preset, a table, or a list of either: ["late", "fickle"] is one of them per episode

    [[member]]
    name = "quiet"
    algorithm = "sac"
    seeds = [1, 2]                     # two members, quiet-1 and quiet-2
    style = { name = "quiet", camera_shy = 6.0, arrival_fraction = [0.7, 0.85] }

Members are `TrainingSettings`: every field of theirs may stand in ``[defaults]`` and in a ``[[member]]``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from tab_marl.agents.training.hyperparameters import HyperparameterError, check
from tab_marl.agents.training.settings import TrainingError, TrainingSettings, as_toml, first_line, read_toml
from tab_marl.envs.styles import STYLES, Style, mixture_of
from tab_marl.world.scenario import UnknownName

FOLDER = Path(__file__).parent
"""The populations that ship; they are found by their names."""
KEYS = ("name", "controls", "defaults", "member")


@dataclass(frozen=True)
class Population:
    """Members to train, each with its own name."""

    name: str
    members: tuple[TrainingSettings, ...]
    source: str
    """The file, as it was given."""
    controls: tuple[str, ...] = ()
    """Members that are trained for comparison only: a style counts if its own figure moves against them."""

    @classmethod
    def load(cls, file: Path | str) -> Population:
        """Read a file, or one of the populations that ship by its name ("shipped").

        Raises TrainingError that names file, member and field.
        """
        path = Path(file)
        if not path.is_file() and (FOLDER / f"{path.name.removesuffix('.toml')}.toml").exists():
            path = FOLDER / f"{path.name.removesuffix('.toml')}.toml"
        return cls.from_mapping(read_toml(path), str(file), path.stem)

    @classmethod
    def from_mapping(cls, data: Mapping[str, Any], source: str, name: str = "population") -> Population:
        """A population from what its file holds. Raises TrainingError."""
        for key in data:
            if key not in KEYS:
                raise TrainingError(f"{source}: {UnknownName('table', key, KEYS)}")
        defaults, given = data.get("defaults", {}), data.get("member", [])
        if not isinstance(defaults, dict):
            raise TrainingError(f"{source}: defaults must be a table, [defaults]")
        if not isinstance(given, list) or not given or not all(isinstance(member, dict) for member in given):
            raise TrainingError(f"{source}: there are no members: write a table [[member]] for each policy")
        members = [
            settings
            for number, member in enumerate(given, start=1)
            for settings in _members(defaults, member, _where(source, number, member))
        ]
        seen: dict[str, int] = {}
        for number, member in enumerate(members, start=1):
            if member.name in seen:
                raise TrainingError(
                    f"{source}: policies {seen[member.name]} and {number} are both named {member.name!r}: names are folders"
                )
            seen[member.name] = number
        controls = data.get("controls", [])
        if not isinstance(controls, list):
            raise TrainingError(f"{source}: controls is {controls!r}, must be a list of names of members")
        for control in controls:
            if control not in seen:
                raise TrainingError(f"{source}: controls: {UnknownName('member', str(control), seen)}")
        return cls(str(data.get("name", name)), tuple(members), source, tuple(controls))

    def only(self, names: Sequence[str]) -> Population:
        """These members alone. Raises TrainingError for a name that is not among them."""
        known = [member.name for member in self.members]
        for name in names:
            if name not in known:
                raise TrainingError(f"{self.source}: {UnknownName('member', name, known)}")
        return dataclasses.replace(self, members=tuple(m for m in self.members if m.name in names))

    def check(self) -> None:
        """Whether every member's algorithm takes its hyperparameters. Raises TrainingError; imports torch."""
        for member in self.members:
            try:
                check(member.algorithm, member.hyperparameters)
            except HyperparameterError as error:
                raise TrainingError(f"{self.source}: {member.name}: {error}") from None

    def command(self, member: TrainingSettings) -> str:
        """What trains this member again."""
        return f"tab-marl train {self.source} --only {member.name}"


def _where(source: str, number: int, member: Mapping[str, Any]) -> str:
    name = member.get("name", member.get("style"))
    return f"{source}: member {number}" + (f" ({name})" if isinstance(name, str) else "")


def _members(defaults: Mapping[str, Any], member: Mapping[str, Any], where: str) -> list[TrainingSettings]:
    """The settings of a member, one for each of its seeds."""
    merged = {**defaults, **member}
    for table in ("hyperparameters", "map"):
        if isinstance(defaults.get(table), dict) and isinstance(member.get(table), dict):
            merged[table] = {**defaults[table], **member[table]}
    seeds = merged.pop("seeds", None)
    if isinstance(merged.get("style"), list):
        merged["style"] = _mixture(merged["style"], where)
    style = merged.get("style")
    if isinstance(style, dict) and isinstance(style.get("name"), str):
        merged.setdefault("name", style["name"])
    if seeds is None:
        return [TrainingSettings.from_mapping(merged, where)]
    if not isinstance(seeds, list) or not seeds or not all(type(seed) is int and seed >= 0 for seed in seeds):
        raise TrainingError(f"{where}: seeds is {seeds!r}, must be a list of whole numbers >= 0")
    if "seed" in member:
        raise TrainingError(f"{where}: give seed or seeds, not both")
    first = TrainingSettings.from_mapping({**merged, "seed": seeds[0]}, where)
    return [dataclasses.replace(first, name=f"{first.name}-{seed}", seed=seed) for seed in seeds]


def _mixture(styles: Sequence[Any], where: str) -> dict[str, Any]:
    """One of these per episode, each a preset's name or a table."""
    found: list[Style] = []
    for style in styles:
        if isinstance(style, dict):
            try:
                found.append(TypeAdapter(Style).validate_python(style))
            except ValidationError as error:
                raise TrainingError(f"{where}: style: {first_line(error)}") from None
        elif isinstance(style, str) and style in STYLES:
            found.append(STYLES[style])
        else:
            raise TrainingError(f"{where}: {UnknownName('style', str(style), STYLES)}")
    if len(found) < 2:
        raise TrainingError(f"{where}: style is {list(styles)}, must name two or more styles, or be a single name")
    return as_toml(mixture_of("-".join(style.name for style in found), found))
