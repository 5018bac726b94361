"""Anti-aliased drawing on pygame surfaces in metres, colours and type. Knows nothing about missions or robots.

Shapes are drawn at SUPERSAMPLING times the final size and scaled down once per frame; text is set at the final size.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pygame
from numpy.typing import NDArray

from tab_marl.world.regions import Disc, Region

Colour = tuple[int, int, int]
Point = tuple[float, float]

SUPERSAMPLING = 2
DASH_PIXELS = 13
"""Length of one dash and gap on a dashed circle, final pixels."""
DASH_SHARE = 0.58
"""Of which this share is dash."""

PAPER: Colour = (246, 247, 249)
FLOOR: Colour = (255, 255, 255)
GRID: Colour = (236, 239, 243)
INK: Colour = (31, 36, 45)
MUTED: Colour = (112, 122, 137)
LINE: Colour = (216, 221, 229)
SOLID: Colour = (84, 94, 110)
SOLID_EDGE: Colour = (58, 66, 79)
EGO: Colour = (32, 101, 219)
ADVERSARY: Colour = (219, 72, 31)
CAMERA: Colour = (96, 152, 163)
LIT: Colour = (245, 178, 20)
GOAL: Colour = (24, 145, 92)
FORBIDDEN: Colour = (200, 52, 74)
ZONE: Colour = (136, 124, 168)
HEAT: Colour = (112, 46, 188)


class Canvas:
    """A surface addressed in metres, y upwards, drawn at SUPERSAMPLING times its final size."""

    def __init__(self, width_metres: float, height_metres: float, pixels_per_metre: float, margin: int) -> None:
        self.scale = pixels_per_metre * SUPERSAMPLING
        self.margin = margin * SUPERSAMPLING
        self.height_metres = height_metres
        self.width_metres = width_metres
        self.size = (
            round(width_metres * self.scale) + 2 * self.margin,
            round(height_metres * self.scale) + 2 * self.margin,
        )
        self.surface = pygame.Surface(self.size, pygame.SRCALPHA, 32)

    def at(self, x: float, y: float) -> Point:
        """Pixel of a point in metres."""
        return (self.margin + x * self.scale, self.margin + (self.height_metres - y) * self.scale)

    def final(self, x: float, y: float) -> Point:
        """Pixel of a point in metres on the scaled-down picture."""
        px, py = self.at(x, y)
        return (px / SUPERSAMPLING, py / SUPERSAMPLING)

    def inside(self) -> pygame.Rect:
        """The arena's pixels, without the margin."""
        left, top = self.at(0.0, self.height_metres)
        right, bottom = self.at(self.width_metres, 0.0)
        return pygame.Rect(round(left), round(top), round(right - left), round(bottom - top))

    def layer(self) -> Canvas:
        """An empty transparent canvas of the same geometry."""
        return Canvas(
            self.width_metres, self.height_metres, self.scale / SUPERSAMPLING, self.margin // SUPERSAMPLING
        )  # fmt: skip

    def disc(self, x: float, y: float, radius: float, colour: Colour, alpha: int = 255) -> None:
        """A filled disc; radius in metres."""
        self._stamp(x, y, _round_patch(round(radius * self.scale, 1), None, 0, colour, alpha))

    def ring(self, x: float, y: float, radius: float, colour: Colour, width: float, alpha: int = 255) -> None:
        """A circle's outline; width in final pixels, drawn inwards."""
        self._stamp(x, y, _round_patch(round(radius * self.scale, 1), width * SUPERSAMPLING, 0, colour, alpha))

    def dashes(self, x: float, y: float, radius: float, colour: Colour, width: float, alpha: int = 255) -> None:
        """A dashed circle; width in final pixels, drawn inwards."""
        pixels = round(radius * self.scale, 1)
        count = max(12, round(2 * math.pi * pixels / (DASH_PIXELS * SUPERSAMPLING)))
        self._stamp(x, y, _round_patch(pixels, width * SUPERSAMPLING, count, colour, alpha))

    def _stamp(self, x: float, y: float, patch: pygame.Surface) -> None:
        px, py = self.at(x, y)
        half = patch.get_width() / 2
        self.surface.blit(patch, (round(px - half), round(py - half)))

    def line(self, points: NDArray[np.float64], colour: Colour, width: float, alpha: int = 255) -> None:
        """A polyline ``[N, 2]`` with round joints; width in final pixels."""
        self.fading_line(points, colour, width, np.full(len(points), alpha))

    def fading_line(
        self, points: NDArray[np.float64], colour: Colour, width: float, alphas: NDArray[np.integer[Any]]
    ) -> None:
        """A polyline ``[N, 2]`` whose opacity ``[N]`` is given at its points. Where it crosses itself it does not darken."""
        if len(points) < 2:
            return
        thick = max(1, round(width * SUPERSAMPLING))
        pixels = np.array([self.at(float(x), float(y)) for x, y in points])
        left, top = np.floor(pixels.min(axis=0) - thick).astype(int).tolist()
        right, bottom = np.ceil(pixels.max(axis=0) + thick).astype(int).tolist()
        patch = pygame.Surface((right - left + 2, bottom - top + 2), pygame.SRCALPHA, 32)
        inside = (pixels - (left, top)).tolist()
        for start, end, alpha in zip(inside[:-1], inside[1:], alphas[1:].tolist(), strict=True):
            _thick_segment(patch, (*colour, alpha), start, end, thick)
        self.surface.blit(patch, (left, top))

    def polygon(self, points: Iterable[Sequence[float]], colour: Colour, alpha: int = 255) -> None:
        """A filled polygon in metres."""
        pixels = [self.at(float(x), float(y)) for x, y in points]
        if alpha == 255:
            pygame.draw.polygon(self.surface, colour, pixels)
            return
        left, top = math.floor(min(p[0] for p in pixels)), math.floor(min(p[1] for p in pixels))
        right, bottom = max(p[0] for p in pixels), max(p[1] for p in pixels)
        patch = pygame.Surface((math.ceil(right - left) + 2, math.ceil(bottom - top) + 2), pygame.SRCALPHA, 32)
        pygame.draw.polygon(patch, (*colour, alpha), [(px - left, py - top) for px, py in pixels])
        self.surface.blit(patch, (left, top))

    def region(self, region: Region, colour: Colour, fill_alpha: int, width: float, line_alpha: int = 255) -> None:
        """A region, filled and outlined."""
        if isinstance(region, Disc):
            if fill_alpha:
                self.disc(region.x, region.y, region.radius, colour, fill_alpha)
            if width:
                self.ring(region.x, region.y, region.radius, colour, width, line_alpha)
            return
        corners = region.vertices()
        if fill_alpha:
            self.polygon(corners, colour, fill_alpha)
        if width:
            self.line(np.vstack([corners, corners[:1]]), colour, width, line_alpha)

    def heat(self, image: NDArray[np.float64], colour: Colour) -> None:
        """Values ``[rows, columns]`` >= 0 over the whole map, row 0 at the bottom, as one colour of varying opacity.

        Opacity follows the square root of the value over the largest one, so that thin spread-out mass stays visible.
        """
        values = np.nan_to_num(np.maximum(image, 0.0))
        top = float(values.max())
        if top <= 0.0:
            return
        share = np.sqrt(values / top)
        rows, columns = values.shape
        patch = pygame.Surface((columns, rows), pygame.SRCALPHA, 32)
        patch.fill((*colour, 0))
        opacity = pygame.surfarray.pixels_alpha(patch)
        opacity[:] = (205 * share[::-1].T).astype(np.uint8)
        del opacity  # unlocks the surface
        left, bottom = self.at(0.0, 0.0)
        right, upper = self.at(self.width_metres, self.height_metres)
        smooth = pygame.transform.smoothscale(patch, (round(right - left), round(bottom - upper)))
        self.surface.blit(smooth, (left, upper))

    def picture(self) -> pygame.Surface:
        """The finished picture at its final size."""
        size = (self.size[0] // SUPERSAMPLING, self.size[1] // SUPERSAMPLING)
        return pygame.transform.smoothscale(self.surface, size)


@lru_cache(maxsize=256)
def _round_patch(radius: float, width: float | None, dashes: int, colour: Colour, alpha: int) -> pygame.Surface:
    """A disc (width None) or a ring of so many dashes (0: unbroken), in pixels, with soft edges."""
    side = 2 * math.ceil(radius + 1)
    offset = np.arange(side) + 0.5 - side / 2
    distance = np.hypot(offset[:, None], offset[None, :])
    cover = np.clip(radius + 0.5 - distance, 0.0, 1.0)
    if width is not None:
        cover *= np.clip(distance - (radius - width) + 0.5, 0.0, 1.0)
    if dashes:
        turn = np.arctan2(offset[None, :], offset[:, None]) * dashes / (2 * math.pi) % 1.0
        along = 2 * math.pi * radius / dashes  # pixels of one dash and gap
        cover *= np.clip((DASH_SHARE / 2 - np.abs(turn - 0.5)) * along + 0.5, 0.0, 1.0)
    patch = pygame.Surface((side, side), pygame.SRCALPHA, 32)
    patch.fill((*colour, 0))
    opacity = pygame.surfarray.pixels_alpha(patch)
    opacity[:] = np.round(alpha * cover).astype(np.uint8)
    del opacity  # unlocks the surface
    return patch


def _thick_segment(
    surface: pygame.Surface, paint: tuple[int, int, int, int], start: Point, end: Point, thick: int
) -> None:
    # pygame's own thick lines are cut along an axis; a rectangle across the direction keeps its width at any angle.
    dx, dy = end[0] - start[0], end[1] - start[1]
    length = math.hypot(dx, dy)
    if length == 0.0:
        return
    if thick <= 2:
        pygame.draw.line(surface, paint, start, end, thick)
        return
    pygame.draw.circle(surface, paint, start, thick / 2 - 0.5)
    pygame.draw.circle(surface, paint, end, thick / 2 - 0.5)
    ox, oy = -dy / length * thick / 2, dx / length * thick / 2
    pygame.draw.polygon(
        surface, paint,
        [(start[0] + ox, start[1] + oy), (end[0] + ox, end[1] + oy), (end[0] - ox, end[1] - oy), (start[0] - ox, start[1] - oy)],
    )  # fmt: skip


def write(
    surface: pygame.Surface,
    text: str,
    at: Point,
    size: int = 13,
    colour: Colour = INK,
    bold: bool = False,
    anchor: str = "topleft",
    halo: Colour | None = None,
) -> pygame.Rect:
    """Set a line of text; `anchor` names the point of its rectangle (pygame's names). A halo keeps it legible on a map."""
    image = _set(text, size, colour, bold, halo)
    place = image.get_rect(**{anchor: (round(at[0]), round(at[1]))})
    surface.blit(image, place)
    return place


def wrapped(text: str, width: int, size: int, bold: bool = False) -> list[str]:
    """The text broken into lines of at most `width` pixels."""
    font = _font(size, bold)
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and font.size(longer)[0] <= width:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


@lru_cache(maxsize=1024)
def _set(text: str, size: int, colour: Colour, bold: bool, halo: Colour | None) -> pygame.Surface:
    font = _font(size, bold)
    letters = font.render(text, True, colour)
    if halo is None:
        return letters
    width = max(1, size // 12)
    image = pygame.Surface((letters.get_width() + 2 * width, letters.get_height() + 2 * width), pygame.SRCALPHA, 32)
    image.fill((*halo, 0))
    behind = font.render(text, True, halo)
    for dx in range(2 * width + 1):
        for dy in range(2 * width + 1):
            image.blit(behind, (dx, dy))
    image.blit(letters, (width, width))
    return image


@lru_cache(maxsize=64)
def _font(size: int, bold: bool) -> pygame.font.Font:
    pygame.font.init()
    path = _dejavu(bold)
    return pygame.font.Font(None if path is None else str(path), size)


@lru_cache(maxsize=2)
def _dejavu(bold: bool) -> Path | None:
    """DejaVu Sans as it comes with Matplotlib, found without importing it; None if Matplotlib is not there."""
    spec = importlib.util.find_spec("matplotlib")
    if spec is None or not spec.submodule_search_locations:
        return None
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    path = Path(next(iter(spec.submodule_search_locations))) / "mpl-data" / "fonts" / "ttf" / name
    return path if path.is_file() else None
