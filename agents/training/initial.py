"""A warm start: the weights of another run, or of a policy of the zoo, in a new model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from tab_marl.agents.training.checkpoint import CHECKPOINT_FILE
from tab_marl.agents.training.settings import TrainingError


def begin_with(model: Any, initial: str) -> None:
    """Give the model the policy and value networks of the run in this folder, or the actor of this policy of the zoo.

    Raises TrainingError if the networks do not have the same shape or the file cannot be read, and whatever
    `zoo.find_policy` raises.
    """
    path = Path(initial) / CHECKPOINT_FILE
    if path.exists():
        try:
            state = torch.load(path, weights_only=True)["parameters"]["policy"]
        except Exception as error:  # noqa: BLE001, a damaged file makes torch raise almost anything
            raise TrainingError(f"cannot begin with {path} ({type(error).__name__}): it is damaged") from None
    else:
        state = _state_of_policy(model, initial)
    own = model.policy.state_dict()
    wrong = [name for name in state if name not in own or own[name].shape != state[name].shape]
    if wrong:
        raise TrainingError(
            f"cannot begin with {initial!r}: {wrong[0]} is {_shape(state[wrong[0]])} there and "
            f"{_shape(own.get(wrong[0]))} here: the algorithm's kind, layers and lstm_units must be the same"
        )
    model.policy.load_state_dict({**own, **state})


def _state_of_policy(model: Any, name: str) -> dict[str, torch.Tensor]:
    """The tensors of a zoo policy's actor under the names that they have in this model."""
    from tab_marl.agents.policies.sb3_actors import actor_of_model
    from tab_marl.agents.policies.zoo import find_policy

    policy = find_policy(name)
    theirs, ours = policy.actor.network, actor_of_model(model)[0].network
    if theirs != ours:
        raise TrainingError(
            f"cannot begin with {name!r}: its network is {theirs.kind} {list(theirs.layers)} {theirs.activation}"
            f"{' squashed' if theirs.squashed else ''}, this one {ours.kind} {list(ours.layers)} {ours.activation}"
            f"{' squashed' if ours.squashed else ''}"
        )
    own = model.policy.state_dict()
    if "action_net.weight" in own:
        prefixes = [f"mlp_extractor.policy_net.{2 * i}" for i in range(len(ours.layers) - 2)] + ["action_net"]
    elif "actor.mu.weight" in own:
        prefixes = [f"actor.latent_pi.{2 * i}" for i in range(len(ours.layers) - 2)] + ["actor.mu"]
    else:
        prefixes = [f"actor.mu.{2 * i}" for i in range(len(ours.layers) - 1)]
    state: dict[str, torch.Tensor] = {}
    for i, prefix in enumerate(prefixes):
        state[f"{prefix}.weight"] = _tensor(policy.actor.tensors[f"layers.{i}.weight"].T)
        state[f"{prefix}.bias"] = _tensor(policy.actor.tensors[f"layers.{i}.bias"])
    if ours.lstm_units:
        state["lstm_actor.weight_ih_l0"] = _tensor(policy.actor.tensors["lstm.input"].T)
        state["lstm_actor.weight_hh_l0"] = _tensor(policy.actor.tensors["lstm.recurrent"].T)
        state["lstm_actor.bias_ih_l0"] = _tensor(policy.actor.tensors["lstm.bias"])
        state["lstm_actor.bias_hh_l0"] = torch.zeros_like(state["lstm_actor.bias_ih_l0"])
    if any(name.startswith("actor_target.") for name in own):
        state |= {f"actor_target.{key.removeprefix('actor.')}": value.clone() for key, value in state.items()}
    if policy.log_std is not None and "log_std" in own:
        state["log_std"] = _tensor(policy.log_std)
    return state


def _tensor(array: Any) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array))


def _shape(tensor: torch.Tensor | None) -> str:
    return "missing" if tensor is None else str(list(tensor.shape))
