"""Tiger (Kaelbling, Littman and Cassandra, AIJ 1998): two doors, one tiger."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from tab_marl.planning.model import CompiledModel
from tab_marl.planning.tables import table_model
from tab_marl.planning.textbook import tiger_kernels as kernels
from tab_marl.planning.textbook.choices import chosen

LISTEN, OPEN_LEFT, OPEN_RIGHT = 0, 1, 2
HEAR_LEFT, HEAR_RIGHT = 0, 1


def tiger(accuracy: float = 0.85, rollout: Literal["patient", "engine"] = "patient") -> CompiledModel:
    """Tiger (Kaelbling, Littman and Cassandra, AIJ 1998): listen for -1, a good door is worth 10, the tiger's -100.

    State 0: the tiger is left; opening a door places it anew. With `accuracy` .85 and discount .95 the best value from the
    uniform belief is 19.37: listen until one side was heard twice more often than the other. `rollout` "patient" does just that
    from scratch; "engine" opens doors at random for -30 a step, under which a tree of a million simulations stays buried.
    """
    stay, anew = np.eye(2), np.full((2, 2), 0.5)
    hear = np.array([[accuracy, 1 - accuracy], [1 - accuracy, accuracy]])
    model = table_model(
        transition=[stay, anew, anew],
        observation=[hear, anew, anew],
        reward=[[-1, -1], [-100, 10], [10, -100]],
        action_names=("listen", "open left", "open right"),
    )
    rollouts = {"patient": kernels.patient_rollout, "engine": None}
    return replace(model, rollout=chosen("rollout of Tiger", rollout, rollouts))
