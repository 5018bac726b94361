"""What to evaluate. The part of the settings that decides a row's content has a key; rows under different keys never mix."""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

from tab_marl.evaluation.errors import UserError, require_known

MISSIONS = ("M1", "M2", "M3", "M4", "M5")
FAMILIES = ("point", "perimeter", "ambiguous")
PAPER_PLANNERS = ("S-POMCP", "FP-POMCP", "MLE-POMCP", "TAB-POMCP")
OWN_PLANNERS = ("TAB-POMCP+precedents",)
"""Beyond the paper's."""
COMPETING_PLANNERS = (*PAPER_PLANNERS, *OWN_PLANNERS)
REFERENCE_PLANNERS = ("population-POMCP", "oracle", "random")
"""They know what no ego can know, or nothing: bounds, which do not compete."""
PLANNERS = (*COMPETING_PLANNERS, *REFERENCE_PLANNERS)
LEARNS_ACROSS_EPISODES = frozenset({"MLE-POMCP"})
HEADLINE = "TAB-POMCP"


def short(planner: str) -> str:
    """A planner's name where space is scarce."""
    return planner.replace("-POMCP", "")


# What decides an episode: a change in any of these makes rows that must not be mixed with older ones.
CODE = ("world", "mission", "field", "planning", "envs", "agents")


@dataclass(frozen=True)
class EvaluationSettings:
    """Missions x families x planners x seeds, against the adversaries of the zoo in turn."""

    missions: tuple[str, ...] = MISSIONS
    families: tuple[str, ...] = FAMILIES
    planners: tuple[str, ...] = PLANNERS
    adversaries: tuple[str, ...] = ()
    """Policies that take turns over the seeds: names, folders, or a split of the zoo; empty means the final split."""
    mix_splits: bool = False
    """Whether policies for development and those of the final table may stand in one table."""
    episodes: int = 150
    """Per mission, family and planner."""
    seed: int = 2025
    """Base seed: decides every task, adversary and noise."""
    slack: float | None = None
    """Allowed time over shortest time; None draws one per task."""
    planner_preset: Literal["default", "paper"] = "default"
    """`paper` plans with the literal field, without drawn ways and without the price of a completed mission."""
    workers: int | None = None
    """Processes; None means one per processor core."""
    replays: int = 3
    """Animated replays in the report."""

    __pydantic_config__: ClassVar = {"extra": "forbid"}

    def __post_init__(self) -> None:
        for field in ("missions", "families", "planners"):
            if not getattr(self, field):
                raise UserError(f"{field} is empty: name at least one")
        if self.episodes < 1:
            raise UserError(f"episodes is {self.episodes}, must be >= 1")
        if self.seed < 0:
            raise UserError(f"seed is {self.seed}, must be >= 0")
        if self.slack is not None and not 1.0 < self.slack <= 100.0:
            raise UserError(f"slack is {self.slack}, must lie in (1, 100] (allowed time over shortest time)")
        if self.workers is not None and not 1 <= self.workers <= 1024:
            raise UserError(f"workers is {self.workers}, must lie in [1, 1024]")
        if not 0 <= self.replays <= 30:
            raise UserError(f"replays is {self.replays}, must lie in [0, 30]")

    def checked(self) -> EvaluationSettings:
        """The same with every name in its own spelling. Raises UserError with the nearest name."""
        return dataclasses.replace(
            self,
            missions=require_known("mission", self.missions, MISSIONS),
            families=require_known("family", self.families, FAMILIES),
            planners=require_known("planner", self.planners, PLANNERS),
        )

    @property
    def total(self) -> int:
        return len(self.missions) * len(self.families) * len(self.planners) * self.episodes

    def content(self, code: str, adversaries: tuple[str, ...]) -> dict[str, Any]:
        """What a row depends on beside its own (mission, family, planner, seed): not how many rows there are."""
        return {
            "seed": self.seed,
            "slack": self.slack,
            "planner_preset": self.planner_preset,
            "adversaries": list(adversaries),
            "code": code,
            **({"mix_splits": True} if self.mix_splits else {}),
        }


def settings_key(content: Mapping[str, Any]) -> str:
    """A short name for the content; equal content, equal key, on every machine."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=6).hexdigest()


PRESETS: dict[str, dict[str, Any]] = {
    "demo": {"episodes": 3, "families": ("point", "ambiguous"), "replays": 3},
    "paper": {"episodes": 150},
}
"""Sizes by name: `demo` ends in minutes on two cores; `paper` is the paper's table, three families instead of one."""


def build_settings(
    preset: str | None = None, config: Path | None = None, overrides: Mapping[str, Any] | None = None
) -> EvaluationSettings:
    """Preset, then the file, then what was given on the command line (None: not given). Raises UserError."""
    from pydantic import TypeAdapter, ValidationError

    values: dict[str, Any] = {}
    if preset is not None:
        (name,) = require_known("preset", (preset,), PRESETS)
        values |= PRESETS[name]
    source = "settings"
    if config is not None:
        source = str(config)
        values |= read_toml(config)
    values |= {name: value for name, value in (overrides or {}).items() if value is not None}
    try:
        return TypeAdapter(EvaluationSettings).validate_python(values).checked()
    except ValidationError as error:
        raise UserError(f"{source}: {first_problem(error)}") from error


def first_problem(error: Any) -> str:
    """The first problem of a pydantic ValidationError: field, what is wrong, the value given."""
    problem = error.errors(include_url=False)[0]
    where = ".".join(str(part) for part in problem["loc"]) or "settings"
    if problem["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"{where}: there is no such setting"
    return f"{where}: {problem['msg'][0].lower()}{problem['msg'][1:]} (got {problem['input']!r})"


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file as a table. Raises UserError naming the file and the place."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"{path}: there is no such file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: not valid TOML: {error}") from None


def code_fingerprint() -> str:
    """A digest of the code and policies that decide an episode. Comments, docstrings and layout do not count."""
    import tab_marl.agents
    import tab_marl.envs

    digest = hashlib.blake2b(digest_size=8)
    base = Path(tab_marl.agents.__file__).parent, Path(tab_marl.envs.__file__).parent
    folders = {"agents": base[0], "envs": base[1]}
    science = Path(__file__).parent.parent
    for part in CODE:
        folder = folders.get(part, science / part)
        for path in sorted(folder.rglob("*")):
            if path.suffix == ".py":
                digest.update(_meaning(path))
            elif path.suffix in (".lark", ".safetensors", ".json") and path.is_file():
                digest.update(path.name.encode() + path.read_bytes())
    for name in ("episode.py", "adversaries.py", "units.py"):
        digest.update(_meaning(Path(__file__).parent / name))
    return digest.hexdigest()


def _meaning(path: Path) -> bytes:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):  # docstrings, and the strings under a dataclass field
            node.body = [  # type: ignore[attr-defined]
                line
                for line in body
                if not (
                    isinstance(line, ast.Expr)
                    and isinstance(line.value, ast.Constant)
                    and isinstance(line.value.value, str)
                )
            ]
    return path.name.encode() + ast.dump(tree).encode()
