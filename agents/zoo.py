"""The zoo: trained adversary policies as plain weights with a card each. Loading one never executes code from the file.

A policy is a folder: ``card.json`` (what it is, how it was trained, what it does) and ``weights.safetensors`` (the
actor's layers, and the logarithm of its action noise). The shipped ones lie in ``zoo/`` beside this file.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from tab_marl.agents.training_settings import TrainingSettings
from tab_marl.envs.adversary_observation import LAYOUT_VERSION, OBSERVED
from tab_marl.envs.styles import STYLES, Style
from tab_marl.mission.tasks import Task
from tab_marl.world.scenario import UnknownName

CARD_FILE = "card.json"
WEIGHTS_FILE = "weights.safetensors"
SHIPPED = Path(__file__).parent / "zoo"
ACTIONS = 2
LOG_STD = "log_std"


class PolicyError(ValueError):
    """A policy that cannot be loaded; one line that names the file and says what is wrong with it."""


class MissionRecord(BaseModel):
    """Unopposed success on held-out tasks of one mission type."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    mission: str
    world: str
    """ "batched" (kinematic) or "physics" (pymunk)."""
    completed: int = Field(ge=0)
    episodes: int = Field(ge=1)
    low: float
    """95 % Wilson interval of the share completed."""
    high: float

    @property
    def share(self) -> float:
        return self.completed / self.episodes


class PolicyCard(BaseModel):
    """What a policy is and what it was measured to do."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    description: str = ""
    algorithm: str
    layout_version: int
    layers: tuple[int, ...]
    """Widths, the observation's first and the action's last."""
    missions: tuple[str, ...]
    """Mission types that the policy claims."""
    settings: TrainingSettings
    steps: int
    command: str
    """What trains this policy again."""
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    """Of the weights file."""
    success: tuple[MissionRecord, ...] = ()
    statistics: dict[str, float] = Field(default_factory=dict)
    """The style's own figures on held-out tasks; "... (control n)" are the same figures of re-seeded direct policies."""

    @property
    def style(self) -> Style:
        return self.settings.style


@dataclass(frozen=True, eq=False)
class ZooPolicy:
    """A trained policy. Acts from the adversary's observation alone; the same observation gives the same action."""

    card: PolicyCard
    weights: tuple[NDArray[np.float32], ...] = field(repr=False)
    """Per layer ``[in, out]``."""
    biases: tuple[NDArray[np.float32], ...] = field(repr=False)
    log_std: NDArray[np.float32] = field(repr=False)

    @property
    def name(self) -> str:
        return self.card.name

    @property
    def style(self) -> Style:
        return self.card.settings.style

    def reset(self, task: Task, rng: np.random.Generator) -> None:
        """Nothing to do: everything that a policy remembers is in its observation."""

    def act(self, observation: NDArray[np.float32], rng: np.random.Generator | None = None) -> NDArray[np.float32]:
        """Action ``[2]`` (or ``[N, 2]``) in [-1, 1] for an observation ``[D]`` (or ``[N, D]``); `rng` adds its noise."""
        hidden: NDArray[Any] = observation
        last = len(self.weights) - 1
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = hidden @ weight
            hidden += bias
            if layer < last:
                np.tanh(hidden, out=hidden)
        if rng is not None:
            hidden = hidden + np.exp(self.log_std) * rng.standard_normal(hidden.shape, dtype=np.float32)
        return np.minimum(np.maximum(hidden, np.float32(-1.0)), np.float32(1.0))


def load_zoo(folder: Path | str | None = None) -> list[ZooPolicy]:
    """Every policy of a folder of policies (default: those that ship), by name. Raises PolicyError."""
    root = SHIPPED if folder is None else Path(folder)
    if not root.is_dir():
        raise PolicyError(f"{root} is not a folder of policies")
    return [load_policy(path) for path in sorted(root.iterdir()) if (path / CARD_FILE).exists()]


def find_policy(name_or_path: str) -> ZooPolicy:
    """A shipped policy by name, or one from a folder. Raises UnknownName or PolicyError."""
    if (SHIPPED / name_or_path / CARD_FILE).exists():
        return load_policy(SHIPPED / name_or_path)
    if Path(name_or_path).exists() or os.sep in name_or_path:
        return load_policy(name_or_path)
    raise UnknownName("policy", name_or_path, [policy.name for policy in load_zoo()])


def load_policy(path: Path | str) -> ZooPolicy:
    """The policy in this folder. Raises PolicyError: files missing or malformed, wrong checksum, layout or shapes."""
    folder = Path(path)
    if not folder.is_dir():
        raise PolicyError(f"{folder} is not a policy: expected a folder that holds {CARD_FILE} and {WEIGHTS_FILE}")
    card = _read_card(folder / CARD_FILE)
    if card.layout_version != LAYOUT_VERSION:
        raise PolicyError(
            f"{folder}: trained on version {card.layout_version} of the adversary's observation, this program gives "
            f"version {LAYOUT_VERSION}: train it anew"
        )
    content = _read(folder / WEIGHTS_FILE)
    if hashlib.sha256(content).hexdigest() != card.sha256:
        raise PolicyError(
            f"{folder / WEIGHTS_FILE} does not match the checksum in its card: restore or export it again"
        )
    try:
        tensors = load_tensors(content)
    except (SafetensorError, KeyError, ValueError) as error:
        raise PolicyError(f"{folder / WEIGHTS_FILE} is not a safetensors file ({error})") from None
    return _assemble(card, tensors, folder)


