"""The actors of stable-baselines3 and sb3-contrib models: PPO, A2C, RecurrentPPO, SAC, TD3 and TQC.

Taken from a live model, or from a zip that such a model saved. A zip is read as plain tensors and JSON: nothing in it is
executed, unlike with stable-baselines3's own `load`; what could be executed in it (pickled settings) is not looked at.
"""

from __future__ import annotations

import io
import json
import pickle
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from tab_marl.agents.policies.actor import Actor, ActorError, Network

WEIGHTS_IN_ZIP, DATA_IN_ZIP = "policy.pth", "data"
LARGEST_WEIGHTS_BYTES = 64 * 2**20
LARGEST_DATA_BYTES = 16 * 2**20
LOG_STD = "log_std"
_ACTIVATIONS = {"Tanh": "tanh", "ReLU": "relu"}
_LSTM = {"weight_ih_l0", "weight_hh_l0", "bias_ih_l0", "bias_hh_l0"}

State = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class _Family:
    """How the actors of some algorithms are named in a state dict."""

    hidden: str
    """Prefix of the layers before the last."""
    last: str
    owned: tuple[str, ...]
    """Prefixes of everything that the actor computes with."""
    activation: str
    """By default."""
    squashed: bool


_FAMILIES = (
    _Family(
        "mlp_extractor.policy_net.",
        "action_net.",
        ("mlp_extractor.policy_net.", "mlp_extractor.shared_net.", "action_net.", "lstm_actor.", "features_extractor.",
         "pi_features_extractor."),
        "Tanh",
        False,
    ),
    _Family("actor.latent_pi.", "actor.mu.", ("actor.",), "ReLU", True),
    _Family("actor.mu.", "", ("actor.",), "ReLU", True),
)  # fmt: skip


def actor_of_model(model: Any) -> tuple[Actor, NDArray[np.float32] | None]:
    """The actor of a live model, and the logarithm of its action noise ``[2]`` where that is a constant.

    Raises ActorError for a model that is none of the six algorithms with a plain policy (MlpPolicy, MlpLstmPolicy).
    """
    policy = model.policy
    state = {name: tensor.detach().cpu().numpy() for name, tensor in policy.state_dict().items()}
    owner = getattr(policy, "actor", None) or policy
    activation = getattr(owner, "activation_fn", None)
    squashed = bool(getattr(owner, "squash_output", False))
    return actor_of_state(state, getattr(activation, "__name__", None), squashed), _log_std(state)


@dataclass(frozen=True, eq=False)
class SavedActor:
    """What a model's zip says."""

    actor: Actor
    log_std: NDArray[np.float32] | None
    """Logarithm of the action noise ``[2]``; None where it is not a constant."""
    algorithm: str
    """ "PPO", "A2C", "RecurrentPPO", "SAC", "TQC" or "TD3", as far as the settings tell."""
    steps: int
    """Environment steps that it was trained for; 0 if the zip does not say."""


def read_zip(path: Path | str) -> SavedActor:
    """The actor in a zip that ``model.save`` wrote.

    Raises ActorError: no such file, not such a zip, too large, or no actor that is known here.
    """
    file = Path(path)
    try:
        state, data = _read_zip(file)
    except (
        OSError, KeyError, ValueError, RuntimeError, EOFError, AttributeError, TypeError, NotImplementedError,
        RecursionError, zipfile.BadZipFile, pickle.UnpicklingError,
    ) as error:  # fmt: skip
        said = str(error).splitlines()[0][:300] if str(error) else type(error).__name__
        raise ActorError(f"{file} is not a model that stable-baselines3 saved ({said})") from None
    try:
        _check_actions(data)
        actor = actor_of_state(state, _activation(data), bool(_kwargs(data).get("squash_output", False)))
    except ActorError as error:
        raise ActorError(f"{file}: {error}") from None
    steps = data.get("num_timesteps")
    steps = steps if isinstance(steps, int) and not isinstance(steps, bool) and steps > 0 else 0
    return SavedActor(actor, _log_std(state), _algorithm(actor, state, data), steps)


