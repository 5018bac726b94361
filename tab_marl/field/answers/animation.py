"""A field as a film: animated GIF, or MP4 where ffmpeg is installed. The writers serve every other film as well."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from tab_marl.field.tab_field import TabField

KINDS = (".gif", ".mp4")
COLOURS = 64
"""Of a film of a field, as GIF."""
LAST_PICTURE_MILLISECONDS = 2000


class FilmError(ValueError):
    """The film cannot be written: says why, and what to write instead."""


def check_film(path: str | Path) -> None:
    """Raise FilmError unless a film of this name can be made; before any work is done."""
    kind = Path(path).suffix.casefold()
    if kind not in KINDS:
        raise FilmError(f"{path}: cannot write {kind or 'such'} films; end the name in .gif or .mp4")
    if kind == ".mp4" and ffmpeg_program() is None:
        raise FilmError(
            f"{path}: MP4 needs the program ffmpeg (pip install 'tab-marl[video]' brings one); write a .gif"
        )


def animate_field(field: TabField, path: str | Path, frames_per_second: int = 8) -> int:
    """See `TabField.animate`. Raises FilmError, OSError."""
    from tab_marl.field.answers.drawing import occupancy_frames

    if frames_per_second < 1:
        raise FilmError(f"frames_per_second is {frames_per_second}, must be >= 1")
    check_film(path)
    frames = occupancy_frames(field)
    if Path(path).suffix.casefold() == ".mp4":
        return write_mp4(frames, Path(path), frames_per_second)
    return write_gif(frames, Path(path), frames_per_second, COLOURS)


def write_gif(frames: Iterable[NDArray[np.uint8]], path: Path, frames_per_second: int, colours: int) -> int:
    """Pictures ``[height, width, 3]`` as an animated GIF; the last one stays long enough to be read. Returns how many."""
    from PIL import Image

    pictures = [Image.fromarray(f).quantize(colours, dither=Image.Dither.NONE) for f in frames]
    if not pictures:
        return 0
    durations = [round(1000 / frames_per_second)] * (len(pictures) - 1) + [LAST_PICTURE_MILLISECONDS]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=durations, loop=0)
    return len(pictures)


def ffmpeg_program() -> str | None:
    """The program on the path, or the one that imageio-ffmpeg (the `video` extra) brings."""
    found = shutil.which("ffmpeg")
    if found is None:
        try:
            from imageio_ffmpeg import get_ffmpeg_exe
        except ImportError:
            return None
        try:
            found = get_ffmpeg_exe()
        except RuntimeError:
            return None
    return found


def write_mp4(frames: Iterable[NDArray[np.uint8]], path: Path, frames_per_second: int) -> int:
    """Pictures ``[height, width, 3]`` as H.264 video; returns how many. Raises FilmError with ffmpeg's own words."""
    pictures = iter(frames)
    first = next(pictures, None)
    if first is None:
        return 0
    # The codec halves colour resolution, so both sides must be even.
    height, width = first.shape[0] // 2 * 2, first.shape[1] // 2 * 2
    command = [
        ffmpeg_program() or "ffmpeg", "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24",
        "-s", f"{width}x{height}", "-r", str(frames_per_second), "-i", "-", "-c:v", "libx264", "-pix_fmt", "yuv420p",
        "-crf", "20", str(path),
    ]  # fmt: skip
    count = 0
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as running:
        assert running.stdin is not None and running.stderr is not None
        try:
            for frame in (first, *pictures):
                running.stdin.write(np.ascontiguousarray(frame[:height, :width]).tobytes())
                count += 1
            running.stdin.close()
        except BrokenPipeError:
            pass  # ffmpeg ended early; its own words follow
        problem = running.stderr.read().decode(errors="replace").strip()
    if running.returncode != 0:
        raise FilmError(
            f"{path}: ffmpeg could not write it: {problem.splitlines()[-1] if problem else 'no reason given'}"
        )
    return count
