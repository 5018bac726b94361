"""Settings of one training run, in code and as TOML."""

from __future__ import annotations

import dataclasses
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import tomli_w
from pydantic import TypeAdapter, ValidationError

from tab_marl.envs.styles import STYLES, Style
from tab_marl.mission.tasks import FAMILIES, MISSION_IDS
from tab_marl.world.scenario import STRICT, UnknownName


class TrainingError(ValueError):
    """Settings that cannot be used, or a folder that holds something else; one line that says what to do."""


@dataclass(frozen=True)
class TrainingSettings:
    """What a policy is trained on, and how. Defaults: the recipe that was measured to work."""

    name: str = "direct"
    """Of the policy, and of its folder in a zoo."""
    style: Style = field(default_factory=Style)
    missions: tuple[str, ...] = MISSION_IDS
    families: tuple[str, ...] = ("point", "ambiguous", "perimeter")
    tasks: int = 360
    """Scenario x mission x latents draws in the bank."""
    seed: int = 0
    steps: int = 1_000_000
    """Control steps over all robots."""
    robots: int = 64
    rollout_steps: int = 128
    """Steps of each robot between two updates."""
    batch: int = 2048
    epochs: int = 5
    learning_rate: float = 5e-4
    final_learning_rate: float = 5e-5
    discount: float = 0.995
    """Per control step of 0.1 s."""
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy: float = 0.001
    layers: tuple[int, ...] = (128, 128)
    final_share: float = 0.15
    """The last part of the run, with the action noise set to `final_std` and exact-time missions drawn twice as often."""
    final_std: float = 0.2
    ego_seen_metres: float = 0.8
    """A harmless ego is shown within this range in a quarter of the episodes, so that the policy ignores it; 0: never."""
    checkpoint_seconds: float = 10.0
    """At most this much work is lost when the run is killed."""

    __pydantic_config__: ClassVar = STRICT

    def __post_init__(self) -> None:
        for mission in self.missions:
            if mission not in MISSION_IDS:
                raise UnknownName("mission type", mission, MISSION_IDS)
        for family in self.families:
            if family not in FAMILIES:
                raise UnknownName("scenario family", family, FAMILIES)
        if not self.missions or not self.families:
            raise TrainingError("TrainingSettings.missions and .families must not be empty")
        if not self.name or any(c in self.name for c in "/\\") or self.name.startswith("."):
            raise TrainingError(f"TrainingSettings.name is {self.name!r}, must be usable as a folder's name")
        for name in ("tasks", "steps", "robots", "rollout_steps", "batch", "epochs"):
            if getattr(self, name) < 1:
                raise TrainingError(f"TrainingSettings.{name} is {getattr(self, name)}, must be >= 1")
        for name in ("learning_rate", "final_learning_rate", "final_std", "checkpoint_seconds", "clip"):
            if not getattr(self, name) > 0:
                raise TrainingError(f"TrainingSettings.{name} is {getattr(self, name)}, must be > 0")
        for name in ("discount", "gae_lambda", "final_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise TrainingError(f"TrainingSettings.{name} is {getattr(self, name)}, must lie in 0..1")
        if not self.layers or min(self.layers) < 1:
            raise TrainingError(f"TrainingSettings.layers is {self.layers}, must be one or more widths >= 1")
        for name in ("missions", "families", "layers"):
            object.__setattr__(self, name, tuple(getattr(self, name)))

    @classmethod
    def for_style(cls, style: str, **changes: Any) -> TrainingSettings:
        """The defaults for a style by name. Raises UnknownName."""
        return dataclasses.replace(cls(name=style, style=Style.preset(style)), **changes)

    @classmethod
    def from_toml(cls, path: Path | str) -> TrainingSettings:
        """Read settings; `style` may be a table or the name of a style. Raises TrainingError naming file and field."""
        try:
            data = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise TrainingError(f"cannot read training settings {path}: {error}") from None
        if isinstance(data.get("style"), str):
            if data["style"] not in STYLES:
                raise TrainingError(f"{path}: {UnknownName('style', data['style'], STYLES)}")
            data["style"] = dataclasses.asdict(STYLES[data["style"]])
            if data["style"]["arrival_fraction"] is None:
                del data["style"]["arrival_fraction"]
        try:
            return TypeAdapter(cls).validate_python(data)
        except (ValidationError, UnknownName) as error:
            raise TrainingError(f"{path}: {_first_line(error)}") from None

    def to_toml(self) -> str:
        """The settings as TOML text that `from_toml` reads."""
        data = dataclasses.asdict(self)
        if data["style"]["arrival_fraction"] is None:
            del data["style"]["arrival_fraction"]
        return tomli_w.dumps(data)


def _first_line(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        return f"{where + ': ' if where else ''}{first['msg']}"
    return str(error)