def actor_of_state(state: State, activation: str | None, squashed: bool = False) -> Actor:
    """The actor whose parameters are in a policy's state dict.

    activation: the class name, "Tanh" or "ReLU"; None: the algorithm's default. squashed: for on-policy models, whether
    tanh is applied (only with gSDE). Raises ActorError.
    """
    family = _family(state)
    prefix, left = family.hidden, {name for name in state if name.startswith(family.owned)}
    left -= {name for name in left if name.startswith("actor.log_std")}
    numbers = sorted(
        {
            int(m.group(1))
            for name in left
            if (m := re.fullmatch(re.escape(prefix) + r"(\d{1,4})\.(?:weight|bias)", name))
        }
    )
    names = [f"{prefix}{i}." for i in numbers] + ([family.last] if family.last else [])
    tensors: dict[str, NDArray[np.float32]] = {}
    widths: list[int] = []
    lstm_units = 0
    if "lstm_actor.weight_ih_l0" in left:
        lstm = {name.removeprefix("lstm_actor."): state[name] for name in left if name.startswith("lstm_actor.")}
        if set(lstm) != _LSTM:
            raise ActorError(
                "its LSTM has several layers, two directions or no bias: only a plain one layer is known here"
            )
        lstm_units = int(lstm["weight_hh_l0"].shape[-1])
        widths.append(int(lstm["weight_ih_l0"].shape[-1]))
        tensors["lstm.input"] = _plain(lstm["weight_ih_l0"]).T
        tensors["lstm.recurrent"] = _plain(lstm["weight_hh_l0"]).T
        tensors["lstm.bias"] = _plain(lstm["bias_ih_l0"]) + _plain(lstm["bias_hh_l0"])
        left -= {f"lstm_actor.{name}" for name in _LSTM}
    for i, name in enumerate(names):
        weight, bias = state.get(f"{name}weight"), state.get(f"{name}bias")
        if weight is None or bias is None or weight.ndim != 2:
            raise ActorError(f"layer {name.rstrip('.')} is not a plain linear layer")
        if not widths:
            widths.append(int(weight.shape[1]))
        widths.append(int(weight.shape[0]))
        tensors[f"layers.{i}.weight"], tensors[f"layers.{i}.bias"] = _plain(weight).T, _plain(bias)
        left -= {f"{name}weight", f"{name}bias"}
    if left:
        raise ActorError(f"its actor has parts that are not known here ({', '.join(sorted(left)[:3])})")
    name = activation or family.activation
    if name not in _ACTIVATIONS:
        raise ActorError(f"activation function {name} is not known here, must be one of {list(_ACTIVATIONS)}")
    try:
        network = Network.model_validate(
            {
                "kind": "lstm" if lstm_units else "mlp",
                "activation": _ACTIVATIONS[name],
                "squashed": family.squashed or squashed,
                "layers": widths,
                "lstm_units": lstm_units,
            }
        )
    except ValidationError as error:
        first = error.errors()[0]
        raise ActorError(f"network.{'.'.join(str(p) for p in first['loc'])}: {first['msg']}") from None
    return Actor(network, tensors)


def normalised(actor: Actor, mean: NDArray[Any], variance: NDArray[Any], clip: float, epsilon: float = 1e-8) -> Actor:
    """The actor behind SB3's VecNormalize with these statistics of the observation ``[D]``. Raises ActorError."""
    network = actor.network.model_copy(update={"observation_clip": float(clip)})
    with np.errstate(invalid="ignore"):
        deviation = np.sqrt(np.asarray(variance, dtype=np.float64) + epsilon).astype(np.float32)
    statistics = {"observation.mean": np.asarray(mean).astype(np.float32), "observation.deviation": deviation}
    return Actor(Network.model_validate(network.model_dump()), {**actor.tensors, **statistics})


