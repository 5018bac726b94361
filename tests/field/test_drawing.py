"""Pictures and films of a field: made, of the right size, refused with reasons. What they show is looked at by people."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from tab_marl.field import FieldOptions, FieldProblem, TabField, solve
from tab_marl.field.answers.animation import FilmError, ffmpeg_program
from tab_marl.field.answers.drawing import draw_posterior
from tab_marl.field.answers.evidence import Seen, Unseen
from tab_marl.mission import Constraint, Mission

TWO_STAGES = Mission(
    (Constraint("deadline", ("central zone",), seconds=4), Constraint("deadline", ("Checkpoint A",), seconds=8))
)


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    from tab_marl.world.scenario import Scenario

    mission = Mission((Constraint("deadline", ("Checkpoint C",), seconds=8),))
    options = FieldOptions(reference="walk", cell_metres=0.25)
    return solve(FieldProblem.from_mission(mission, Scenario.preset("open"), options, horizon_ticks=20))


def test_picture_has_panels_paths_and_stage_times(field, tmp_path):
    figure = field.plot(tmp_path / "field.png", panels=4)
    maps, times = figure.subfigs
    titles = [axis.get_title() for axis in maps.axes]
    assert titles[0].startswith("0 s, complete 0%") and "likeliest" in titles[4]
    assert len(maps.axes[4].lines) == 41
    steps = times.axes[0].lines[0].get_ydata()
    np.testing.assert_allclose(steps, field.stage_times["mission"])
    assert Image.open(tmp_path / "field.png").size[0] > 1000
    with pytest.raises(ValueError, match="panels is 1"):
        field.plot(panels=1)


def test_posterior_picture_has_both_rows(field, tmp_path):
    posterior = field.condition(Seen(10, (2.1, 0.9)), Unseen(4))
    figure = draw_posterior(posterior, tmp_path / "posterior.png", panels=3)
    assert [axis.get_title().split(",")[0] for axis in figure.axes] == ["filtered"] * 3 + ["smoothed"] * 3
    shown = figure.axes[4].images[0].get_array()
    grid = field.problem.grid
    tick = round(float(figure.axes[4].get_title().split()[1]) / 0.5)
    np.testing.assert_allclose(shown, np.sqrt(grid.image(posterior.occupancy[tick], blocked=0.0)))


def test_films(field, tmp_path):
    count = field.animate(tmp_path / "field.gif")
    with Image.open(tmp_path / "field.gif") as film:
        assert film.n_frames == count > 10
    if ffmpeg_program() is not None:
        assert field.animate(tmp_path / "field.mp4") == count
        assert (tmp_path / "field.mp4").stat().st_size > 5000
        with pytest.raises(FilmError, match="ffmpeg could not write it"):
            field.animate(tmp_path / "no" / "folder.mp4")
    with pytest.raises(FilmError, match=r"end the name in \.gif or \.mp4"):
        field.animate(tmp_path / "field.avi")
    with pytest.raises(FilmError, match="frames_per_second is 0"):
        field.animate(tmp_path / "field.gif", 0)


def test_mp4_without_ffmpeg_says_what_to_do(field, tmp_path, monkeypatch):
    from tab_marl.field.answers import animation

    monkeypatch.setattr(animation, "ffmpeg_program", lambda: None)
    with pytest.raises(FilmError, match=r"needs the program ffmpeg.*write a \.gif"):
        field.animate(tmp_path / "field.mp4")


def test_fields_without_a_planar_map_cannot_be_drawn(field):
    p = field.problem
    bare = solve(FieldProblem(p.reference, p.labels, p.automaton, p.start, p.horizon, p.options))
    for draw in (bare.plot, lambda: bare.animate("x.gif")):
        with pytest.raises(ValueError, match="no planar map"):
            draw()


def test_field_command_writes_what_it_is_asked_for(tmp_path):
    from tab_marl.evaluation.field_command import FieldRequest, show_field

    asked = FieldRequest(
        "Reach Checkpoint A within 5s", "open", "paper", tmp_path / "f.png", tmp_path / "f.gif", tmp_path / "f.npz",
        tmp_path / "f.json", completes=0.9, passes=("Checkpoint D=0.2",),
    )  # fmt: skip
    said = show_field(asked)
    assert "start        moved to (" in said and "--start scenario refuses" in said
    answers = json.loads((tmp_path / "f.json").read_text())
    assert answers["completes"] == pytest.approx(0.9, abs=1e-3)
    assert answers["passes_before_completing"]["Checkpoint D"] == pytest.approx(0.2, abs=1e-3)
    assert sum(answers["stage_completed_at_tick"]["mission"]) == pytest.approx(0.9, abs=1e-3)
    x, y = answers["start_metres"]
    assert np.hypot(x - 0.5, y - 2.5) <= 0.18 + 5 * 0.22  # from where 5 s suffice
    field = TabField.load(tmp_path / "f.npz")
    assert field.kl_to_reference == pytest.approx(answers["kl_to_reference_nats"], abs=1e-9)
    np.testing.assert_allclose(field.completion_probability, answers["completed_by_tick"], atol=1e-12)
    table = FieldRequest(
        "Reach Checkpoint A within 16s", "open", "paper", tmp_path / "g.png", answers=tmp_path / "g.csv"
    )
    assert "moved" not in show_field(table)
    rows = (tmp_path / "g.csv").read_text().splitlines()
    assert rows[0] == "tick,seconds,completed,mission at this tick" and len(rows) == 122
