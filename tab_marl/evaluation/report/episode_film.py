"""A replay as pictures: every planner's episode of one unit side by side, with map, trails, belief and field."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from tab_marl.evaluation.film import Frame, check_target, write_film
from tab_marl.evaluation.report.replay import BELIEF_LEVELS, decode_image

KINDS = ("gif", "mp4")
PANEL_PIXELS = 230
"""Width of one episode."""
COLUMNS = 4
FINER = 2
"""Pictures are drawn so many times as large and then made smaller: edges come out smooth."""
FRAMES = 120
"""A longer episode is shown faster."""
FRAMES_PER_SECOND = 12
CAPTION = 20
GAP = 8

COLOURS = {
    "page": (247, 248, 250), "floor": (255, 255, 255), "ink": (28, 35, 48), "soft": (91, 102, 118), "solid": (89, 101, 122),
    "ego": (32, 101, 219), "adversary": (199, 62, 21), "goal": (20, 128, 79), "camera": (47, 120, 132), "warn": (179, 38, 30),
    "heat": (112, 46, 188), "field": (138, 97, 0),
}  # fmt: skip
"""The page's, light."""


def check_kind(folder: Path, kind: str) -> None:
    """Raise UserError unless a film of this kind can be written there; before any episode is played."""
    check_target(folder / f"film.{kind}")


def export_films(groups: Sequence[Mapping[str, Any]], folder: Path, kinds: Sequence[str]) -> list[Path]:
    """A film of every replay in every kind ("gif", "mp4"); returns the files. Raises UserError if one cannot be written."""
    written = []
    for group in groups:
        frames = list(film_frames(group))
        for kind in kinds:
            path = folder / f"{re.sub('[^A-Za-z0-9]+', '-', group['title']).strip('-')}.{kind}"
            write_film(frames, path, FRAMES_PER_SECOND)
            written.append(path)
    return written


def film_frames(group: Mapping[str, Any]) -> Iterator[Frame]:
    """Pictures ``[height, width, 3]`` of a replay as `replaying.replay_groups` makes it, to the end of the longest episode."""
    episodes = group["episodes"]
    last = max(len(e["trace"]["poses"][0]) for e in episodes) - 1
    stride = max(1, math.ceil(last / FRAMES))
    steps = [*range(0, last, stride), last]
    beliefs = [
        _Pictures(e["trace"]["beliefs"], (e["trace"]["beliefRows"], e["trace"]["beliefColumns"])) for e in episodes
    ]
    field = group.get("field")
    fields = _Pictures(field["frames"], (field["rows"], field["columns"])) if field else None
    columns = min(COLUMNS, len(episodes))
    rows = math.ceil(len(episodes) / columns)
    scale = PANEL_PIXELS / group["map"]["width"]
    height = round(group["map"]["height"] * scale)
    size = (columns * (PANEL_PIXELS + GAP) + GAP, CAPTION + rows * (height + 2 * CAPTION + GAP) + GAP)
    for step in steps:
        whole = Image.new("RGB", size, COLOURS["page"])
        write = ImageDraw.Draw(whole)
        seconds = step / episodes[0]["trace"]["hertz"]
        write.text((GAP, 4), f"{group['title']}    {seconds:5.1f} s", COLOURS["ink"], _font(14))
        for i, episode in enumerate(episodes):
            x = GAP + (i % columns) * (PANEL_PIXELS + GAP)
            y = CAPTION + 4 + (i // columns) * (height + 2 * CAPTION + GAP)
            panel = _panel(group["map"], episode["trace"], beliefs[i], fields, step, (PANEL_PIXELS, height), scale)
            whole.paste(panel, (x, y))
            text, colour = _state(episode["trace"], seconds)
            write.text((x + 2, y + height + 3), episode["planner"], COLOURS["ink"], _font(14))
            write.text((x + 2, y + height + 2 + CAPTION), text, COLOURS[colour], _font(12))
        yield np.asarray(whole)


class _Pictures:
    """Encoded pictures by step, the latest one decoded."""

    def __init__(self, frames: Sequence[Sequence[Any]], shape: tuple[int, int]) -> None:
        self._frames, self._shape = frames, shape
        self._at, self._levels = -1, np.zeros(shape, dtype=np.uint8)
        self._dots: tuple[int, Image.Image] | None = None

    def at(self, step: int) -> NDArray[np.uint8]:
        """Levels ``[rows, columns]`` that hold at a step, row 0 at the top."""
        index = max((k for k, frame in enumerate(self._frames) if frame[0] <= step), default=0)
        if self._frames and index != self._at:
            self._at, self._levels = index, decode_image(self._frames[index][1], self._shape)[::-1]
        return self._levels

    def dots(self, step: int, size: tuple[int, int]) -> Image.Image:
        """The levels as dots, larger where there is more: a mask ``[height, width]``, drawn once for all panels."""
        levels = self.at(step)
        if self._dots is None or self._dots[0] != self._at:
            mask = Image.new("L", size)
            draw = ImageDraw.Draw(mask)
            (rows, columns), (width, height) = levels.shape, size
            across, down = width / columns, height / rows
            for row, column in zip(*np.nonzero(levels), strict=True):
                radius = min(across, down) * (0.06 + 0.28 * levels[row, column] / BELIEF_LEVELS)
                x, y = (column + 0.5) * across, (row + 0.5) * down
                draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=255)
            self._dots = self._at, mask
        return self._dots[1]


