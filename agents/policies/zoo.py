"""The zoo: trained adversary policies as plain weights with a card each. Loading one never executes code from the file.

A policy is a folder: ``card.json`` (what it is, how it was trained, what it does) and ``weights.safetensors`` (the
actor's tensors). The shipped ones lie in ``zoo/`` beside this file; a user's own in the folder that `user_zoo` names.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from tab_marl.agents.policies.actor import ACTIONS, Actor, ActorError, Memory
from tab_marl.agents.policies.cards import MissionRecord, PolicyCard, Split, is_name
from tab_marl.agents.policies.sb3_actors import LOG_STD, actor_of_model
from tab_marl.agents.training.settings import TrainingSettings
from tab_marl.envs.adversary_kernels import O_LIMIT
from tab_marl.envs.adversary_observation import LAYOUT_VERSION, OBSERVED
from tab_marl.envs.styles import STYLES, Style
from tab_marl.mission.tasks import Task
from tab_marl.world.scenario import UnknownName

__all__ = [
    "MissionRecord", "PolicyCard", "PolicyError", "ZooPolicy", "all_policies", "export_policy", "find_policy",
    "load_policy", "load_zoo", "policy_of", "save_policy", "user_zoo",
]  # fmt: skip

CARD_FILE = "card.json"
WEIGHTS_FILE = "weights.safetensors"
SHIPPED = Path(__file__).parent.parent / "zoo"
CONTROLS = Path(__file__).parent.parent / "controls"
"""Direct policies trained with other seeds, against which a style's own figure must move; they are no adversaries."""
ZOO_VARIABLE = "TAB_MARL_ZOO"
"""Environment variable that names the user's zoo."""
LARGEST_CARD_BYTES = 2**20
LARGEST_WEIGHTS_BYTES = 64 * 2**20


class PolicyError(ValueError):
    """A policy that cannot be loaded; one line that names the file and says what is wrong with it."""

    def __init__(self, said: str) -> None:
        # What a file says may stand in it: nothing that a terminal would do more than print.
        super().__init__("".join(c if c.isprintable() else "?" for c in said))


@dataclass(frozen=True, eq=False)
class ZooPolicy:
    """A trained policy. Acts from the adversary's observation alone; the same observations give the same actions.

    A recurrent one remembers the episode (or the batch of episodes) that it plays: use `another` to play two at once.
    """

    card: PolicyCard
    actor: Actor = field(repr=False)
    log_std: NDArray[np.float32] | None = field(default=None, repr=False)
    """``[2]`` logarithm of its action noise; None where training had none, or one that depends on the state."""
    memory: Memory = field(default_factory=Memory, repr=False)

    @property
    def name(self) -> str:
        return self.card.name

    @property
    def style(self) -> Style:
        return self.card.style

    @property
    def split(self) -> Split:
        return self.card.split

    def reset(self, task: Task, rng: np.random.Generator) -> None:
        """Begin an episode, or as many as there will be rows of observations."""
        self.memory.clear()

    def begin(self, which: NDArray[np.int64]) -> None:
        """Of the episodes played side by side, these begin anew."""
        self.memory.begin(which)

    def another(self) -> ZooPolicy:
        """The same policy with a memory of its own."""
        return dataclasses.replace(self, memory=Memory())

    def act(self, observation: NDArray[np.float32], rng: np.random.Generator | None = None) -> NDArray[np.float32]:
        """Action ``[2]`` (or ``[N, 2]``) in [-1, 1] for an observation ``[D]`` (or ``[N, D]``).

        `rng` adds the noise that it was trained with, where that is known. The mission's speed limit is kept by a governor,
        as in the batched world that policies are trained in, not by the network.
        """
        out: NDArray[Any] = self.actor.raw(observation, self.memory)
        if rng is not None and self.log_std is not None:
            out = out + np.exp(self.log_std) * rng.standard_normal(out.shape, dtype=np.float32)
        action = self.actor.bounded(out)
        np.minimum(action[..., 0], 2.0 * observation[..., O_LIMIT] - 1.0, out=action[..., 0])
        return action


