"""The pymunk world of one episode: walls, obstacles and differential-drive robots, stepped at `Scenario.physics_hertz`.

How a robot is driven. Its body is tied by a pivot joint and a gear joint to a kinematic "wheel" body that turns at the
commanded rate w; the pivot's anchor on the wheel lies at the instantaneous centre of rotation, so the anchor runs along
the commanded arc. The joints correct velocity only (``max_bias = 0``) and with bounded force, so a wall wins. Everything
happens inside Chipmunk: one set of Python calls per control step instead of one per substep. In free space the motion
equals the exact unicycle arc to rounding (the anchor is set half a substep ahead, so that each substep moves along the
chord); against a wall the robot slides without friction and sinks in by a millimetre or two for one substep.

A Space keeps a hidden contact cache (impulses of the contacts of the last substep, pairs that touch, the order of its
search tree), so positions and velocities alone do not restore it: a copy made from them drifts by a millimetre as soon as
there is contact. An Arena therefore remembers its commands, and a copy (`copy.deepcopy`, `pickle`) is a fresh Arena that is
driven through them again: exact to the last bit, at the cost of replaying the episode so far (about 30 us per control step).
Every episode builds a fresh Arena.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import pymunk
from pymunk import Body, Circle, GearJoint, PivotJoint, Poly, Shape, Space

from tab_marl.world.regions import Disc, Region
from tab_marl.world.scenario import Robot, Scenario

Start = tuple[float, float, float]
"""x [m], y [m], theta [rad]."""

EGO, ADVERSARY = 0, 1
"""Index of each robot in an Arena of one against one."""

WALL_METRES = 0.5
"""Walls are thick, outside the arena, so that nothing passes them."""
SLOP_METRES = 1e-4
"""Overlap that contacts tolerate; pymunk's default is 0.1, a third of an arm's length here."""
MOTOR_STRENGTH = 4.0
"""A motor can change its robot's velocity by this many times the top speed in one substep, no more."""
STRAIGHT_TURN_RATE = 1e-6
"""rad/s; slower turns count as straight, to keep the turning circle's radius finite."""

_SOLID_TYPE = 1000
"""Collision type of walls and obstacles; a robot's is its index."""


def _accessors(owner: type, name: str) -> tuple[Any, Any]:
    """A property's own functions: pymunk runs a Python __setattr__ on every assignment, and these skip it."""
    accessor: property = vars(owner)[name]
    return accessor.fget, accessor.fset


_get_position, _ = _accessors(Body, "position")
_get_angle, _set_angle = _accessors(Body, "angle")
_get_velocity, _set_velocity = _accessors(Body, "velocity")
_, _set_turn_rate = _accessors(Body, "angular_velocity")
_, _set_anchor = _accessors(PivotJoint, "anchor_a")


class Motion(NamedTuple):
    """Where a robot is and how it moves."""

    x: float
    """metres"""
    y: float
    """metres"""
    theta: float
    """rad, anticlockwise from the x axis; not wrapped"""
    v: float
    """m/s along the heading"""
    w: float
    """rad/s"""