def _family(state: State) -> _Family:
    for family in _FAMILIES:
        if family.last and (f"{family.last}weight" in state or any(n.startswith(family.hidden) for n in state)):
            return family
        # An actor with log_std is SAC's with gSDE, whose mean is clipped: not known here.
        if not family.last and f"{family.hidden}0.weight" in state and "actor.log_std" not in state:
            return family
    raise ActorError(
        "it holds no actor of PPO, A2C, RecurrentPPO, SAC, TD3 or TQC with a plain MlpPolicy or MlpLstmPolicy"
    )


def _algorithm(actor: Actor, state: State, data: Mapping[str, Any]) -> str:
    """By what only the one algorithm saves."""
    if actor.network.kind == "lstm":
        return "RecurrentPPO"
    if "action_net.weight" in state:
        return "PPO" if "clip_range" in data else "A2C"
    if "actor.mu.weight" in state:
        return "TQC" if "top_quantiles_to_drop_per_net" in data else "SAC"
    return "TD3"


def _check_actions(data: Mapping[str, Any]) -> None:
    """Raises ActorError if the saved settings say that actions were not in [-1, 1]."""
    space = data.get("action_space")
    if not isinstance(space, dict):
        return
    for name, bound in (("low", -1.0), ("high", 1.0)):
        found = space.get(name)
        if isinstance(found, str) and {float(x) for x in re.findall(r"-?\d+\.?\d*", found[:200])} - {bound}:
            raise ActorError(f"its actions have {name} = {found[:40]}, must be {bound:g} in both: train on our ids")


def _log_std(state: State) -> NDArray[np.float32] | None:
    """The logarithm of the action noise where it is a constant (not state-dependent as SAC's and gSDE's are)."""
    found = state.get(LOG_STD)
    return None if found is None or found.shape != (2,) or not np.isfinite(found).all() else _plain(found)


def _plain(array: NDArray[Any]) -> NDArray[np.float32]:
    return np.ascontiguousarray(array, dtype=np.float32)


def _read_zip(file: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """State dict and settings, both of bounded size."""
    import torch

    with zipfile.ZipFile(file) as archive:
        weights = _member(archive, WEIGHTS_IN_ZIP, LARGEST_WEIGHTS_BYTES)
        data = json.loads(_member(archive, DATA_IN_ZIP, LARGEST_DATA_BYTES))
    if not isinstance(data, dict):
        raise TypeError(f"{DATA_IN_ZIP} is not a JSON object")
    with zipfile.ZipFile(io.BytesIO(weights)) as inner:
        if sum(info.file_size for info in inner.infolist()) > LARGEST_WEIGHTS_BYTES:
            raise ValueError(f"{WEIGHTS_IN_ZIP} unpacks to more than {LARGEST_WEIGHTS_BYTES >> 20} MiB")
    # Tensors alone: torch refuses to unpickle anything else.
    found = torch.load(io.BytesIO(weights), map_location="cpu", weights_only=True)
    if not isinstance(found, Mapping):
        raise TypeError(f"{WEIGHTS_IN_ZIP} is not a dictionary of tensors")
    state = {str(name): tensor for name, tensor in found.items() if isinstance(tensor, torch.Tensor)}
    # A view may claim to be far larger than what is stored.
    if sum(4 * tensor.numel() for tensor in state.values()) > LARGEST_WEIGHTS_BYTES:
        raise ValueError(f"its tensors take more than {LARGEST_WEIGHTS_BYTES >> 20} MiB")
    return {name: tensor.detach().numpy() for name, tensor in state.items()}, data


def _member(archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    """A member's content, read up to the limit whatever its header says."""
    with archive.open(name) as member:
        content = member.read(limit + 1)
    if len(content) > limit:
        raise ValueError(f"{name} is larger than {limit >> 20} MiB")
    return content


def _kwargs(data: Mapping[str, Any]) -> Mapping[str, Any]:
    found = data.get("policy_kwargs")
    return found if isinstance(found, dict) else {}


def _activation(data: Mapping[str, Any]) -> str | None:
    """The activation function's class name, from the readable side of the saved settings; None: the default."""
    text = str(_kwargs(data).get("activation_fn", ""))
    found = re.search(r"(\w+)'?>?$", text)
    return found.group(1) if text and found else None