def _assemble(card: PolicyCard, tensors: Mapping[str, NDArray[Any]], folder: Path) -> ZooPolicy:
    if card.layers[0] != OBSERVED or card.layers[-1] != ACTIONS:
        raise PolicyError(f"{folder}: layers are {card.layers}, must begin with {OBSERVED} and end with {ACTIONS}")
    weights: list[NDArray[np.float32]] = []
    biases: list[NDArray[np.float32]] = []
    for i, (inputs, outputs) in enumerate(zip(card.layers, card.layers[1:], strict=False)):
        for name, shape in ((f"layers.{i}.weight", (inputs, outputs)), (f"layers.{i}.bias", (outputs,))):
            array = tensors.get(name)
            if array is None or array.shape != shape or array.dtype != np.float32 or not np.isfinite(array).all():
                found = "missing" if array is None else f"{array.dtype} {array.shape}"
                raise PolicyError(f"{folder}: {name} is {found}, must be finite float32 {shape}")
            (weights if len(shape) == 2 else biases).append(np.ascontiguousarray(array))
    log_std = tensors.get(LOG_STD)
    if log_std is None or log_std.shape != (ACTIONS,):
        raise PolicyError(f"{folder}: {LOG_STD} is missing or not of shape ({ACTIONS},)")
    return ZooPolicy(card, tuple(weights), tuple(biases), log_std.astype(np.float32))


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise PolicyError(f"cannot read {path}: {error.strerror}") from None


def _read_card(path: Path) -> PolicyCard:
    try:
        return PolicyCard.model_validate_json(_read(path))
    except (ValidationError, UnknownName) as error:
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            said = f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}"
        else:
            said = str(error)
        raise PolicyError(f"{path}: {said}") from None


def save_policy(policy: ZooPolicy, folder: Path | str) -> None:
    """Write a policy's folder; the card's checksum is that of the weights written. Raises OSError."""
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    tensors: dict[str, NDArray[np.float32]] = {LOG_STD: policy.log_std}
    for i, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        tensors[f"layers.{i}.weight"], tensors[f"layers.{i}.bias"] = weight, bias
    content = save_tensors(tensors)
    card = policy.card.model_copy(update={"sha256": hashlib.sha256(content).hexdigest()})
    text = json.dumps(card.model_dump(mode="json"), indent=1) + "\n"
    for name, data in ((WEIGHTS_FILE, content), (CARD_FILE, text.encode())):
        temporary = target / (name + ".tmp")
        temporary.write_bytes(data)
        os.replace(temporary, target / name)


def policy_of(
    model: Any, settings: TrainingSettings, steps: int, command: str = "", description: str = ""
) -> ZooPolicy:
    """The actor of a trained stable-baselines3 PPO model, as a policy without measured figures."""
    import stable_baselines3

    state = {name: tensor.detach().cpu().numpy() for name, tensor in model.policy.state_dict().items()}
    names = [f"mlp_extractor.policy_net.{2 * i}" for i in range(len(settings.layers))] + ["action_net"]
    weights = tuple(np.ascontiguousarray(state[f"{name}.weight"].T, dtype=np.float32) for name in names)
    biases = tuple(state[f"{name}.bias"].astype(np.float32) for name in names)
    card = PolicyCard(
        name=settings.name,
        description=description,
        algorithm=f"PPO (stable-baselines3 {stable_baselines3.__version__})",
        layout_version=LAYOUT_VERSION,
        layers=(OBSERVED, *settings.layers, ACTIONS),
        missions=settings.missions,
        settings=settings,
        steps=steps,
        command=command,
        sha256="0" * 64,
    )
    return ZooPolicy(card, weights, biases, state[LOG_STD].astype(np.float32))


POLICY_FOLDER = "policy"


def export_policy(model: Any, settings: TrainingSettings, out_dir: Path | str) -> Path:
    """Write the actor of a trained model to ``out_dir/policy`` and return that folder. Raises OSError."""
    usual = settings.style.name in STYLES and settings == TrainingSettings.for_style(
        settings.style.name, name=settings.name, seed=settings.seed, steps=settings.steps
    )
    command = f"tab-marl train --style {settings.style.name} --name {settings.name} --seed {settings.seed} --steps {settings.steps}"
    policy = policy_of(
        model, settings, int(model.num_timesteps), command if usual else "tab-marl train --config settings.toml"
    )
    folder = Path(out_dir) / POLICY_FOLDER
    save_policy(policy, folder)
    return folder
