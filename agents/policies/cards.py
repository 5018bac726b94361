"""The card of a policy: what it is, what it was trained on, and what it was measured to do. Checked JSON, nothing else."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue, StringConstraints

from tab_marl.agents.policies.actor import Network
from tab_marl.envs.styles import Style
from tab_marl.mission.tasks import MISSION_IDS

Split = Literal["development", "final"]
"""What a policy may be used for: training data and tuning, or the final table alone."""
SPLITS: tuple[Split, ...] = ("development", "final")
World = Literal["batched", "physics"]
"""Kinematic, or pymunk."""
CLAIM = 0.9
"""A mission type is claimed if at least this share of held-out tasks is completed when nobody hunts."""

# Cards are printed on terminals and pages: no control characters, which could do more than be read.
_PRINTABLE = r"^[^\x00-\x08\x0b-\x1f\x7f-\x9f]*$"
Line = Annotated[str, StringConstraints(max_length=300, pattern=r"^[^\x00-\x1f\x7f-\x9f]*$")]
Prose = Annotated[str, StringConstraints(max_length=4000, pattern=_PRINTABLE)]
NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
"""Of a policy, which is also its folder's name."""
Name = Annotated[str, StringConstraints(pattern=NAME)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


def is_name(text: str) -> bool:
    """Whether this can be a policy's name: letters, digits, dots, dashes and underscores, no dot first."""
    return re.fullmatch(NAME.strip("^$"), text) is not None


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class MissionRecord(_Part):
    """Unopposed success on held-out tasks of one mission type."""

    mission: Name
    """ "M1" to "M5", or "sampled": compositions that no training draws."""
    world: World
    completed: int = Field(ge=0)
    episodes: int = Field(ge=1)
    low: Share
    """95 % Wilson interval of the share completed."""
    high: Share

    @property
    def share(self) -> float:
        return self.completed / self.episodes

    @property
    def claimable(self) -> bool:
        return self.share >= CLAIM


class StyleTest(_Part):
    """Whether a style's own figure moved against two direct policies trained with other seeds, on the same tasks."""

    figure: Line
    value: Finite
    """Of the policy, mean over tasks."""
    controls: tuple[Finite, ...]
    """Of the re-seeded direct policies."""
    moved: Finite
    """The smaller of the differences to the controls, in the style's own direction."""
    low: Finite
    """95 % bootstrap interval of `moved`, paired over tasks."""
    high: Finite
    needed: Finite
    """By how much it must move to count: the distance between the controls."""
    success: Share
    """Over all tasks of the claimed mission types, in the same episodes."""

    @property
    def counts(self) -> bool:
        """The interval lies beyond what is needed, at a success of `CLAIM` or more."""
        return self.low > self.needed and self.success >= CLAIM


class PolicyCard(_Part):
    """What a policy is and what it was measured to do."""

    name: Name
    description: Prose = ""
    author: Line = ""
    algorithm: Line
    layout_version: int
    """Of the adversary's observation."""
    network: Network
    split: Split = "development"
    style: Style = Field(default_factory=Style)
    """How its route field is bent."""
    missions: tuple[Name, ...] = Field(default=MISSION_IDS, max_length=32)
    """Mission types that the policy claims."""
    settings: dict[str, JsonValue] = Field(default_factory=dict)
    """Of its training, as its settings file had them; empty for a model that was trained elsewhere."""
    steps: int = Field(ge=0)
    command: Prose = ""
    """What trains this policy again."""
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    """Of the weights file."""
    success: tuple[MissionRecord, ...] = Field(default=(), max_length=64)
    style_test: StyleTest | None = None
    """None: its style claims nothing, or nothing was measured."""
    statistics: dict[Line, Finite] = Field(default_factory=dict, max_length=256)
    """Figures of what it does on held-out tasks."""
    exceptions: tuple[Prose, ...] = Field(default=(), max_length=32)
    """What it was let into the zoo in spite of."""

    def record(self, mission: str, world: str = "physics") -> MissionRecord | None:
        """The measured success of a mission type in a world."""
        return next((r for r in self.success if r.mission == mission and r.world == world), None)
