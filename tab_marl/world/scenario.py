"""A scenario: the map, the two robots, the sensors, the clocks and the rewards. Every number of the world is a field here."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Literal, get_args

import numpy as np

from tab_marl.world.regions import Box, Disc, Region

STRICT: dict[str, str] = {"extra": "forbid"}

EgoTask = Literal["interception", "avoidance", "surveillance"]
"""What the ego is paid for (paper, section 2): to meet the adversary; to get to a goal without meeting it; to watch it."""
EGO_TASKS: tuple[EgoTask, ...] = get_args(EgoTask)


class UnknownName(KeyError):
    """A region or preset name that does not exist; says which one was probably meant."""

    def __init__(self, kind: str, name: str, known: Iterable[str]) -> None:
        self.kind, self.name, self.known = kind, name, tuple(known)
        close = difflib.get_close_matches(name.casefold(), [k.casefold() for k in self.known], n=1, cutoff=0.5)
        self.suggestion = next((k for k in self.known if close and k.casefold() == close[0]), None)
        hint = f"did you mean {self.suggestion!r}?" if self.suggestion else f"known: {', '.join(self.known)}"
        super().__init__(f"no {kind} named {name!r}: {hint}")

    def __str__(self) -> str:
        return str(self.args[0])


@dataclass(frozen=True)
class Robot:
    """A differential-drive robot. Defaults: TurtleBot3 Burger."""

    radius_metres: float = 0.105
    max_speed: float = 0.22
    """m/s; speed lies in [0, max_speed]."""
    max_turn_rate: float = 1.82
    """rad/s; turn rate lies in [-max_turn_rate, max_turn_rate]."""
    mass_kilograms: float = 1.0

    __pydantic_config__: ClassVar = STRICT

    def __post_init__(self) -> None:
        for name in ("radius_metres", "max_speed", "max_turn_rate", "mass_kilograms"):
            require_positive(self, name)


@dataclass(frozen=True)
class Checkpoint:
    """A named place of interest with a camera above it."""

    name: str
    x: float
    y: float
    radius_metres: float = 0.18
    """A robot whose centre is within this radius is at the checkpoint."""
    camera_metres: float = 0.45
    """The camera sees the adversary while its centre is within this radius."""

    __pydantic_config__: ClassVar = STRICT

    def __post_init__(self) -> None:
        require_positive(self, "radius_metres")
        require_positive(self, "camera_metres")

    @property
    def region(self) -> Disc:
        return Disc(self.x, self.y, self.radius_metres)

    @property
    def camera(self) -> Disc:
        return Disc(self.x, self.y, self.camera_metres)


@dataclass(frozen=True)
class Rewards:
    """The ego's reward (paper, section 5), plus the price of a completed mission and those of the other ego tasks.

    `collision`, `per_step` and `control` count in every ego task, the others in the one they name.
    """

    interception: float = 50.0
    """Interception: once, when the centres are within `Scenario.interception_metres`."""
    collision: float = -30.0
    per_step: float = -1.0
    """Per time step of `Scenario.step_seconds`."""
    control: float = -0.1
    """Times v^2 + w^2, per time step."""
    mission_completed: float = -50.0
    """Interception: paid once when the adversary completes its mission first; 0 in the paper."""
    encounter: float = -50.0
    """Avoidance: once, when the centres are within `Scenario.interception_metres`; ends the episode."""
    arrival: float = 50.0
    """Avoidance: once, when the ego's centre is inside `Scenario.ego_goal`; ends the episode."""
    watched: float = 1.0
    """Surveillance: per second during which the ego watches the adversary (`Scenario.watch_metres`)."""

    __pydantic_config__: ClassVar = STRICT


@dataclass(frozen=True)
class Sensors:
    """What the robots sense beside the checkpoint cameras."""

    lidar_rays: int = 12
    lidar_metres: float = 1.5
    """Range; a ray that meets nothing reads this."""
    adversary_sees_ego_metres: float = 0.0
    """The adversary notices the ego within this range and with a free line of sight; 0 means blind."""

    __pydantic_config__: ClassVar = STRICT

    def __post_init__(self) -> None:
        if self.lidar_rays < 0:
            raise ValueError(f"Sensors.lidar_rays is {self.lidar_rays}, must be >= 0")
        require_positive(self, "lidar_metres")
        if self.adversary_sees_ego_metres < 0:
            raise ValueError(
                f"Sensors.adversary_sees_ego_metres is {self.adversary_sees_ego_metres}, must be >= 0 (0 means blind)"
            )


