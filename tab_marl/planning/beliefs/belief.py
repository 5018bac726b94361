"""Updating a belief of particles after acting, for models whose exact filter nobody has written.

Where an exact filter exists (Tag's in `tab_marl.planning.textbook`, the adversary's in `tab_marl.field`), use it: a filter by
rejection needs many particles and can run dry.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.model import CompiledModel, belief_states, draw_particles
from tab_marl.planning.search import kernels


class BeliefDepleted(RuntimeError):
    """No particle explains what was observed."""

    def __init__(self, action: int, observation: int, tries: int) -> None:
        super().__init__(
            f"none of {tries} simulated steps of action {action} gave observation {observation}: "
            "give more particles or tries, or start again from a belief in which it is possible"
        )
        self.action, self.observation, self.tries = action, observation, tries


def update_particles(
    model: CompiledModel,
    belief: Any,
    action: int,
    observation: int,
    rng: np.random.Generator,
    count: int = 1000,
    tries: int = 200_000,
) -> NDArray[np.float64]:
    """``[count, D]``: states after `action`, given that `observation` was seen and the process goes on.

    By rejection (Silver and Veness 2010, algorithm 1): states drawn from `belief` (states, `Particles` or a sampler) are
    stepped until `count` gave the observation. If fewer did in `tries` steps, those are repeated; if none did, BeliefDepleted.
    """
    if count < 1 or tries < 1:
        raise ValueError(f"count is {count} and tries is {tries}, both must be >= 1")
    if not 0 <= action < model.actions:
        raise ValueError(f"action is {action}, must be in 0..{model.actions - 1}")
    states, weights = belief_states(model, belief, count, rng)
    step, _, _ = model.functions
    word = rng.integers(2**64, size=1, dtype=np.uint64)
    kept = np.empty((count, model.state_size))
    state = np.empty(model.state_size)
    found = tried = 0
    while found < count and tried < tries:
        particles = draw_particles(min(tries - tried, 4 * count), len(states), weights, rng)
        found = kernels.keep_matching(
            step, model.data, states, particles, action, observation, word, state, kept, found
        )
        tried += len(particles)
    if found == 0:
        raise BeliefDepleted(action, observation, tried)
    if found < count:
        kept[found:] = kept[rng.integers(found, size=count - found)]
    return kept
