"""Frames of an episode as a file: animated GIF, MP4 (with ffmpeg) or a folder of PNGs."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tab_marl.evaluation.errors import UserError
from tab_marl.field.answers.animation import FilmError, ffmpeg_program, write_gif, write_mp4

Frame = NDArray[np.uint8]
"""``[height, width, 3]``."""

COLOURS = 128
"""Of an episode, as GIF."""
KINDS = (".gif", ".mp4", ".png")


def check_target(path: Path) -> str:
    """The kind of file that the name asks for ("" and ".png": a folder of PNGs). Raises UserError, before any work."""
    kind = path.suffix.casefold()
    if kind not in ("", *KINDS):
        raise UserError(f"{path}: cannot write {kind} films; end the name in .gif, .mp4 or .png (a picture per frame)")
    if kind == ".mp4" and ffmpeg_program() is None:
        raise UserError(
            f"{path}: MP4 needs the program ffmpeg (pip install 'tab-marl[video]' brings one); write a .gif instead"
        )
    try:
        (path if kind == "" else path.parent).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None
    return kind


def write_film(frames: Iterable[Frame], path: Path, frames_per_second: int) -> int:
    """Write the frames as `check_target` understands the name; returns how many. Raises UserError if that fails."""
    kind = check_target(path)
    try:
        if kind == ".gif":
            return write_gif(frames, path, frames_per_second, COLOURS)
        if kind == ".mp4":
            return write_mp4(frames, path, frames_per_second)
        return _pngs(frames, path if kind == "" else path.with_suffix(""))
    except FilmError as error:
        raise UserError(str(error)) from None
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror or error}") from None


def _pngs(frames: Iterable[Frame], folder: Path) -> int:
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    count = 0
    for count, frame in enumerate(frames, start=1):
        Image.fromarray(frame).save(folder / f"frame-{count - 1:04d}.png")
    return count