@dataclass(frozen=True)
class Scenario:
    """The world in which a mission is attempted. Lengths in metres, times in seconds, origin at the lower left corner."""

    name: str
    checkpoints: tuple[Checkpoint, ...]
    """In order: the first is "Checkpoint A", also "Checkpoint 1" (aliases are added for both spellings)."""
    ego_start: Region
    """The ego starts uniformly in the free part of this region."""
    adversary_start: Region
    """The adversary starts uniformly in the free part of this region; planners know the region only."""
    width_metres: float = 3.0
    height_metres: float = 3.0
    obstacles: tuple[Region, ...] = ()
    regions: tuple[tuple[str, Region], ...] = ()
    """Named places beyond checkpoints. "central zone", the four corners and the four halves are always there."""
    aliases: tuple[tuple[str, str], ...] = ()
    """(other spelling, region name)."""
    ego: Robot = field(default_factory=Robot)
    adversary: Robot = field(default_factory=Robot)
    sensors: Sensors = field(default_factory=Sensors)
    rewards: Rewards = field(default_factory=Rewards)
    interception_metres: float = 0.3
    """Between the robots' centres."""
    physics_hertz: int = 100
    control_hertz: int = 10
    decision_hertz: int = 2
    step_seconds: float = 0.5
    """One tick: the time step of the field, of missions on the grid and of the per-step reward."""
    horizon_seconds: float = 60.0
    """An episode ends here if nothing ended it before."""
    target_radius_metres: float = 0.18
    """Radius of the goal disc around a bare target point [x, y]."""
    leave_metres: float = 0.15
    """A recurring visit counts again only after the robot was this far outside the region."""
    exact_seconds: float = 0.5
    """`exact` means first entry within +- max(exact_seconds, exact_fraction * time)."""
    exact_fraction: float = 0.1
    central_zone_metres: float = 0.4
    """Radius of the central zone."""
    ego_task: EgoTask = "interception"
    """What the ego is paid for, through the reward alone (`Rewards`). An encounter ends interception and avoidance; arrival
    ends avoidance; surveillance runs to the horizon."""
    ego_goal: Region | None = None
    """Avoidance: where the ego must get; None in the other tasks."""
    watch_metres: float = 0.8
    """Surveillance: the ego watches the adversary, and therefore sees it, while their centres are within this distance
    with a free line of sight."""

    __pydantic_config__: ClassVar = STRICT

    def __post_init__(self) -> None:
        for name in (
            "width_metres", "height_metres", "interception_metres", "physics_hertz", "control_hertz", "decision_hertz",
            "step_seconds", "horizon_seconds", "target_radius_metres", "leave_metres", "central_zone_metres", "watch_metres",
        ):  # fmt: skip
            require_positive(self, name)
        if self.physics_hertz % self.control_hertz or self.control_hertz % self.decision_hertz:
            raise ValueError(
                f"Scenario {self.name!r}: physics_hertz ({self.physics_hertz}) must be a multiple of control_hertz "
                f"({self.control_hertz}), and that a multiple of decision_hertz ({self.decision_hertz})"
            )
        if abs(self.step_seconds * self.control_hertz - round(self.step_seconds * self.control_hertz)) > 1e-9:
            raise ValueError(
                f"Scenario {self.name!r}: step_seconds ({self.step_seconds}) must be a whole number of control steps "
                f"of 1/{self.control_hertz} s"
            )
        names = [name.casefold() for name, _ in self.named_regions()]
        repeated = {name for name in names if names.count(name) > 1}
        if repeated:
            raise ValueError(f"Scenario {self.name!r}: region names must be unique, repeated: {sorted(repeated)}")
        for alias, name in self.aliases:
            if name.casefold() not in names:
                raise UnknownName("region", name, [n for n, _ in self.named_regions()])
            if alias.casefold() in names:
                raise ValueError(f"Scenario {self.name!r}: alias {alias!r} is already the name of a region")
        for checkpoint in self.checkpoints:
            if not (0 <= checkpoint.x <= self.width_metres and 0 <= checkpoint.y <= self.height_metres):
                raise ValueError(
                    f"Scenario {self.name!r}: {checkpoint.name} at ({checkpoint.x}, {checkpoint.y}) lies outside the "
                    f"{self.width_metres} x {self.height_metres} m arena"
                )
        self._check_ego_task()

    def _check_ego_task(self) -> None:
        if self.ego_task not in EGO_TASKS:
            raise UnknownName("ego task", str(self.ego_task), EGO_TASKS)
        if (self.ego_task == "avoidance") != (self.ego_goal is not None):
            remedy = "give the region that it must reach" if self.ego_goal is None else "only avoidance has a goal"
            raise ValueError(
                f"Scenario {self.name!r}: ego_task is {self.ego_task!r} and ego_goal is {self.ego_goal}: {remedy}, "
                "or use Scenario.for_task"
            )
        if self.ego_goal is not None:
            x, y = self.ego_goal.centre
            if not (0 <= x <= self.width_metres and 0 <= y <= self.height_metres):
                raise ValueError(
                    f"Scenario {self.name!r}: the centre of ego_goal ({x:g}, {y:g}) lies outside the "
                    f"{self.width_metres} x {self.height_metres} m arena"
                )

    @classmethod
    def preset(cls, name: str) -> Scenario:
        """The scenario shipped under this name. Raises UnknownName with the nearest one."""
        from tab_marl.world.presets import PRESETS

        if name not in PRESETS:
            raise UnknownName("scenario", name, PRESETS)
        return PRESETS[name]()

    def for_task(
        self, ego_task: EgoTask, ego_goal: Region | None = None, watch_metres: float | None = None
    ) -> Scenario:
        """This scenario with another task for the ego. Avoidance without a goal gets `ego_tasks.far_goal`.

        Raises UnknownName for a task that does not exist, ValueError for a goal that does not belong to the task.
        """
        if ego_task == "avoidance" and ego_goal is None:
            from tab_marl.world.ego_tasks import far_goal

            ego_goal = self.ego_goal or far_goal(self)
        watch = self.watch_metres if watch_metres is None else watch_metres
        return replace(self, ego_task=ego_task, ego_goal=ego_goal, watch_metres=watch)

    @property
    def horizon_ticks(self) -> int:
        return round(self.horizon_seconds / self.step_seconds)

    def named_regions(self) -> tuple[tuple[str, Region], ...]:
        """Every (name, region): checkpoints first, then the scenario's own, then the places every arena has."""
        own = [(c.name, c.region) for c in self.checkpoints] + list(self.regions)
        taken = {name.casefold() for name, _ in own}
        return (*own, *((name, r) for name, r in self._standing_regions() if name.casefold() not in taken))

    def _standing_regions(self) -> list[tuple[str, Region]]:
        w, h = self.width_metres, self.height_metres
        corner_w, corner_h = w / 5, h / 5
        return [
            ("central zone", Disc(w / 2, h / 2, self.central_zone_metres)),
            ("top left", Box(0, h - corner_h, corner_w, h)),
            ("top right", Box(w - corner_w, h - corner_h, w, h)),
            ("bottom left", Box(0, 0, corner_w, corner_h)),
            ("bottom right", Box(w - corner_w, 0, w, corner_h)),
            ("left half", Box(0, 0, w / 2, h)),
            ("right half", Box(w / 2, 0, w, h)),
            ("top half", Box(0, h / 2, w, h)),
            ("bottom half", Box(0, 0, w, h / 2)),
        ]

    def spellings(self) -> dict[str, str]:
        """Every accepted spelling (case-folded) -> the region's one name. Checkpoint A is also checkpoint 1."""
        table = {name.casefold(): name for name, _ in self.named_regions()}
        for number, checkpoint in enumerate(self.checkpoints, start=1):
            for other in (f"checkpoint {number}", f"checkpoint {chr(ord('a') + number - 1)}"):
                table.setdefault(other, checkpoint.name)
        for other in ("center", "centre", "center of the environment", "centre of the environment"):
            table.setdefault(other, "central zone")
        for alias, name in self.aliases:
            table[alias.casefold()] = table[name.casefold()]
        return table

    @cached_property
    def _region_of(self) -> dict[str, Region]:
        """Every accepted spelling (case-folded) -> its region; tables of names are slow to build, and asked for often."""
        regions = dict(self.named_regions())
        return {spelling: regions[name] for spelling, name in self.spellings().items()}

    def region(self, name: str) -> Region:
        """The region of this name or alias, any case. Raises UnknownName."""
        found = self._region_of.get(name.casefold())
        if found is None:
            raise UnknownName("region", name, self.spellings().values())
        return found

    def place(self, place: str | tuple[float, float]) -> Region:
        """The region of a name, or the goal disc around a bare target point."""
        if isinstance(place, str):
            return self.region(place)
        return Disc(place[0], place[1], self.target_radius_metres)

    def seen(self, points: object) -> np.ndarray:
        """``[N]`` bool: which points ``[N, 2]`` lie inside some camera disc."""
        array = np.asarray(points, dtype=np.float64)
        inside = np.zeros(array.shape[:-1], dtype=bool)
        for checkpoint in self.checkpoints:
            inside |= checkpoint.camera.contains(array)
        return inside


def require_positive(owner: object, name: str) -> None:
    """Raise ValueError naming the field and the value unless it is a finite number > 0."""
    value = getattr(owner, name)
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{type(owner).__name__}.{name} is {value}, must be > 0")
