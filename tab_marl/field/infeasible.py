"""Fields that do not exist."""

from __future__ import annotations


class InfeasibleField(ValueError):
    """No trajectory of the reference process completes the mission from any start."""
