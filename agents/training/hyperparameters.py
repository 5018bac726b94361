"""Hyperparameters in files keyed by environment id, in the format of rl-baselines3-zoo (``hyperparams/ppo.yml``).

Nothing in a file is executed: YAML is read with the safe loader, and ``policy_kwargs: "dict(net_arch=[64, 64])"``, which
rl-baselines3-zoo hands to ``eval``, is read as literals and the few names that may stand in it.
"""

from __future__ import annotations

import ast
import difflib
import inspect
import math
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from tab_marl.agents.training.algorithms import ALGORITHMS

FILES = Path(__file__).parent.parent / "hyperparameters"
BATCHED_MISSIONS = "tab_marl/BatchedMissions-v0"
"""Key of the batched world of unopposed adversaries, in which policies are trained."""
HUNTED_MISSIONS = "tab_marl/HuntedMissions-v0"
"""Key of the same with an opponent; where a file lacks it, that of the batched world is taken."""
ACTIVATIONS = {"tanh": "Tanh", "relu": "ReLU"}
"""Activation functions that a policy of the zoo may have -> their names in torch.nn."""
_CALLS = ("dict",)
_NAMES = tuple(f"nn.{name}" for name in ACTIVATIONS.values())
NOT_HERE = {
    "normalize": "observations and rewards of the batched world are scaled already",
    "env_wrapper": "the batched world has no wrappers",
    "vec_env_wrapper": "the batched world has no wrappers",
    "frame_stack": "the batched world has no wrappers",
    "callback": "callbacks are the program's own",
    "env_kwargs": "what is trained on is said by the training settings",
    "monitor_kwargs": "what is logged is the program's own",
    "replay_buffer_class": "a run could not be continued after a kill",
    "replay_buffer_kwargs": "a run could not be continued after a kill",
    "optimize_memory_usage": "a run could not be continued after a kill",
    "use_sde": "a run could not be continued after a kill",
    "env": "it is said by the training settings",
    "seed": "it is said by the training settings",
    "device": "training runs on the CPU",
    "tensorboard_log": "it is the program's own",
    "verbose": "it is the program's own",
}
"""Keys that rl-baselines3-zoo or the algorithms know and that mean nothing here, with the reason."""

_BOUNDS = {
    **dict.fromkeys(("gamma", "gae_lambda", "tau"), (0.0, 1.0)),
    **dict.fromkeys(("n_steps", "n_epochs", "batch_size", "buffer_size"), (1.0, math.inf)),
    **dict.fromkeys(("learning_starts", "noise_std"), (0.0, math.inf)),
}


class HyperparameterError(ValueError):
    """A hyperparameter that is not known or cannot be used; one line."""


@cache
def _file(algorithm: str) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = yaml.safe_load((FILES / f"{algorithm}.yml").read_text(encoding="utf-8"))
    return found


def packaged(algorithm: str, environment: str = BATCHED_MISSIONS) -> dict[str, Any]:
    """A copy of the packaged hyperparameters of an algorithm on an environment.

    Raises KeyError for an environment without any (the hunted one falls back to the batched world's).
    """
    found = _file(algorithm)
    if environment == HUNTED_MISSIONS and environment not in found:
        environment = BATCHED_MISSIONS
    return dict(found[environment])


def read_policy_kwargs(text: str | Mapping[str, Any]) -> dict[str, Any]:
    """``"dict(net_arch=[64, 64], activation_fn=nn.Tanh)"`` as a dictionary; class names stay text ("nn.Tanh").

    Raises HyperparameterError for anything but ``dict(...)``, literals and nn.Tanh or nn.ReLU.
    """
    if isinstance(text, Mapping):
        return dict(text)
    try:
        found = _value(ast.parse(text.strip(), mode="eval").body)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        said = str(error) if type(error) is ValueError else "cannot be read"
        raise HyperparameterError(
            f"policy_kwargs {text[:80]!r} {said}: give dict(net_arch=[64, 64], activation_fn=nn.Tanh) or the like"
        ) from None
    if not isinstance(found, dict):
        raise HyperparameterError(f"policy_kwargs {text[:80]!r} is no dict(...)")
    return found


