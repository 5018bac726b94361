"""Films: what is written can be read back; what cannot be written is one clear line."""

import numpy as np
import pytest
from PIL import Image

from tab_marl.evaluation import film
from tab_marl.evaluation.errors import UserError


def frames(count=4):
    for k in range(count):
        frame = np.full((21, 31, 3), 255, dtype=np.uint8)
        frame[:, 5 * k : 5 * k + 5] = (200, 0, 0)
        yield frame


def test_gif_has_every_frame(tmp_path):
    assert film.write_film(frames(), tmp_path / "a.gif", 5) == 4
    with Image.open(tmp_path / "a.gif") as picture:
        assert picture.n_frames == 4 and picture.size == (31, 21)
        assert picture.info["duration"] == 200
        picture.seek(2)
        assert picture.convert("RGB").getpixel((12, 3))[0] > 150 > picture.convert("RGB").getpixel((12, 3))[1]


def test_folder_of_pngs(tmp_path):
    assert film.write_film(frames(), tmp_path / "walk", 5) == 4
    assert [p.name for p in sorted((tmp_path / "walk").iterdir())] == [f"frame-000{k}.png" for k in range(4)]
    assert film.write_film(frames(), tmp_path / "b.png", 5) == 4
    assert (tmp_path / "b" / "frame-0003.png").exists()


@pytest.mark.skipif(film.ffmpeg_program() is None, reason="no ffmpeg installed")
def test_mp4_reads_back(tmp_path):
    import imageio_ffmpeg

    assert film.write_film(frames(), tmp_path / "a.mp4", 5) == 4
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "a.mp4"), pix_fmt="rgb24")
    about = next(reader)
    assert about["size"] == (30, 20) and about["fps"] == 5  # even sides
    assert len(list(reader)) == 4
    assert film.write_film(iter(()), tmp_path / "none.mp4", 5) == 0


def test_unknown_kind_and_bad_places(tmp_path, monkeypatch):
    with pytest.raises(UserError, match=r"cannot write \.avi films"):
        film.check_target(tmp_path / "a.avi")
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        film.check_target(tmp_path / "file" / "a.gif")
    monkeypatch.setattr(film, "ffmpeg_program", lambda: None)
    with pytest.raises(UserError, match="needs the program ffmpeg"):
        film.check_target(tmp_path / "a.mp4")