class Arena:
    """The bodies of one episode: egos first, then adversaries. Commands hold until the next `command`."""

    def __init__(self, scenario: Scenario, starts: Sequence[Start], egos: int = 1) -> None:
        """`starts` of all robots, the first `egos` of them the egos'."""
        self._given = (scenario, tuple(starts), egos)
        self._log: list[tuple[int, tuple[tuple[float, float], ...] | int]] = []
        """(substeps run before, commands of all robots), or (substeps, index of a robot that was removed)."""
        self._substeps = 0
        self.substep_seconds = 1.0 / scenario.physics_hertz
        self.touching = [False] * len(starts)
        """Whether each robot touched a wall or an obstacle since the last `command`."""
        self._space = Space()
        self._space.collision_slop = SLOP_METRES
        for shape in _solids(scenario, self._space.static_body):
            shape.collision_type = _SOLID_TYPE
            shape.friction = 0.0
            self._space.add(shape)
        self._drives = [
            _Drive(self._space, scenario.ego if i < egos else scenario.adversary, pose, self.substep_seconds, i)
            for i, pose in enumerate(starts)
        ]
        self._driven = list(enumerate(self._drives))
        self._contacts = [0] * len(starts)
        self._pressed = [0] * len(starts)
        """How many other robots each robot touches; none where they intercept from farther away."""
        for robot in range(len(starts)):
            self._space.on_collision(
                robot, _SOLID_TYPE, begin=self._on_begin, separate=self._on_separate, data=robot
            )  # fmt: skip
            for other in range(robot + 1, len(starts)):
                self._space.on_collision(
                    robot, other, begin=self._on_meeting, separate=self._on_parting, data=(robot, other)
                )
        self._step = self._space.step

    def __getstate__(self) -> dict[str, Any]:
        return {"given": self._given, "log": list(self._log), "substeps": self._substeps}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """A fresh Arena, driven through the same commands."""
        self.__init__(*state["given"])  # type: ignore[misc]
        for before, entry in state["log"]:
            self.run(before - self._substeps)
            if isinstance(entry, int):
                self.remove(entry)
            else:
                self.command(*entry)
        self.run(state["substeps"] - self._substeps)

    def _on_begin(self, arbiter: pymunk.Arbiter, space: Space, robot: Any) -> None:
        self._contacts[robot] += 1
        self.touching[robot] = True

    def _on_separate(self, arbiter: pymunk.Arbiter, space: Space, robot: Any) -> None:
        self._contacts[robot] -= 1

    def _on_meeting(self, arbiter: pymunk.Arbiter, space: Space, pair: Any) -> None:
        for robot in pair:
            self._pressed[robot] += 1

    def _on_parting(self, arbiter: pymunk.Arbiter, space: Space, pair: Any) -> None:
        for robot in pair:
            self._pressed[robot] -= 1

    def command(self, *commands: tuple[float, float]) -> None:
        """Command (speed [m/s], turn rate [rad/s]) of every robot, in order; call before a run of substeps.

        The commands of robots that were removed are not looked at.
        """
        self._log.append((self._substeps, commands))
        touching, contacts, pressed = self.touching, self._contacts, self._pressed
        for i, drive in self._driven:
            v, w = commands[i]
            drive.command(v, w, touching[i] or pressed[i] > 0)
            touching[i] = contacts[i] > 0

    def remove(self, robot: int) -> None:
        """Take a robot out of the arena; its `motion` stays what it was, at rest."""
        self._log.append((self._substeps, robot))
        self._driven = [(i, drive) for i, drive in self._driven if i != robot]
        self._drives[robot].remove(self._space)
        self.touching[robot] = False

    def substep(self) -> None:
        """Advance by one physics substep."""
        self._substeps += 1
        self._step(self.substep_seconds)

    def run(self, substeps: int) -> None:
        """Advance by so many physics substeps."""
        step, seconds = self._step, self.substep_seconds
        self._substeps += substeps
        for _ in range(substeps):
            step(seconds)

    def squared_gap(self, robot: int = EGO, other: int = ADVERSARY) -> float:
        """Squared distance between two robots' centres, square metres."""
        x, y = _get_position(self._drives[robot].body)
        other_x, other_y = _get_position(self._drives[other].body)
        return float((x - other_x) ** 2 + (y - other_y) ** 2)

    def motion(self, robot: int) -> Motion:
        """The robot's motion now; against a wall v is what the wall leaves of the command."""
        drive = self._drives[robot]
        x, y = _get_position(drive.body)
        theta = _get_angle(drive.body)
        v = drive.v
        if self.touching[robot]:
            vx, vy = _get_velocity(drive.body)
            v = vx * math.cos(theta) + vy * math.sin(theta)
        return Motion(x, y, theta, v, drive.w)


