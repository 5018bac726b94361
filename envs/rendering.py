"""The picture of an episode: the map with both robots on the left, mission, clock and sensors on the right.

`Renderer` draws a `Frame`, plain data, so that replays need no environment. Nothing here opens a window; `Window` does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pygame
from numpy.typing import NDArray

from tab_marl.envs import drawing as d
from tab_marl.envs.lidar import Lidar
from tab_marl.envs.mission_scene import MissionScene
from tab_marl.envs.panel import draw_panel
from tab_marl.envs.physics import Motion
from tab_marl.world.regions import Region
from tab_marl.world.scenario import Scenario

MAP_PIXELS = 672
"""The longer side of the arena on the final picture."""
MARGIN_PIXELS = 24
PANEL_PIXELS = 320
NAME_LOWEST_SHARE = 0.035
"""Names stay at least this share of the arena's height above its lower wall."""
NAME_PIXELS = 3
"""Between a place and its name below."""
TRAIL_SECONDS = 12.0
"""After so long a trail has faded to its faintest."""


@dataclass(frozen=True, eq=False)
class Other:
    """A robot beside the first of each side, in a team."""

    motion: Motion
    trail: NDArray[np.float64]
    """``[N, 2]`` metres, one point per control step, the newest last."""
    is_ego: bool
    seen: bool
    """By a camera; egos always are."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One moment of an episode, for drawing."""

    ego: Motion
    adversary: Motion
    seconds: float
    ego_trail: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))
    """``[N, 2]`` metres, one point per control step, the newest last."""
    adversary_trail: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))
    seen_by: tuple[int, ...] = ()
    """Indices of the checkpoints whose cameras see the adversary."""
    also_lit: tuple[int, ...] = ()
    """Indices of the checkpoints whose cameras see another adversary."""
    also: tuple[str, ...] = ()
    """A line about each other adversary's mission."""
    last_seen: tuple[float, float, float] | None = None
    """x, y [m] and time [s] of the latest sighting."""
    status: str = "active"
    """Of the mission: "active", "completed" or "failed"."""
    why_failed: str = ""
    completed_seconds: float | None = None
    stage: int = 0
    """Index of the current stage."""
    visits: int = 0
    """Counted visits within the current stage."""
    mission_seconds_left: float | None = None
    """Until the mission's next bound."""
    intercepted: bool = False
    over: bool = False
    """No step follows."""
    ranges: NDArray[np.float64] | None = None
    """``[rays]`` metres of the ego's lidar, to be drawn."""
    heat: NDArray[np.float64] | None = None
    """``[rows, columns]`` a belief or field over the map, row 0 at the bottom."""
    heat_label: str = "belief"
    others: tuple[Other, ...] = ()
    """Robots in play beside `ego` and `adversary`."""
    adversary_in_play: bool = True
    """False once it left the arena, in a team; then it is not drawn."""
    watched: bool = False
    """Ego task surveillance: the ego watches the adversary."""
    ego_ending: str = ""
    """Ego task avoidance: how it ended, "Goal reached" or "Encounter"."""


