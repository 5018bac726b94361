"""Observations of models that number them."""

from __future__ import annotations

from typing import Any

import numpy as np


def observation_number(observation: Any) -> int:
    """The observation handed to a filter of a model whose observations are numbered.

    Raises TypeError where it is not a whole number by type, as the compiled search does of a model's step: a reading cut to a
    number would be another observation.
    """
    if isinstance(observation, int | np.integer | np.bool_):
        return int(observation)
    raise TypeError(
        f"observation is {observation!r}, must be a whole number, the one that the model's step gives for what was seen: write "
        "int(...) if it is whole; for observations that are measured, see ContinuousModel"
    )
