"""What a trained policy computes, in numpy alone: a multilayer perceptron, or an LSTM before one.

The six algorithms that the zoo knows (PPO, A2C, RecurrentPPO, SAC, TD3, TQC) differ in how they find the weights, not in
what is done with them: features are the observation itself, the actor's last layer is clipped or squashed into [-1, 1].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from tab_marl.envs.actions import TABLE

ACTIONS = 2
LARGEST_WIDTH = 4096
MOST_LAYERS = 16
Array = NDArray[np.float32]
Width = Annotated[int, Field(ge=1, le=LARGEST_WIDTH)]


class ActorError(ValueError):
    """Tensors that are not the ones a network says it has."""


class Network(BaseModel):
    """The shape of an actor."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["mlp", "lstm"] = "mlp"
    activation: Literal["tanh", "relu"] = "tanh"
    """Between the layers."""
    squashed: bool = False
    """Whether tanh (True) or clipping (False) keeps actions within [-1, 1]."""
    layers: tuple[Width, ...] = Field(min_length=2, max_length=MOST_LAYERS)
    """Widths: the observation's first, the action's last (2, or 15 logits of the discrete actions)."""
    lstm_units: int = Field(default=0, ge=0, le=LARGEST_WIDTH)
    """Of the LSTM between the observation and the first layer; 0: there is none."""
    observation_clip: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    """Observations are centred, scaled and clipped here first, as SB3's VecNormalize does; None: they are not."""

    @property
    def tensors(self) -> dict[str, tuple[int, ...]]:
        """Name -> shape of every tensor that the network needs."""
        shapes: dict[str, tuple[int, ...]] = {}
        inputs, units = self.layers[0], self.lstm_units
        if self.observation_clip is not None:
            shapes |= {"observation.mean": (inputs,), "observation.deviation": (inputs,)}
        if self.kind == "lstm":
            shapes |= {
                "lstm.input": (inputs, 4 * units),
                "lstm.recurrent": (units, 4 * units),
                "lstm.bias": (4 * units,),
            }
            inputs = units
        for i, outputs in enumerate(self.layers[1:]):
            shapes |= {f"layers.{i}.weight": (inputs, outputs), f"layers.{i}.bias": (outputs,)}
            inputs = outputs
        return shapes


class Memory:
    """What a recurrent actor remembers, one row per episode; nothing before the first observation."""

    def __init__(self) -> None:
        self.hidden: Array | None = None
        self.cell: Array | None = None

    def clear(self) -> None:
        """Forget everything: the next observations begin episodes, as many as there are rows."""
        self.hidden = self.cell = None

    def begin(self, which: NDArray[np.int64]) -> None:
        """Forget these rows, whose episodes begin anew."""
        if self.hidden is not None and self.cell is not None:
            self.hidden[which] = 0.0
            self.cell[which] = 0.0


@dataclass(frozen=True, eq=False)
class Actor:
    """A network with its tensors. Raises ActorError for tensors that are not those that the network needs."""

    network: Network
    tensors: Mapping[str, Array] = field(repr=False)
    """By the names and in the shapes of `Network.tensors`."""

    def __post_init__(self) -> None:
        network = self.network
        if (network.kind == "lstm") != (network.lstm_units > 0):
            raise ActorError(f"network.lstm_units is {network.lstm_units} in a network of kind {network.kind}")
        if network.layers[-1] not in (ACTIONS, len(TABLE)):
            raise ActorError(f"layers are {network.layers}, must end with {ACTIONS} (or {len(TABLE)} discrete actions)")
        needed = network.tensors
        checked: dict[str, Array] = {}
        for name, shape in needed.items():
            array = self.tensors.get(name)
            if array is None or array.shape != shape or array.dtype != np.float32 or not np.isfinite(array).all():
                found = "missing" if array is None else f"{array.dtype} {array.shape}"
                raise ActorError(f"{name} is {found}, must be finite float32 {shape}")
            checked[name] = np.ascontiguousarray(array)
        if (checked.get("observation.deviation", np.ones(1)) <= 0).any():
            raise ActorError("observation.deviation holds a number that is not > 0")
        object.__setattr__(self, "tensors", checked)
        count = len(network.layers) - 1
        layers = tuple((checked[f"layers.{i}.weight"], checked[f"layers.{i}.bias"]) for i in range(count))
        object.__setattr__(self, "_layers", layers)

    def __call__(self, observation: Array, memory: Memory) -> Array:
        """Action ``[2]`` (or ``[N, 2]``) in [-1, 1] for an observation ``[D]`` (or ``[N, D]``), without noise."""
        return self.bounded(self.raw(observation, memory))

    def bounded(self, out: Array) -> Array:
        """The action that an output of the last layer, with or without noise, stands for."""
        if out.shape[-1] == len(TABLE):
            return np.take(_TABLE, np.argmax(out, axis=-1), axis=0)  # a copy, which the caller may write to
        if self.network.squashed:
            return np.tanh(out)
        return np.minimum(np.maximum(out, np.float32(-1.0)), np.float32(1.0))

    def raw(self, observation: Array, memory: Memory) -> Array:
        """The last layer's output, before it is brought into [-1, 1]."""
        hidden: NDArray[Any] = observation
        network = self.network
        if network.observation_clip is not None:
            hidden = (hidden - self.tensors["observation.mean"]) / self.tensors["observation.deviation"]
            hidden = np.clip(hidden, -network.observation_clip, network.observation_clip)
        if network.lstm_units:
            hidden = self._remember(hidden, memory)
        layers: tuple[tuple[Array, Array], ...] = self._layers  # type: ignore[attr-defined]
        last = len(layers) - 1
        for i, (weight, bias) in enumerate(layers):
            hidden = hidden @ weight
            hidden += bias
            if i < last:
                if network.activation == "tanh":
                    np.tanh(hidden, out=hidden)
                else:
                    np.maximum(hidden, 0.0, out=hidden)
        return hidden

    def _remember(self, features: Array, memory: Memory) -> Array:
        """One step of the LSTM (torch.nn.LSTM's equations: gates in the order input, forget, cell, output)."""
        units = self.network.lstm_units
        shape = (*features.shape[:-1], units)
        if memory.hidden is None or memory.cell is None:
            memory.hidden, memory.cell = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        if memory.hidden.shape != shape:
            raise ValueError(
                f"a recurrent policy remembers episodes {memory.hidden.shape[:-1]} and was given observations of "
                f"{shape[:-1]}: call reset when other episodes begin"
            )
        gates = features @ self.tensors["lstm.input"] + memory.hidden @ self.tensors["lstm.recurrent"]
        gates += self.tensors["lstm.bias"]
        entry, keep, output = (_sigmoid(gates[..., i * units : (i + 1) * units]) for i in (0, 1, 3))
        memory.cell = keep * memory.cell + entry * np.tanh(gates[..., 2 * units : 3 * units])
        memory.hidden = output * np.tanh(memory.cell)
        return memory.hidden


_TABLE = np.array([(2.0 * speed - 1.0, turn) for speed, turn in TABLE], dtype=np.float32)


def _sigmoid(x: Array) -> Array:
    # By tanh: never overflows.
    return np.float32(0.5) * (np.tanh(np.float32(0.5) * x) + np.float32(1.0))
