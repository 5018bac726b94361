"""Frames of an episode as a file: animated GIF, MP4 (with ffmpeg) or a folder of PNGs."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tab_marl.evaluation.errors import UserError

Frame = NDArray[np.uint8]
"""``[height, width, 3]``."""

KINDS = (".gif", ".mp4", ".png")


def check_target(path: Path) -> str:
    """The kind of file that the name asks for ("" and ".png": a folder of PNGs). Raises UserError, before any work."""
    kind = path.suffix.casefold()
    if kind not in ("", *KINDS):
        raise UserError(f"{path}: cannot write {kind} films; end the name in .gif, .mp4 or .png (a picture per frame)")
    if kind == ".mp4" and shutil.which("ffmpeg") is None:
        raise UserError(f"{path}: MP4 needs the program ffmpeg, which is not installed; write a .gif instead")
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
            return _gif(frames, path, frames_per_second)
        if kind == ".mp4":
            return _mp4(frames, path, frames_per_second)
        return _pngs(frames, path if kind == "" else path.with_suffix(""))
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror or error}") from None


def _gif(frames: Iterable[Frame], path: Path, frames_per_second: int) -> int:
    from PIL import Image

    pictures = [Image.fromarray(f).quantize(128, dither=Image.Dither.NONE) for f in frames]
    if not pictures:
        return 0
    # The last picture stays for two seconds, so that the end can be read before the film starts again.
    durations = [round(1000 / frames_per_second)] * (len(pictures) - 1) + [2000]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=durations, loop=0)
    return len(pictures)


def _mp4(frames: Iterable[Frame], path: Path, frames_per_second: int) -> int:
    iterator: Iterator[Frame] = iter(frames)
    first = next(iterator, None)
    if first is None:
        return 0
    height, width = first.shape[0] // 2 * 2, first.shape[1] // 2 * 2  # the codec wants even sides
    command = [
        "ffmpeg", "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
        "-r", str(frames_per_second), "-i", "-", "-pix_fmt", "yuv420p", str(path),
    ]  # fmt: skip
    count = 0
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stderr is not None
        try:
            for frame in (first, *iterator):
                process.stdin.write(np.ascontiguousarray(frame[:height, :width]).tobytes())
                count += 1
        except BrokenPipeError:
            pass  # ffmpeg gave up; its own words say why
        process.stdin.close()
        message = process.stderr.read().decode(errors="replace").strip()
    if process.returncode:
        raise UserError(f"{path}: ffmpeg failed: {' '.join(message.split())}")
    return count


def _pngs(frames: Iterable[Frame], folder: Path) -> int:
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    count = 0
    for count, frame in enumerate(frames, start=1):
        Image.fromarray(frame).save(folder / f"frame-{count - 1:04d}.png")
    return count