def user_zoo() -> Path:
    """The folder of the user's own policies: TAB_MARL_ZOO, else ``tab-marl/zoo`` where the system keeps a user's data."""
    named = os.environ.get(ZOO_VARIABLE)
    if named:
        return Path(named).expanduser()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Application Support"
    else:
        base = Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share")
    return base / "tab-marl" / "zoo"


def load_zoo(folder: Path | str | None = None, split: Split | None = None) -> list[ZooPolicy]:
    """Every policy of a folder of policies (default: those that ship) and split (default: both), by name.

    Raises PolicyError.
    """
    root = SHIPPED if folder is None else Path(folder)
    if not root.is_dir():
        raise PolicyError(f"{root} is not a folder of policies")
    policies = []
    for path in sorted(root.iterdir()):
        if not path.name.startswith(".") and (path / CARD_FILE).exists():
            policy = load_policy(path)
            if policy.name != path.name:
                raise PolicyError(f"{path}: its card is that of {policy.name!r}, a policy's folder must have its name")
            policies.append(policy)
    return [policy for policy in policies if split in (None, policy.split)]


def all_policies(split: Split | None = None, zoo: Path | str | None = None) -> list[tuple[ZooPolicy, Path]]:
    """The shipped policies and the user's (of the folder `zoo`, default `user_zoo`), each with its folder.

    Raises PolicyError, also for a policy of the user's that has a shipped one's name.
    """
    own = user_zoo() if zoo is None else Path(zoo)
    found = [(policy, SHIPPED / policy.name) for policy in load_zoo()]
    if own.is_dir():
        shipped = {policy.name for policy, _ in found}
        for policy in load_zoo(own):
            if policy.name in shipped:
                raise PolicyError(f"{own / policy.name} has the name of a policy that ships: give it another")
            found.append((policy, own / policy.name))
    return [(policy, path) for policy, path in found if split in (None, policy.split)]


def find_policy(name_or_path: str) -> ZooPolicy:
    """A policy that ships or is the user's by name, or one from a folder. Raises UnknownName or PolicyError."""
    if is_name(name_or_path):
        for root in (SHIPPED, user_zoo()):
            if (root / name_or_path / CARD_FILE).exists():
                return load_policy(root / name_or_path)
    if Path(name_or_path).exists() or os.sep in name_or_path:
        return load_policy(name_or_path)
    raise UnknownName("policy", name_or_path, [policy.name for policy, _ in all_policies()])


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
    content = _read(folder / WEIGHTS_FILE, LARGEST_WEIGHTS_BYTES)
    if hashlib.sha256(content).hexdigest() != card.sha256:
        raise PolicyError(
            f"{folder / WEIGHTS_FILE} does not match the checksum in its card: restore or export it again"
        )
    try:
        tensors = load_tensors(content)
    except (SafetensorError, KeyError, ValueError, AttributeError) as error:
        raise PolicyError(f"{folder / WEIGHTS_FILE} is not a safetensors file ({error})") from None
    return _assemble(card, tensors, folder)


def _assemble(card: PolicyCard, tensors: Mapping[str, NDArray[Any]], folder: Path) -> ZooPolicy:
    if card.network.layers[0] != OBSERVED:
        raise PolicyError(f"{folder}: layers are {card.network.layers}, must begin with {OBSERVED}")
    try:
        actor = Actor(card.network, tensors)
    except ActorError as error:
        raise PolicyError(f"{folder}: {error}") from None
    unknown = set(tensors) - set(card.network.tensors) - {LOG_STD}
    if unknown:
        raise PolicyError(f"{folder}: {min(unknown)} is no tensor of the network that the card describes")
    log_std = tensors.get(LOG_STD)
    if log_std is not None and (log_std.shape != (ACTIONS,) or not np.isfinite(log_std).all()):
        raise PolicyError(f"{folder}: {LOG_STD} is not finite or not of shape ({ACTIONS},)")
    return ZooPolicy(card, actor, None if log_std is None else log_std.astype(np.float32))


def _read(path: Path, limit: int) -> bytes:
    """The file's content. Raises PolicyError if there is none or it is larger than any policy's."""
    try:
        with path.open("rb") as file:
            content = file.read(limit + 1)
    except OSError as error:
        raise PolicyError(f"cannot read {path}: {error.strerror}") from None
    if len(content) > limit:
        raise PolicyError(f"{path} is larger than {limit >> 20} MiB, no policy's file is")
    return content