class Renderer:
    """Draws frames of one scenario and mission."""

    def __init__(self, scenario: Scenario, scene: MissionScene | None) -> None:
        self.scenario = scenario
        self.scene = scene
        longest = max(scenario.width_metres, scenario.height_metres)
        self._canvas = d.Canvas(scenario.width_metres, scenario.height_metres, MAP_PIXELS / longest, MARGIN_PIXELS)
        self._places = _named_places(scenario, scene)
        self._base = self._draw_map()
        map_width, map_height = (side // d.SUPERSAMPLING for side in self._base.get_size())
        self.size = (map_width + PANEL_PIXELS, max(map_height, MAP_PIXELS + 2 * MARGIN_PIXELS))
        self._map_top = (self.size[1] - map_height) // 2

    def draw(self, frame: Frame) -> pygame.Surface:
        """The picture of a frame, at its final size."""
        canvas = self._canvas
        canvas.surface.blit(self._base, (0, 0))
        if frame.heat is not None:
            canvas.heat(frame.heat, d.HEAT)
        self._draw_places(frame)
        self._draw_solids()
        self._write_names(frame)
        self._draw_trail(frame.adversary_trail, d.ADVERSARY)
        self._draw_trail(frame.ego_trail, d.EGO)
        for other in frame.others:
            self._draw_trail(other.trail, d.EGO if other.is_ego else d.ADVERSARY)
        if frame.ranges is not None:
            self._draw_lidar(frame.ego, frame.ranges)
        if frame.last_seen is not None and not (frame.seen_by or frame.watched):
            self._draw_last_seen(frame.last_seen)
        self._draw_robots(frame)
        picture = pygame.Surface(self.size)
        picture.fill(d.PAPER)
        scaled = canvas.picture()
        picture.blit(scaled, (0, self._map_top))
        if frame.ego_ending:
            colour = d.EGO if frame.ego_ending == "Goal reached" else d.ADVERSARY
            self._write_banner(picture, f"{frame.ego_ending} at {frame.seconds:.1f} s", colour)
        elif frame.intercepted:
            late = frame.completed_seconds is not None
            text = f"Intercepted at {frame.seconds:.1f} s" + (", after the mission" if late else "")
            self._write_banner(picture, text, d.ADVERSARY if late else d.EGO)
        elif frame.over and frame.completed_seconds is not None:
            self._write_banner(picture, f"Mission completed at {frame.completed_seconds:.1f} s", d.ADVERSARY)
        elif frame.over and self.scenario.ego_task == "interception":
            self._write_banner(picture, f"Not intercepted in {frame.seconds:.1f} s", d.ADVERSARY)
        draw_panel(picture, self.size[0] - PANEL_PIXELS, PANEL_PIXELS, self.scenario, self.scene, frame)
        return picture

    def array(self, frame: Frame) -> NDArray[np.uint8]:
        """The picture as ``[height, width, 3]``."""
        picture = self.draw(frame)
        width, height = picture.get_size()
        pixels = np.frombuffer(pygame.image.tobytes(picture, "RGB"), dtype=np.uint8)
        return pixels.reshape(height, width, 3).copy()  # the buffer is read-only

    def _draw_map(self) -> pygame.Surface:
        """What never changes: the floor, its grid and the frame."""
        scenario = self.scenario
        base = self._canvas.layer()
        base.surface.fill(d.PAPER)
        w, h = scenario.width_metres, scenario.height_metres
        corners = np.array([(0.0, 0.0), (w, 0.0), (w, h), (0.0, h), (0.0, 0.0)])
        base.polygon(corners[:4], d.FLOOR)
        spacing = 0.5 if max(w, h) <= 4 else 1.0
        for x in np.arange(spacing, w - 1e-9, spacing):
            base.line(np.array([(x, 0.0), (x, h)]), d.GRID, 1)
        for y in np.arange(spacing, h - 1e-9, spacing):
            base.line(np.array([(0.0, y), (w, y)]), d.GRID, 1)
        base.line(corners, d.SOLID_EDGE, 3)
        return base.surface

    def _draw_solids(self) -> None:
        for obstacle in self.scenario.obstacles:
            self._canvas.region(obstacle, d.SOLID, 255, 0)
            self._canvas.region(obstacle, d.SOLID_EDGE, 0, 1.5)

    def _draw_places(self, frame: Frame) -> None:
        canvas, scenario = self._canvas, self.scenario
        goals, avoided = self._goals(frame), () if self.scene is None else self.scene.avoided
        canvas.surface.set_clip(canvas.inside())
        zone = scenario.region("central zone")
        if zone not in avoided:
            x, y = zone.centre
            canvas.dashes(x, y, zone.bounds()[2] - x, d.ZONE, 1.5, 150)
        for region in avoided:
            self._draw_forbidden(region)
        for index, checkpoint in enumerate(scenario.checkpoints):
            at = (checkpoint.x, checkpoint.y, checkpoint.camera_metres)
            if index in frame.seen_by or index in frame.also_lit:
                canvas.disc(*at, d.LIT, 70)
                canvas.ring(*at, d.LIT, 2.5)
            else:
                canvas.disc(*at, d.CAMERA, 20)
                canvas.dashes(*at, d.CAMERA, 1.25, 190)
        for _, place in self._places:
            if place not in goals:
                canvas.region(place, d.MUTED, 26, 1.5, 160)
        for goal in goals:
            canvas.region(goal, d.GOAL, 46, 2.5)
        if scenario.ego_goal is not None:
            canvas.region(scenario.ego_goal, d.EGO, 46, 2.5)
        canvas.surface.set_clip(None)

    def _goals(self, frame: Frame) -> tuple[Region, ...]:
        """Regions of the stage that is current."""
        if self.scene is None or frame.status != "active" or frame.stage >= len(self.scene.stages):
            return ()
        return self.scene.stages[frame.stage].regions

    def _draw_forbidden(self, region: Region) -> None:
        canvas = self._canvas
        canvas.region(region, d.FORBIDDEN, 16, 1.75, 190)
        x_min, y_min, x_max, y_max = region.bounds()
        step = 0.02 * max(canvas.width_metres, canvas.height_metres)
        along = np.linspace(0.0, 1.0, 90)
        for offset in np.arange(y_min - (x_max - x_min), y_max, step):
            x = x_min + along * (x_max - x_min)
            points = np.column_stack([x, offset + (x - x_min)])
            inside = points[region.contains(points)]
            if len(inside) > 1:
                canvas.line(inside[[0, -1]], d.FORBIDDEN, 1, 75)

    def _draw_trail(self, trail: NDArray[np.float64], colour: d.Colour) -> None:
        age = np.arange(len(trail))[::-1] / (TRAIL_SECONDS * self.scenario.control_hertz)
        self._canvas.fading_line(trail, colour, 2.25, (215 - 150 * np.minimum(age, 1.0)).astype(int))

    def _draw_lidar(self, ego: Motion, ranges: NDArray[np.float64]) -> None:
        turn = ego.theta + 2 * math.pi * np.arange(len(ranges)) / len(ranges)
        ends = np.column_stack([ego.x + ranges * np.cos(turn), ego.y + ranges * np.sin(turn)])
        for (x, y), distance in zip(ends, ranges, strict=True):
            self._canvas.line(np.array([(ego.x, ego.y), (x, y)]), d.EGO, 1, 50)
            if distance < self.scenario.sensors.lidar_metres:
                self._canvas.disc(x, y, 0.012, d.EGO, 190)

    def _draw_last_seen(self, sighting: tuple[float, float, float]) -> None:
        x, y, _ = sighting
        arm = 0.05
        for sign in (-1, 1):
            self._canvas.line(np.array([(x - arm, y - sign * arm), (x + arm, y + sign * arm)]), d.ADVERSARY, 2.5, 170)

    def _draw_robots(self, frame: Frame) -> None:
        canvas, scenario = self._canvas, self.scenario
        egos = [frame.ego, *(other.motion for other in frame.others if other.is_ego)]
        reach = scenario.watch_metres if scenario.ego_task == "surveillance" else scenario.interception_metres
        canvas.surface.set_clip(canvas.inside())
        for ego in egos:
            canvas.disc(ego.x, ego.y, reach, d.LIT if frame.watched else d.EGO, 40 if frame.watched else 18)
            canvas.dashes(ego.x, ego.y, reach, d.EGO, 1.5, 170)
        canvas.surface.set_clip(None)
        if frame.adversary_in_play:
            seen = bool(frame.seen_by) or frame.watched
            _draw_robot(canvas, frame.adversary, scenario.adversary.radius_metres, d.ADVERSARY, seen)
        for other in frame.others:
            if not other.is_ego:
                _draw_robot(canvas, other.motion, scenario.adversary.radius_metres, d.ADVERSARY, other.seen)
        for ego in egos:
            _draw_robot(canvas, ego, scenario.ego.radius_metres, d.EGO, True)

    def _write_names(self, frame: Frame) -> None:
        canvas, goals = self._canvas, self._goals(frame)
        for name, region in self._places:
            bold = region in goals
            px, py = canvas.at(region.centre[0], max(region.bounds()[1], NAME_LOWEST_SHARE * canvas.height_metres))
            d.write(
                canvas.surface, name, (px, py + NAME_PIXELS * d.SUPERSAMPLING), 12 * d.SUPERSAMPLING,
                d.GOAL if bold else d.INK, bold, "midtop", halo=d.FLOOR,
            )  # fmt: skip

    def _write_banner(self, picture: pygame.Surface, text: str, colour: d.Colour) -> None:
        middle = (self.size[0] - PANEL_PIXELS) // 2
        box = pygame.Rect(0, 0, 10 * len(text) + 60, 40)
        box.midtop = (middle, self._map_top + MARGIN_PIXELS + 14)
        shape = pygame.Surface((box.width * 2, box.height * 2), pygame.SRCALPHA)
        pygame.draw.rect(shape, (*colour, 240), shape.get_rect(), border_radius=box.height)
        picture.blit(pygame.transform.smoothscale(shape, box.size), box)
        d.write(picture, text, box.center, 17, (255, 255, 255), True, "center")


def _named_places(scenario: Scenario, scene: MissionScene | None) -> tuple[tuple[str, Region], ...]:
    """What is outlined and named: checkpoints, the scenario's own regions, and other goals of the mission."""
    names = {region: name for name, region in reversed(scenario.named_regions())}
    places = [(c.name, c.region) for c in scenario.checkpoints] + list(scenario.regions)
    shown = {region for _, region in places}
    goals = [] if scene is None else [region for stage in scene.stages for region in stage.regions]
    places += [(names.get(goal, "target"), goal) for goal in dict.fromkeys(goals) if goal not in shown]
    return tuple(places)


def _draw_robot(canvas: d.Canvas, motion: Motion, radius: float, colour: d.Colour, seen: bool) -> None:
    """A disc with a nose; hollow while no camera sees it."""
    x, y, theta = motion.x, motion.y, motion.theta
    canvas.disc(x + 0.008, y - 0.012, radius * 1.04, (20, 24, 32), 40)
    canvas.disc(x, y, radius, (255, 255, 255))
    canvas.disc(x, y, radius, colour, 255 if seen else 60)
    canvas.ring(x, y, radius, colour if not seen else tuple(int(0.7 * c) for c in colour), 2)  # type: ignore[arg-type]
    nose = [(0.86, 0.0), (-0.28, 0.52), (-0.05, 0.0), (-0.28, -0.52)]
    cos, sin = math.cos(theta), math.sin(theta)
    points = [(x + radius * (a * cos - b * sin), y + radius * (a * sin + b * cos)) for a, b in nose]
    canvas.polygon(points, (255, 255, 255) if seen else colour)


class Window:
    """A window on the screen that shows pictures as they come."""

    def __init__(self, size: tuple[int, int], title: str) -> None:
        pygame.display.init()
        pygame.display.set_caption(title)
        self._screen = pygame.display.set_mode(size)
        self._clock = pygame.time.Clock()

    def show(self, picture: pygame.Surface, frames_per_second: float) -> None:
        """Show a picture and wait out the frame."""
        pygame.event.pump()
        if self._screen.get_size() != picture.get_size():
            self._screen = pygame.display.set_mode(picture.get_size())
        self._screen.blit(picture, (0, 0))
        pygame.display.flip()
        self._clock.tick(frames_per_second)

    def close(self) -> None:
        """Close the window."""
        pygame.display.quit()


def lidar_ranges(scenario: Scenario, ego: Motion) -> NDArray[np.float64] | None:
    """The ego's lidar for a frame; None if the scenario has none."""
    if scenario.sensors.lidar_rays == 0:
        return None
    return Lidar.of(scenario).scan(ego.x, ego.y, ego.theta)
