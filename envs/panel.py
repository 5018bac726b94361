"""The column beside the map: the mission and how far it is, the clock, what the ego knows, and what the colours mean."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import pygame

from tab_marl.envs import drawing as d
from tab_marl.envs.mission_scene import MissionScene
from tab_marl.world.scenario import Scenario

if TYPE_CHECKING:
    from tab_marl.envs.rendering import Frame

INSET = 24
STATUS_COLOURS = {"active": d.INK, "completed": d.ADVERSARY, "failed": d.MUTED}
RADII = {"interception": "interception radius", "avoidance": "encounter radius", "surveillance": "watching radius"}
OTHERS_SHOWN = 3
"""Missions of further adversaries in the panel."""
MISSION_LINES = 7
"""Longer mission texts are cut."""


def draw_panel(
    picture: pygame.Surface, left: int, width: int, scenario: Scenario, scene: MissionScene | None, frame: Frame
) -> None:
    """Draw the panel into the picture, from x = left."""
    height = picture.get_height()
    pygame.draw.rect(picture, d.FLOOR, (left, 0, width, height))
    pygame.draw.line(picture, d.LINE, (left, 0), (left, height))
    x, inner = left + INSET, width - 2 * INSET
    y = INSET
    if scene is not None:
        y = _mission(picture, x, y, inner, scene, frame)
    if frame.also:
        y = _also(picture, x, y - 8, inner, frame.also)
    y = _clock(picture, x, y, inner, scenario, frame)
    _sensors(picture, x, y, inner, scenario, frame)
    _legend(picture, x, height - INSET, inner, scenario, scene, frame)


def _heading(picture: pygame.Surface, x: int, y: int, text: str) -> int:
    d.write(picture, text.upper(), (x, y), 10, d.MUTED, True)
    return y + 19


def _mission(picture: pygame.Surface, x: int, y: int, width: int, scene: MissionScene, frame: Frame) -> int:
    y = _heading(picture, x, y, "the adversary's mission")
    lines = d.wrapped(scene.text, width, 14)
    if len(lines) > MISSION_LINES:
        lines = [*lines[: MISSION_LINES - 1], lines[MISSION_LINES - 1] + " …"]
    for line in lines:
        d.write(picture, line, (x, y), 14)
        y += 20
    y += 8
    done = len(scene.stages) if frame.status == "completed" else frame.stage
    for index, stage in enumerate(scene.stages):
        current = index == done and frame.status == "active"
        colour = d.GOAL if index < done else d.INK if current else d.MUTED
        _tick_box(picture, x, y, index < done, current, frame.status == "failed" and index == done)
        text = stage.text
        if current and stage.visits > 1:
            text += f"  ({frame.visits} of {stage.visits})"
        for line in d.wrapped(text, width - 24, 12, current):
            d.write(picture, line, (x + 24, y), 12, colour, current)
            y += 17
        y += 5
    lines = d.wrapped(_status_words(frame), width - 12, 13, True)
    colour = STATUS_COLOURS.get(frame.status, d.INK)
    pygame.draw.rect(picture, colour, (x, y + 4, 4, 18 * len(lines) - 2), border_radius=2)
    for line in lines:
        d.write(picture, line, (x + 12, y + 3), 13, colour, True)
        y += 18
    return y + 26


def _also(picture: pygame.Surface, x: int, y: int, width: int, also: tuple[str, ...]) -> int:
    y = _heading(picture, x, y, "other adversaries")
    for text in also[:OTHERS_SHOWN]:
        for line in d.wrapped(text, width, 12):
            d.write(picture, line, (x, y), 12)
            y += 17
        y += 4
    if len(also) > OTHERS_SHOWN:
        d.write(picture, f"and {len(also) - OTHERS_SHOWN} more", (x, y), 12, d.MUTED)
        y += 17
    return y + 18


def _tick_box(picture: pygame.Surface, x: int, y: int, done: bool, current: bool, failed: bool) -> None:
    side = 15 * d.SUPERSAMPLING
    box = pygame.Surface((side, side), pygame.SRCALPHA)
    centre, radius = (side / 2, side / 2), side / 2 - 2
    if done:
        pygame.draw.circle(box, d.GOAL, centre, radius)
        pygame.draw.lines(box, (255, 255, 255), False, [(8, 15), (13, 21), (22, 10)], 4)
    elif failed:
        pygame.draw.circle(box, d.FORBIDDEN, centre, radius)
        pygame.draw.line(box, (255, 255, 255), (10, 10), (20, 20), 4)
        pygame.draw.line(box, (255, 255, 255), (20, 10), (10, 20), 4)
    else:
        pygame.draw.circle(box, d.GOAL if current else d.LINE, centre, radius, 4)
    small = pygame.transform.smoothscale(box, (side // d.SUPERSAMPLING, side // d.SUPERSAMPLING))
    picture.blit(small, (x, y))


def _status_words(frame: Frame) -> str:
    if frame.status == "completed":
        return "completed" if frame.completed_seconds is None else f"completed at {frame.completed_seconds:.1f} s"
    if frame.status == "failed":
        return f"failed: {frame.why_failed}" if frame.why_failed else "failed"
    left = frame.mission_seconds_left
    if left is None or not math.isfinite(left):
        return "under way"
    return f"under way, {max(0.0, left):.1f} s left"


def _clock(picture: pygame.Surface, x: int, y: int, width: int, scenario: Scenario, frame: Frame) -> int:
    y = _heading(picture, x, y, "time")
    total = scenario.horizon_seconds
    left = max(0.0, total - frame.seconds)
    d.write(picture, f"{frame.seconds:.1f} s", (x, y), 20, d.INK, True)
    d.write(picture, f"{left:.1f} s left of {total:g} s", (x + width, y + 18), 12, d.MUTED, False, "bottomright")
    y += 30
    pygame.draw.rect(picture, d.LINE, (x, y, width, 6), border_radius=3)
    share = min(1.0, frame.seconds / total)
    if share > 0.02:
        pygame.draw.rect(picture, d.INK, (x, y, round(width * share), 6), border_radius=3)
    return y + 26


def _sensors(picture: pygame.Surface, x: int, y: int, width: int, scenario: Scenario, frame: Frame) -> int:
    y = _heading(picture, x, y, "what the ego sees")
    if frame.seen_by or frame.also_lit:
        names = ", ".join(scenario.checkpoints[i].name for i in sorted({*frame.seen_by, *frame.also_lit}))
        text, colour = f"adversary at {names}", d.INK
        pygame.draw.rect(picture, d.LIT, (x, y + 2, 4, 14), border_radius=2)
    elif frame.watched:
        text, colour = "adversary in plain sight", d.INK
        pygame.draw.rect(picture, d.LIT, (x, y + 2, 4, 14), border_radius=2)
    elif frame.last_seen is not None:
        text, colour = f"nothing for {frame.seconds - frame.last_seen[2]:.1f} s", d.MUTED
        pygame.draw.rect(picture, d.LINE, (x, y + 2, 4, 14), border_radius=2)
    else:
        text, colour = "nothing so far", d.MUTED
        pygame.draw.rect(picture, d.LINE, (x, y + 2, 4, 14), border_radius=2)
    for line in d.wrapped(text, width - 12, 13):
        d.write(picture, line, (x + 12, y), 13, colour)
        y += 19
    bound = f"meet at {scenario.interception_metres:g} m"
    if scenario.ego_task == "surveillance":
        bound = f"sees up to {scenario.watch_metres:g} m"
    gap = math.hypot(frame.ego.x - frame.adversary.x, frame.ego.y - frame.adversary.y)
    d.write(picture, f"robots {gap:.2f} m apart, {bound}", (x + 12, y), 12, d.MUTED)
    return y + 24


def _legend(
    picture: pygame.Surface,
    x: int,
    bottom: int,
    width: int,
    scenario: Scenario,
    scene: MissionScene | None,
    frame: Frame,
) -> None:
    entries: list[tuple[str, d.Colour, str]] = [
        ("ego", d.EGO, "disc"),
        ("adversary (pale: unseen)", d.ADVERSARY, "disc"),
        (RADII[scenario.ego_task], d.EGO, "ring"),
        ("camera, idle / seeing", d.LIT, "camera"),
        ("current goal", d.GOAL, "region"),
    ]
    if scene is not None and scene.avoided:
        entries.append(("to be avoided", d.FORBIDDEN, "region"))
    if scenario.ego_goal is not None:
        entries.append(("the ego's goal", d.EGO, "region"))
    if frame.last_seen is not None:
        entries.append(("last sighting", d.ADVERSARY, "cross"))
    if frame.heat is not None:
        entries.append((frame.heat_label, d.HEAT, "heat"))
    y = bottom - 20 * len(entries)
    pygame.draw.line(picture, d.LINE, (x, y - 12), (x + width, y - 12))
    for text, colour, kind in entries:
        picture.blit(_sign(colour, kind), (x, y))
        d.write(picture, text, (x + 28, y), 12, d.INK)
        y += 20


def _sign(colour: d.Colour, kind: str) -> pygame.Surface:
    scale = 4
    big = pygame.Surface((20 * scale, 16 * scale), pygame.SRCALPHA)
    centre = (10 * scale, 8 * scale)
    if kind == "disc":
        pygame.draw.circle(big, colour, centre, 6 * scale)
    elif kind == "ring":
        pygame.draw.circle(big, (*colour, 40), centre, 7 * scale)
        pygame.draw.circle(big, colour, centre, 7 * scale, scale + 2)
    elif kind == "camera":
        pygame.draw.circle(big, (*d.CAMERA, 60), (6 * scale, 8 * scale), 6 * scale)
        pygame.draw.circle(big, d.CAMERA, (6 * scale, 8 * scale), 6 * scale, scale)
        pygame.draw.circle(big, (*colour, 120), (14 * scale, 8 * scale), 6 * scale)
        pygame.draw.circle(big, colour, (14 * scale, 8 * scale), 6 * scale, scale)
    elif kind == "cross":
        pygame.draw.line(big, colour, (6 * scale, 4 * scale), (14 * scale, 12 * scale), 2 * scale)
        pygame.draw.line(big, colour, (14 * scale, 4 * scale), (6 * scale, 12 * scale), 2 * scale)
    elif kind == "heat":
        for i in range(20 * scale):
            opacity = round(205 * math.sqrt(i / (20 * scale)))
            pygame.draw.line(big, (*colour, opacity), (i, 2 * scale), (i, 14 * scale))
    else:
        box = (2 * scale, 3 * scale, 16 * scale, 10 * scale)
        pygame.draw.rect(big, (*colour, 50), box, border_radius=3 * scale)
        pygame.draw.rect(big, colour, box, scale + 2, border_radius=3 * scale)
    return pygame.transform.smoothscale(big, (20, 16))
