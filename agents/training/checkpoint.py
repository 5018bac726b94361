"""Checkpoints: everything that the rest of a run depends on, as tensors and one JSON text. Read back without unpickling.

What an off-policy algorithm remembers is too large to be written anew every few seconds: the transitions that came since
the last checkpoint are appended as one more file of ``replay/``.
"""

from __future__ import annotations

import json
import os
import shutil
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.save_util import recursive_getattr

from tab_marl.agents.training.settings import TrainingError

CHECKPOINT_FILE = "checkpoint.pt"
REPLAY_FOLDER = "replay"
CHECKPOINT_VERSION = 2
_REPLAYED = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class Exploration(VectorizedActionNoise):
    """Normal action noise of all robots, whose standard deviation can change and whose generator can be saved."""

    def __init__(self, robots: int, std: float, seed: int) -> None:
        self.std = std
        self.rng = np.random.default_rng((seed, 11))
        self._shape = (robots, 2)

    def __call__(self) -> NDArray[np.float32]:
        return (self.std * self.rng.standard_normal(self._shape)).astype(np.float32)

    def reset(self, indices: Any = None) -> None:
        """It remembers nothing."""


class Checkpoint:
    """The checkpoint of the run in a folder."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / CHECKPOINT_FILE
        self._replay = folder / REPLAY_FOLDER
        self._kept = 0
        """Transitions (of all robots at once) that the replay files hold."""

    def exists(self) -> bool:
        return self.path.exists()

    def save(self, model: Any, env: Any, log: dict[str, Any], finished: bool = False) -> None:
        """Replace the checkpoint atomically; a finished run needs no replay files any more. Raises OSError."""
        arrays, text = env.snapshot()
        buffer = getattr(model, "replay_buffer", None)
        if buffer is not None and not finished:
            self._append(buffer, model.num_timesteps // model.n_envs)
        elif self._replay.exists():
            shutil.rmtree(self._replay)
        noise = model.action_noise if buffer is not None else None
        _, plain = model._get_torch_save_params()
        record = {
            "version": CHECKPOINT_VERSION,
            "steps": model.num_timesteps,
            "updates": model._n_updates,
            "parameters": model.get_parameters(),
            "tensors": {name: recursive_getattr(model, name).detach() for name in plain},
            "torch_random": torch.get_rng_state(),
            "arrays": {name: torch.from_numpy(array) for name, array in arrays.items()},
            "learner": {
                "observation": torch.from_numpy(np.array(model._last_obs)),
                "episode_starts": torch.from_numpy(np.array(model._last_episode_starts)),
                "lstm": _lstm(model),
            },
            "text": json.dumps(
                {
                    "environment": text,
                    "numpy_random": _global_random(),
                    "actions_random": model.action_space.np_random.bit_generator.state,
                    "noise_random": noise.rng.bit_generator.state if noise is not None else None,
                    "episodes": model._episode_num,
                    "recent_episodes": list(model.ep_info_buffer or ()),
                    "replayed": self._kept,
                    "log": log,
                    "finished": finished,
                }
            ),
        }
        temporary = self.path.with_suffix(".tmp")
        with temporary.open("wb") as file:
            torch.save(record, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, self.path)

    def restore(self, model: Any, env: Any) -> dict[str, Any]:
        """Put model and environment where the checkpoint left them; returns what was given as `log`.

        Raises TrainingError if it cannot be read.
        """
        try:
            record = torch.load(self.path, weights_only=True)
            text = json.loads(record["text"])
            version = record["version"]
        except Exception as error:  # noqa: BLE001, a damaged file makes torch raise almost anything
            raise self._unreadable(error) from None
        if version != CHECKPOINT_VERSION:
            raise TrainingError(
                f"{self.path} is a version {version} checkpoint, this program reads {CHECKPOINT_VERSION}: delete it to "
                "begin the run anew"
            )
        model.set_parameters(record["parameters"], device="cpu")
        for name, tensor in record["tensors"].items():
            recursive_getattr(model, name).data.copy_(tensor)
        model.num_timesteps, model._n_updates = record["steps"], record["updates"]
        model._episode_num = text["episodes"]
        learner = record["learner"]
        model._last_obs = learner["observation"].numpy().copy()
        model._last_episode_starts = learner["episode_starts"].numpy().copy()
        if learner["lstm"]:
            from sb3_contrib.common.recurrent.type_aliases import RNNStates

            hidden, cell, value_hidden, value_cell = (tensor.clone() for tensor in learner["lstm"])
            model._last_lstm_states = RNNStates((hidden, cell), (value_hidden, value_cell))
        env.restore({name: tensor.numpy() for name, tensor in record["arrays"].items()}, text["environment"])
        if getattr(model, "replay_buffer", None) is not None and not text["finished"]:
            self._refill(model.replay_buffer, text["replayed"])
            if model.action_noise is not None:
                model.action_noise.rng.bit_generator.state = text["noise_random"]
        model.action_space.np_random.bit_generator.state = text["actions_random"]
        model.ep_info_buffer = deque(text["recent_episodes"], maxlen=model._stats_window_size)
        model.ep_success_buffer = deque(maxlen=model._stats_window_size)
        torch.set_rng_state(record["torch_random"])
        name, keys, position, has_gauss, cached = text["numpy_random"]
        np.random.set_state((name, np.array(keys, dtype=np.uint32), position, has_gauss, cached))  # noqa: NPY002
        found: dict[str, Any] = text["log"]
        return found

    def steps(self) -> int:
        """The control steps of the checkpoint, 0 if there is none. Raises TrainingError if it cannot be read."""
        if not self.exists():
            return 0
        try:
            return int(torch.load(self.path, weights_only=True)["steps"])
        except Exception as error:  # noqa: BLE001, a damaged file makes torch raise almost anything
            raise self._unreadable(error) from None

    def _unreadable(self, error: Exception) -> TrainingError:
        return TrainingError(
            f"cannot read the checkpoint {self.path} ({type(error).__name__}): delete it to begin the run anew"
        )

    def _append(self, buffer: Any, added: int) -> None:
        """One more file with the transitions since the last one, of the `added` so far; files that the ring has
        overwritten go."""
        self._replay.mkdir(exist_ok=True)
        first = max(self._kept, added - buffer.buffer_size)
        if added > first:
            rows = np.arange(first, added) % buffer.buffer_size
            part = {name: torch.from_numpy(getattr(buffer, name)[rows]) for name in _REPLAYED}
            temporary = self._replay / "part.tmp"
            torch.save(part, temporary)
            os.replace(temporary, self._replay / f"{first}-{added}.pt")
        for _, end, path in self._parts():
            if end <= added - buffer.buffer_size:
                path.unlink()
        self._kept = added

    def _refill(self, buffer: Any, count: int) -> None:
        """The ring as it was when `count` transitions had been added."""
        oldest = max(0, count - buffer.buffer_size)
        for start, end, path in self._parts():
            if end > count:
                path.unlink()  # written by a run that was killed before its checkpoint
                continue
            if start > max(self._kept, oldest):
                break  # a file is missing
            try:
                part = torch.load(path, weights_only=True)
                for name in _REPLAYED:
                    getattr(buffer, name)[np.arange(start, end) % buffer.buffer_size] = part[name].numpy()
            except Exception as error:  # noqa: BLE001
                raise self._unreadable(error) from None
            self._kept = end
        if self._kept != count:
            raise TrainingError(
                f"{self._replay} holds {self._kept} transitions, the checkpoint {count}: delete {self.path} to begin anew"
            )
        buffer.pos, buffer.full = count % buffer.buffer_size, count >= buffer.buffer_size

    def _parts(self) -> Iterator[tuple[int, int, Path]]:
        """First and last transition of each replay file, in order."""
        found = []
        for path in self._replay.glob("*-*.pt"):
            start, _, end = path.stem.partition("-")
            found.append((int(start), int(end), path))
        yield from sorted(found)


def _lstm(model: Any) -> list[torch.Tensor]:
    """What a recurrent policy remembers of the episodes under way: hidden and cell state, of policy and value."""
    states = getattr(model, "_last_lstm_states", None)
    return [] if states is None else [*states.pi, *states.vf]


def _global_random() -> tuple[Any, ...]:
    # stable-baselines3 shuffles its minibatches with numpy's global generator, which it seeds itself.
    name, keys, position, has_gauss, cached = np.random.get_state()  # noqa: NPY002
    return name, [int(key) for key in keys], int(position), int(has_gauss), float(cached)