def _read_card(path: Path) -> PolicyCard:
    try:
        return PolicyCard.model_validate_json(_read(path, LARGEST_CARD_BYTES))
    except (ValidationError, UnknownName) as error:
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            said = f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}"
        else:
            said = str(error)
        raise PolicyError(f"{path}: {said}") from None


def save_policy(policy: ZooPolicy, folder: Path | str) -> None:
    """Write a policy's folder; the card's checksum is that of the weights written. Raises OSError.

    A new folder appears whole or not at all. In one that is there, file by file; a kill between them is found out by the
    checksum.
    """
    target = Path(folder)
    tensors: dict[str, NDArray[np.float32]] = dict(policy.actor.tensors)
    if policy.log_std is not None:
        tensors[LOG_STD] = policy.log_std
    content = save_tensors({name: np.ascontiguousarray(array) for name, array in tensors.items()})
    card = policy.card.model_copy(update={"sha256": hashlib.sha256(content).hexdigest()})
    text = json.dumps(card.model_dump(mode="json"), indent=1) + "\n"
    target.parent.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name}-"))
    try:
        for name, data in ((WEIGHTS_FILE, content), (CARD_FILE, text.encode())):
            with (fresh / name).open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        if target.exists():
            for name in (WEIGHTS_FILE, CARD_FILE):
                os.replace(fresh / name, target / name)
        else:
            fresh.chmod(0o755)
            fresh.rename(target)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


def policy_of(
    model: Any, settings: TrainingSettings, steps: int, command: str = "", description: str = ""
) -> ZooPolicy:
    """The actor of a trained model as a policy without measured figures.

    `model`: PPO, A2C, SAC or TD3 of stable-baselines3, TQC or RecurrentPPO of sb3-contrib, with a plain policy. Raises
    PolicyError for another.
    """
    try:
        actor, log_std = actor_of_model(model)
    except ActorError as error:
        raise PolicyError(f"{settings.name}: {error}") from None
    card = PolicyCard(
        name=settings.name,
        description=description,
        algorithm=_algorithm(model),
        layout_version=LAYOUT_VERSION,
        network=actor.network,
        split=getattr(settings, "split", "development"),
        style=settings.style,
        missions=settings.missions,
        settings=TypeAdapter(type(settings)).dump_python(settings, mode="json"),
        steps=steps,
        command=command,
        sha256="0" * 64,
    )
    return ZooPolicy(card, actor, log_std)


def _algorithm(model: Any) -> str:
    """Class, package and version, e.g. "PPO (stable-baselines3 2.9.2)"."""
    from importlib import import_module

    package = type(model).__module__.split(".")[0]
    version = getattr(import_module(package), "__version__", "")
    return f"{type(model).__name__} ({package.replace('_', '-')} {version})".replace(" )", ")")


POLICY_FOLDER = "policy"


def export_policy(model: Any, settings: TrainingSettings, out_dir: Path | str, command: str | None = None) -> Path:
    """Write the actor of a trained model to ``out_dir/policy`` and return that folder. Raises OSError.

    command: what trains it again; None: `tab-marl train` with options, or with the settings file.
    """
    if command is None:
        usual = settings.style.name in STYLES and settings == TrainingSettings.for_style(
            settings.style.name,
            name=settings.name,
            algorithm=settings.algorithm,
            seed=settings.seed,
            steps=settings.steps,
        )
        command = (
            f"tab-marl train --style {settings.style.name} --algorithm {settings.algorithm} --name {settings.name} "
            f"--seed {settings.seed} --steps {settings.steps}"
            if usual
            else "tab-marl train --config settings.toml"
        )
    from tab_marl.agents.hunted.habits import learned_style

    policy = policy_of(model, settings, int(model.num_timesteps), command, settings.description)
    style = learned_style(settings.style, out_dir)
    policy = dataclasses.replace(policy, card=policy.card.model_copy(update={"style": style}))
    folder = Path(out_dir) / POLICY_FOLDER
    save_policy(policy, folder)
    return folder
