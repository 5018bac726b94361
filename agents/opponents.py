"""Opponents by name: policies of the zoo, planners, and models that stable-baselines3 saved.

The environments' `opponent` argument asks here (`envs.registration.register_all`) for every name that is no scripted
player's. A model file is read as plain weights: nothing in it is executed, unlike with stable-baselines3's own `load`.
"""

from __future__ import annotations

import io
import json
import pickle
import re
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tab_marl.agents.planners import PLANNERS, make_planner
from tab_marl.agents.zoo import CARD_FILE, SHIPPED, PolicyError, find_policy, load_zoo
from tab_marl.envs.actions import TABLE
from tab_marl.envs.opponents import OPPONENTS, Player
from tab_marl.world.scenario import UnknownName

WEIGHTS_IN_ZIP, DATA_IN_ZIP = "policy.pth", "data"
# (first layers, last layer, activation by default, whether the output is squashed) of SB3's on-policy and SAC actors.
_ON_POLICY = ("mlp_extractor.policy_net.", "action_net.", "Tanh", False)
_SAC = ("actor.latent_pi.", "actor.mu.", "ReLU", True)
_ACTIVATIONS: dict[str, Any] = {"Tanh": np.tanh, "ReLU": lambda x: np.maximum(x, 0.0)}


def load_opponent(name: str, side: str) -> Player:
    """The player of this name for a side, "ego" or "adversary".

    A zoo policy's name or folder (adversary), a planner's name (ego), or a ``.zip`` that stable-baselines3 saved (PPO, A2C or
    SAC with its MlpPolicy and no normalisation; either side). Raises UnknownName, PolicyError.
    """
    if name.endswith(".zip"):
        return load_model(name)
    if side == "ego":
        if name in PLANNERS:
            return make_planner(name)
        raise UnknownName(f"scripted {side}", name, [*OPPONENTS[side], *PLANNERS])
    if (SHIPPED / name / CARD_FILE).exists() or Path(name).exists():
        return find_policy(name)
    raise UnknownName(f"scripted {side}", name, [*OPPONENTS[side], *(policy.name for policy in load_zoo())])


@dataclass(frozen=True, eq=False)
class SavedModel:
    """The actor of a saved model: the mean action of a continuous one, the likeliest of a discrete one."""

    name: str
    weights: tuple[NDArray[np.float32], ...] = field(repr=False)
    """Per layer ``[out, in]``."""
    biases: tuple[NDArray[np.float32], ...] = field(repr=False)
    activation: str
    squashed: bool

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Action ``[2]`` in [-1, 1] for an observation ``[D]``. Raises ValueError if the model is for another one."""
        hidden = np.asarray(observation, dtype=np.float32).ravel()
        if hidden.shape[0] != self.weights[0].shape[1]:
            raise ValueError(
                f"{self.name} was trained on {self.weights[0].shape[1]} observed numbers, this side observes "
                f"{hidden.shape[0]}: it is for the other side, or for an environment with another layout"
            )
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = _ACTIVATIONS[self.activation](weight @ hidden + bias)
        out = self.weights[-1] @ hidden + self.biases[-1]
        if len(out) == len(TABLE):
            speed, turn = TABLE[int(np.argmax(out))]
            return np.array([2.0 * speed - 1.0, turn], dtype=np.float32)
        return np.asarray(np.tanh(out) if self.squashed else np.clip(out, -1.0, 1.0), dtype=np.float32)


def load_model(path: Path | str) -> SavedModel:
    """The actor in a zip that stable-baselines3 saved. Raises PolicyError: no such file, or no actor that is known here."""
    file = Path(path)
    try:
        with zipfile.ZipFile(file) as archive:
            weights = archive.read(WEIGHTS_IN_ZIP)
            data = json.loads(archive.read(DATA_IN_ZIP))
        # Tensors alone: torch refuses to unpickle anything else.
        tensors = torch.load(io.BytesIO(weights), map_location="cpu", weights_only=True)
    except (OSError, KeyError, ValueError, RuntimeError, zipfile.BadZipFile, pickle.UnpicklingError) as error:
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise PolicyError(f"{file} is not a model that stable-baselines3 saved ({said})") from None
    for first, last, activation, squashed in (_ON_POLICY, _SAC):
        if f"{last}weight" in tensors:
            names = sorted((n for n in tensors if n.startswith(first) and n.endswith(".weight")), key=_layer)
            layers = [*(n.removesuffix("weight") for n in names), last]
            return SavedModel(
                file.name,
                tuple(tensors[f"{layer}weight"].numpy() for layer in layers),
                tuple(tensors[f"{layer}bias"].numpy() for layer in layers),
                _activation(data, activation, file),
                squashed,
            )
    raise PolicyError(f"{file} holds no actor of PPO, A2C or SAC with an MlpPolicy")


def _layer(name: str) -> int:
    return int(re.findall(r"\d+", name)[-1])


def _activation(data: dict[str, Any], default: str, file: Path) -> str:
    """The activation function's name, from the readable side of the saved settings."""
    kwargs = data.get("policy_kwargs") or {}
    text = str(kwargs.get("activation_fn", "")) if isinstance(kwargs, dict) else ""
    found = re.search(r"(\w+)'?>?$", text)
    name = found.group(1) if text and found else default
    if name not in _ACTIVATIONS:
        raise PolicyError(f"{file}: activation function {name} is not known here, must be one of {list(_ACTIVATIONS)}")
    return name