def _value(node: ast.expr) -> Any:
    if isinstance(node, ast.Call):
        if not (isinstance(node.func, ast.Name) and node.func.id in _CALLS) or node.args:
            raise ValueError("calls something other than dict(name=value, ...)")
        if any(keyword.arg is None for keyword in node.keywords):
            raise ValueError("holds **")
        return {str(keyword.arg): _value(keyword.value) for keyword in node.keywords}
    if isinstance(node, ast.Attribute):
        name = ast.unparse(node)
        if name not in _NAMES:
            raise ValueError(f"names {name[:40]}, must be one of {list(_NAMES)}")
        return name
    if isinstance(node, ast.List | ast.Tuple):
        return [_value(item) for item in node.elts]
    if isinstance(node, ast.Dict):
        return {ast.literal_eval(k): _value(v) for k, v in zip(node.keys, node.values, strict=True) if k is not None}
    return ast.literal_eval(node)


def write_policy_kwargs(values: Mapping[str, Any]) -> str:
    """The text that `read_policy_kwargs` reads, in rl-baselines3-zoo's manner."""

    def text(value: Any) -> str:
        if isinstance(value, Mapping):
            return write_policy_kwargs(value)
        if isinstance(value, list | tuple):
            return f"[{', '.join(text(item) for item in value)}]"
        return value if value in _NAMES else repr(value)

    return f"dict({', '.join(f'{name}={text(value)}' for name, value in values.items())})"


def schedule(value: float | str, name: str) -> Any:
    """A number as it is, "lin_5e-4" as the function that falls linearly to 0 (rl-baselines3-zoo's meaning).

    Raises HyperparameterError.
    """
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    kind, _, first = str(value).partition("_")
    try:
        if kind != "lin":
            raise ValueError
        start = float(first)
    except ValueError:
        raise HyperparameterError(f"{name} is {value!r}, must be a number or lin_NUMBER such as lin_5e-4") from None
    return lambda remaining: start * max(remaining, 0.0)


def check(algorithm: str, hyperparameters: Mapping[str, Any]) -> None:
    """Whether the algorithm's class takes all of these. Raises HyperparameterError; imports torch."""
    known = set(inspect.signature(ALGORITHMS[algorithm].load().__init__).parameters) - {"self", "_init_setup_model"}
    known |= {"noise_type", "noise_std"} if "action_noise" in known else set()
    known -= {"action_noise"}
    for name, value in hyperparameters.items():
        if name in NOT_HERE:
            raise HyperparameterError(f"hyperparameters.{name} cannot be set: {NOT_HERE[name]}")
        if name not in known:
            close = difflib.get_close_matches(name, sorted(known - set(NOT_HERE)), n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(sorted(known - set(NOT_HERE)))}"
            raise HyperparameterError(f"{ALGORITHMS[algorithm].title} has no hyperparameter {name!r}: {hint}")
        if name in ("learning_rate", "clip_range", "clip_range_vf"):
            schedule(value, f"hyperparameters.{name}")
        low, high = _BOUNDS.get(name, (-math.inf, math.inf))
        if math.isfinite(low) and not (isinstance(value, int | float) and low <= value <= high):
            within = f"be >= {low:g}" if math.isinf(high) else f"lie in {low:g}..{high:g}"
            raise HyperparameterError(f"hyperparameters.{name} is {value!r}, must {within}")
    if hyperparameters.get("noise_type", "normal") != "normal":
        raise HyperparameterError(
            f"hyperparameters.noise_type is {hyperparameters['noise_type']!r}, must be 'normal': a run with another could "
            "not be continued after a kill"
        )


def arguments(hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """Keyword arguments of the algorithm's class, action noise left out; imports torch."""
    from torch import nn

    given = {name: value for name, value in hyperparameters.items() if name not in ("noise_type", "noise_std")}
    for name in ("learning_rate", "clip_range", "clip_range_vf"):
        if name in given:
            given[name] = schedule(given[name], name)
    if isinstance(given.get("train_freq"), list):
        given["train_freq"] = tuple(given["train_freq"])
    policy = read_policy_kwargs(given.get("policy_kwargs", "dict()"))
    if "activation_fn" in policy:
        policy["activation_fn"] = getattr(nn, str(policy["activation_fn"]).removeprefix("nn."))
    return {**given, "policy_kwargs": policy}