class _Drive:
    """One robot: its body, the wheel that leads it and the two joints between them."""

    __slots__ = ("_parts", "_pivot", "_rolls", "_substep_seconds", "_wheel", "body", "v", "w")

    def __init__(self, space: Space, robot: Robot, pose: Start, substep_seconds: float, kind: int) -> None:
        mass, radius = robot.mass_kilograms, robot.radius_metres
        self._substep_seconds = substep_seconds
        self.v = self.w = 0.0
        self.body = Body(mass, pymunk.moment_for_circle(mass, 0.0, radius))
        self.body.position = pose[0], pose[1]
        self.body.angle = pose[2]
        hull = Circle(self.body, radius)
        hull.friction = 0.0
        hull.collision_type = kind
        self._wheel = Body(body_type=Body.KINEMATIC)
        self._wheel.position = self.body.position
        self._wheel.angle = pose[2]
        self._pivot = PivotJoint(self._wheel, self.body, (0.0, 0.0), (0.0, 0.0))
        gear = GearJoint(self._wheel, self.body, 0.0, 1.0)
        self._pivot.max_bias = gear.max_bias = 0.0
        self._pivot.max_force = MOTOR_STRENGTH * mass * robot.max_speed / substep_seconds
        gear.max_force = MOTOR_STRENGTH * self.body.moment * robot.max_turn_rate / substep_seconds
        self._rolls = False
        """Whether the wheel moves straight on; else it turns about a point that stands still."""
        self._parts = (self.body, hull, self._wheel, self._pivot, gear)
        space.add(*self._parts)

    def remove(self, space: Space) -> None:
        """Leave the space, and stand still."""
        space.remove(*self._parts)
        self.v = self.w = 0.0

    def command(self, v: float, w: float, touching: bool) -> None:
        self.v, self.w = v, w
        theta = _get_angle(self.body)
        half_turn = 0.5 * w * self._substep_seconds
        _set_angle(self._wheel, theta)
        _set_turn_rate(self._wheel, w)
        if -STRAIGHT_TURN_RATE < w < STRAIGHT_TURN_RATE:
            velocity = (v * math.cos(theta), v * math.sin(theta))
            _set_anchor(self._pivot, (0.0, 0.0))
            _set_velocity(self._wheel, velocity)
            self._rolls = True
        else:
            # The chord of one substep is shorter than its arc by sin(a)/a, and turned by a, half the substep's turn.
            chord_speed = v * math.sin(half_turn) / half_turn
            velocity = (chord_speed * math.cos(theta + half_turn), chord_speed * math.sin(theta + half_turn))
            radius = chord_speed / w
            _set_anchor(self._pivot, (radius * math.sin(half_turn), -radius * math.cos(half_turn)))
            if self._rolls:
                _set_velocity(self._wheel, (0.0, 0.0))
                self._rolls = False
        # Positions move with the old velocity before the joints act. In free space the new one is set at once, so that a
        # command does not lag a substep; in contact it is left to the solver, which would otherwise be pushed into the wall.
        if not touching:
            _set_velocity(self.body, velocity)
            _set_turn_rate(self.body, w)


def _solids(scenario: Scenario, static: Body) -> list[Shape]:
    w, h, t = scenario.width_metres, scenario.height_metres, WALL_METRES
    walls = ((-t, -t, 0.0, h + t), (w, -t, w + t, h + t), (-t, -t, w + t, 0.0), (-t, h, w + t, h + t))
    shapes: list[Shape] = [Poly(static, [(a, b), (c, b), (c, d), (a, d)]) for a, b, c, d in walls]
    return shapes + [_solid(obstacle, static) for obstacle in scenario.obstacles]


def _solid(obstacle: Region, static: Body) -> Shape:
    if isinstance(obstacle, Disc):
        return Circle(static, obstacle.radius, obstacle.centre)
    return Poly(static, [(float(x), float(y)) for x, y in obstacle.vertices()])
