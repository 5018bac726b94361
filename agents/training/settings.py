"""Settings of one training run, in code and as TOML.

Settings are always complete: what is left out (steps, robots, layers, hyperparameters) is filled in from the packaged
hyperparameters of the algorithm when they are made, so that a run's folder and a policy's card say all of it.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import tomli_w
from pydantic import TypeAdapter, ValidationError

from tab_marl.agents.policies.cards import is_name
from tab_marl.agents.training.algorithms import ALGORITHMS
from tab_marl.agents.training.hyperparameters import (
    ACTIVATIONS,
    BATCHED_MISSIONS,
    HUNTED_MISSIONS,
    HyperparameterError,
    packaged,
    read_policy_kwargs,
    write_policy_kwargs,
)
from tab_marl.envs.styles import STYLES, Style
from tab_marl.mission.compositions import COMPOSITIONS
from tab_marl.mission.tasks import FAMILIES, MISSION_IDS
from tab_marl.world.sampling import MapOptions
from tab_marl.world.scenario import STRICT, UnknownName

SPLITS = ("development", "final")
"""What a policy may be used for: to develop planners and to learn from, or for final tables alone."""
UNOPPOSED = "none"


class TrainingError(ValueError):
    """Settings that cannot be used, or a folder that holds something else; one line that says what to do."""


@dataclass(frozen=True)
class TrainingSettings:
    """What a policy is trained on, and how. Defaults: the recipe that was measured to work."""

    name: str = "direct"
    """Of the policy, and of its folder in a zoo."""
    description: str = ""
    """For its card."""
    style: Style = field(default_factory=Style)
    algorithm: str = "ppo"
    """A name of `ALGORITHMS`, which are rl-baselines3-zoo's."""
    opponent: str = UNOPPOSED
    """Who hunts it: "none", "pursue", an SB3 ego's .zip, a planner such as "TAB-POMCP", or several joined by "+"."""
    habits_against: str = ""
    """Egos against which the weights of the style's mixture are learned when the policy is trained ("FP-POMCP+TAB-POMCP": one
    of them per episode; population-POMCP knows the present mixture); "": the weights stay."""
    habit_episodes: int = 1000
    """Hunted episodes from which they are learned."""
    initial: str = ""
    """A policy of the zoo, or the folder of a run or policy, whose weights it begins with; "": random ones."""
    split: str = SPLITS[0]
    missions: tuple[str, ...] = MISSION_IDS
    families: tuple[str, ...] = ("point", "ambiguous", "perimeter")
    compositions: tuple[str, ...] = ()
    """Missions composed otherwise than M1 to M5 (`mission.compositions`) that are trained on, too; the rest is held out."""
    map: MapOptions | None = None
    """How the maps are drawn; None: as tasks are drawn everywhere else."""
    difficulty: tuple[float, float] | None = None
    """Tasks are drawn by the curriculum at difficulties in this range (0 easy, 1 hard), instead of by `map`."""
    curriculum_share: float = 0.0
    """During this first part of the run the hardest task drawn rises from the easiest to the hardest; 0: all at once."""
    tasks: int = 360
    """Scenario x mission x latents draws in the bank."""
    seed: int = 0
    steps: int = 0
    """Control steps over all robots; 0: the hyperparameters' ``n_timesteps``."""
    robots: int = 0
    """Trained on side by side; 0: the hyperparameters' ``n_envs``."""
    hyperparameters: dict[str, Any] = field(default_factory=dict, hash=False)
    """The algorithm's own keyword arguments, over those of ``hyperparameters/<algorithm>.yml``; in the same format."""
    layers: tuple[int, ...] = ()
    """Widths of the actor's hidden layers; (): the hyperparameters'."""
    activation: str = ""
    """ "tanh" or "relu"; "": the hyperparameters'."""
    lstm_units: int = 0
    """Of a recurrent policy; 0: the hyperparameters'."""
    final_share: float = 0.15
    """The last part of the run, with the action noise set to `final_std` and exact-time missions drawn twice as often."""
    final_std: float = 0.2
    """Standard deviation of the action noise (on-policy: of the policy itself; TD3: of its exploration)."""
    ego_seen_metres: float = 0.8
    """A harmless ego is shown within this range in a quarter of the episodes, so that the policy ignores it; 0: never."""
    checkpoint_seconds: float = 10.0
    """At most this much work is lost when the run is killed."""

    __pydantic_config__: ClassVar = STRICT

    def __post_init__(self) -> None:
        for name in ("missions", "families", "compositions", "layers"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for mission in self.missions:
            if mission not in MISSION_IDS:
                raise UnknownName("mission type", mission, MISSION_IDS)
        for family in self.families:
            if family not in FAMILIES:
                raise UnknownName("scenario family", family, FAMILIES)
        for composition in self.compositions:
            if composition not in COMPOSITIONS:
                raise UnknownName("composition", composition, COMPOSITIONS)
        if self.algorithm not in ALGORITHMS:
            raise UnknownName("algorithm", self.algorithm, ALGORITHMS)
        if self.split not in SPLITS:
            raise UnknownName("split", self.split, SPLITS)
        if self.habit_episodes < 1:
            raise TrainingError(f"TrainingSettings.habit_episodes is {self.habit_episodes}, must be >= 1")
        if self.habits_against and not self.style.mixture:
            raise TrainingError(
                f"TrainingSettings.habits_against is {self.habits_against!r}, but the style {self.style.name!r} has no mixture "
                'to choose from: take style = "habits"'
            )
        if not self.missions or not self.families:
            raise TrainingError("TrainingSettings.missions and .families must not be empty")
        if not is_name(self.name):
            raise TrainingError(
                f"TrainingSettings.name is {self.name!r}, must be usable as a folder's name: letters, digits, '.', '_', '-'"
            )
        self._check_tasks()
        try:
            self._complete()
        except HyperparameterError as error:
            raise TrainingError(f"TrainingSettings.hyperparameters: {error}") from None
        for name in ("tasks", "steps", "robots"):
            if getattr(self, name) < 1:
                raise TrainingError(f"TrainingSettings.{name} is {getattr(self, name)}, must be >= 1")
        for name in ("final_std", "checkpoint_seconds"):
            if not getattr(self, name) > 0:
                raise TrainingError(f"TrainingSettings.{name} is {getattr(self, name)}, must be > 0")
        for name in ("final_share", "curriculum_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise TrainingError(f"TrainingSettings.{name} is {getattr(self, name)}, must lie in 0..1")
        if not self.layers or min(self.layers) < 1:
            raise TrainingError(f"TrainingSettings.layers is {self.layers}, must be one or more widths >= 1")

    def _check_tasks(self) -> None:
        if self.difficulty is None:
            if self.curriculum_share:
                raise TrainingError(
                    f"TrainingSettings.curriculum_share is {self.curriculum_share}: it needs difficulty = [easiest, hardest]"
                )
            return
        low, high = (float(bound) for bound in self.difficulty)
        object.__setattr__(self, "difficulty", (low, high))
        if not 0 <= low <= high <= 1:
            raise TrainingError(
                f"TrainingSettings.difficulty is {self.difficulty}, must be 0 <= easiest <= hardest <= 1"
            )
        if self.map is not None:
            raise TrainingError(
                "TrainingSettings.map and .difficulty exclude each other: difficulty draws the maps, too"
            )

    def _complete(self) -> None:
        """Fill in what was left to the packaged hyperparameters."""
        given = packaged(self.algorithm, self.environment) | self.hyperparameters
        steps, robots = given.pop("n_timesteps", 0), given.pop("n_envs", 0)
        policy = read_policy_kwargs(given.get("policy_kwargs", "dict()"))
        if self.layers and self.layers != _actor_layers(policy):
            policy["net_arch"] = list(self.layers)
        if self.activation and self.activation not in ACTIVATIONS:
            raise UnknownName("activation function", self.activation, ACTIVATIONS)
        usual = "Tanh" if ALGORITHMS[self.algorithm].on_policy else "ReLU"
        chosen = ACTIVATIONS.get(self.activation) or str(policy.get("activation_fn", usual)).removeprefix("nn.")
        policy["activation_fn"] = f"nn.{chosen}"
        if self.algorithm == "ppo_lstm":
            policy["lstm_hidden_size"] = self.lstm_units or policy.get("lstm_hidden_size", 256)
        elif self.lstm_units:
            raise TrainingError(f"TrainingSettings.lstm_units is {self.lstm_units}, but {self.algorithm} has no LSTM")
        given["policy_kwargs"] = write_policy_kwargs(policy)
        values = {
            "steps": self.steps or int(steps),
            "robots": self.robots or int(robots),
            "hyperparameters": given,
            "layers": _actor_layers(policy),
            "activation": next(name for name, of_torch in ACTIVATIONS.items() if of_torch == chosen),
            "lstm_units": policy.get("lstm_hidden_size", 0),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def environment(self) -> str:
        """The environment id under which its packaged hyperparameters stand."""
        return BATCHED_MISSIONS if self.opponent == UNOPPOSED else HUNTED_MISSIONS

    @property
    def hunted_episodes(self) -> int:
        """Episodes against live egos after the networks have learned."""
        return self.habit_episodes if self.habits_against else 0

    @property
    def final_step(self) -> float:
        """The control step with which the last part of the run begins."""
        return (1.0 - self.final_share) * self.steps

    @classmethod
    def for_style(cls, style: str, **changes: Any) -> TrainingSettings:
        """The defaults for a style by name. Raises UnknownName."""
        return cls(**{"name": style, "style": Style.preset(style), **changes})

    @classmethod
    def from_toml(cls, path: Path | str) -> TrainingSettings:
        """Read settings; `style` may be a table or the name of a style. Raises TrainingError naming file and field."""
        return cls.from_mapping(read_toml(path), str(path))

    @classmethod
    def from_mapping(cls, data: Mapping[str, Any], where: str) -> TrainingSettings:
        """Settings from what a TOML table holds. Raises TrainingError that begins with `where` and names the field."""
        data = dict(data)
        if isinstance(data.get("style"), str):
            if data["style"] not in STYLES:
                raise TrainingError(f"{where}: {UnknownName('style', data['style'], STYLES)}")
            data.setdefault("name", data["style"])
            data["style"] = as_toml(STYLES[data["style"]])
        try:
            return TypeAdapter(cls).validate_python(data)
        except (ValidationError, UnknownName) as error:
            raise TrainingError(f"{where}: {first_line(error)}") from None

    def to_toml(self) -> str:
        """The settings as TOML text that `from_toml` reads."""
        return tomli_w.dumps(as_toml(self))


def read_toml(path: Path | str) -> dict[str, Any]:
    """What a TOML file holds. Raises TrainingError."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise TrainingError(f"cannot read training settings {path}: {error}") from None


def first_line(error: Exception) -> str:
    """A validation error's first complaint, "field: what is wrong"."""
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        return f"{where + ': ' if where else ''}{first['msg'].removeprefix('Value error, ')}"
    return str(error)


def _actor_layers(policy: Mapping[str, Any]) -> tuple[int, ...]:
    layers = policy.get("net_arch", ())
    if isinstance(layers, Mapping):
        layers = layers.get("pi", ())
    if not isinstance(layers, list | tuple) or any(isinstance(x, bool) or not isinstance(x, int) for x in layers):
        raise HyperparameterError(f"net_arch is {layers!r}, must be a list of widths, or dict(pi=[...], qf=[...])")
    return tuple(layers)


def as_toml(settings: Any) -> dict[str, Any]:
    """Settings (a dataclass) as what a TOML table holds."""
    found: dict[str, Any] = _without_none(dataclasses.asdict(settings))
    return found


def _without_none(value: Any) -> Any:
    """TOML has no null: what is None is left out."""
    if isinstance(value, dict):
        return {name: _without_none(item) for name, item in value.items() if item is not None}
    if isinstance(value, list | tuple):
        return [_without_none(item) for item in value]
    return value