def _font(size: int) -> Any:
    return ImageFont.load_default(size)


def _panel(
    world: Mapping[str, Any],
    trace: Mapping[str, Any],
    beliefs: _Pictures,
    fields: _Pictures | None,
    step: int,
    size: tuple[int, int],
    scale: float,
) -> Image.Image:
    width, height = size[0] * FINER, size[1] * FINER
    pixels = scale * FINER
    picture = Image.new("RGB", (width, height), COLOURS["floor"])
    levels = beliefs.at(step)
    if levels.size:
        opacity = Image.fromarray((levels * (225 // BELIEF_LEVELS)).astype(np.uint8)).resize((width, height), Image.Resampling.BILINEAR)  # fmt: skip
        picture.paste(COLOURS["heat"], mask=opacity)
    draw = ImageDraw.Draw(picture)

    def at(x: float, y: float) -> tuple[float, float]:
        return x * pixels, height - y * pixels

    def circle(x: float, y: float, radius: float, **look: Any) -> None:
        (cx, cy), r = at(x, y), radius * pixels
        draw.ellipse((cx - r, cy - r, cx + r, cy + r), **look)

    def region(shape: Sequence[Any], **look: Any) -> None:
        if shape[0] == "disc":
            circle(shape[1], shape[2], shape[3], **look)
        elif shape[0] == "box":
            (x0, y1), (x1, y0) = at(shape[1], shape[2]), at(shape[3], shape[4])
            draw.rectangle((x0, y0, x1, y1), **look)
        else:
            draw.polygon([at(x, y) for x, y in shape[1]], **look)

    for spot in world["checkpoints"]:
        circle(spot["x"], spot["y"], spot["camera"], outline=COLOURS["camera"], width=FINER)
        circle(spot["x"], spot["y"], spot["r"], outline=COLOURS["soft"], width=FINER)
        draw.text(at(spot["x"], spot["y"]), spot["label"], COLOURS["soft"], _font(12 * FINER), anchor="mm")
    for zone in world["forbidden"]:
        region(zone, outline=COLOURS["warn"], width=2 * FINER)
    for goal in world["goals"]:
        region(goal, outline=COLOURS["goal"], width=3 * FINER)
    for obstacle in world["obstacles"]:
        region(obstacle, fill=COLOURS["solid"])
    if fields is not None:
        picture.paste(COLOURS["field"], mask=fields.dots(step, (width, height)))
    index = min(step, len(trace["poses"][0]) - 1)
    for offset, name, radius in ((3, "adversary", world["radii"][1]), (0, "ego", world["radii"][0])):
        xs, ys = (np.array(trace["poses"][offset + k][: index + 1]) / 1000 for k in (0, 1))
        if index:
            draw.line(
                [at(x, y) for x, y in zip(xs, ys, strict=True)], fill=COLOURS[name], width=2 * FINER, joint="curve"
            )
        hidden = name == "adversary" and trace["seen"][index] == "0"
        look = {"fill": COLOURS["floor"] if hidden else COLOURS[name], "outline": COLOURS[name], "width": 2 * FINER}
        circle(xs[-1], ys[-1], radius, **look)
        if name == "ego":
            circle(xs[-1], ys[-1], world["meet"], outline=COLOURS["ego"], width=FINER)
    return picture.resize(size, Image.Resampling.LANCZOS)


def _state(trace: Mapping[str, Any], seconds: float) -> tuple[str, str]:
    """What has happened by then, and the colour to say it in."""
    past = [(when, what) for when, what in trace["events"] if when <= seconds + 1e-6]
    if not past:
        seen = trace["seen"][min(round(seconds * trace["hertz"]), len(trace["seen"]) - 1)] == "1"
        return ("a camera sees the adversary" if seen else "the adversary is out of sight"), "soft"
    text = ", ".join(f"{what} at {when:.1f} s" for when, what in past)
    return text, "adversary" if past[0][1] == "mission completed" else "goal"
