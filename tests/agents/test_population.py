"""Populations: the file, its errors, members in processes that are killed or fail, and the page."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import re
import signal
import tomllib
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from rich.console import Console
from safetensors.numpy import load_file

from tab_marl.agents.policies.zoo import WEIGHTS_FILE, export_policy
from tab_marl.agents.population.members import FOLDER, Population
from tab_marl.agents.population.report import PAGE_FILE, PICTURE_FILE, Line, curve_svg, write_report
from tab_marl.agents.population.run import (
    DONE,
    ERROR_FILE,
    FAILED,
    TRAINING,
    WAITING,
    MemberStand,
    _work,
    expected_seconds,
    finished,
    seconds_left,
    stand_of,
    train_population,
)
from tab_marl.agents.training.algorithms import ALGORITHMS
from tab_marl.agents.training.log import LearningCurve, read_log
from tab_marl.agents.training.settings import TrainingError, TrainingSettings
from tab_marl.agents.training.train import train
from tab_marl.envs.styles import STYLES, Style
from tab_marl.evaluation.train_command import clock, train_many

TINY = """
[defaults]
missions = ["M1"]
families = ["point"]
tasks = 2
robots = 8
layers = [16]
algorithm = "a2c"
steps = 800
checkpoint_seconds = 1e-6
hyperparameters = { n_steps = 10, gamma = 0.99 }
"""


def written(tmp_path, text):
    path = tmp_path / "population.toml"
    path.write_text(text)
    return path


def test_members_take_the_defaults_and_their_own(tmp_path):
    path = written(
        tmp_path,
        TINY
        + """
[[member]]
style = "side"
hyperparameters = { gamma = 0.9 }

[[member]]
style = ["late", { name = "keen", camera_shy = 2.0 }]
split = "final"

[[member]]
name = "shy"
style = { name = "shy", camera_shy = 2.0 }
seeds = [3, 5]
""",
    )
    population = Population.load(path)
    assert [m.name for m in population.members] == ["side", "late-keen", "shy-3", "shy-5"]
    side, mixed, three, five = population.members
    assert (
        side.style == STYLES["side"] and side.hyperparameters["gamma"] == 0.9 and side.hyperparameters["n_steps"] == 10
    )
    assert [habit.style for habit in mixed.style.mixture] == [STYLES["late"], Style("keen", camera_shy=2.0)]
    assert mixed.split == "final"
    assert (three.seed, five.seed) == (3, 5) and three.style.camera_shy == 2.0
    assert all(m.steps == 800 for m in population.members)
    assert population.only(["side"]).members == (side,)
    assert population.command(side) == f"tab-marl train {path} --only side"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "there are no members"),
        ("[[members]]\nstyle = 'side'", "did you mean 'member'"),
        ("[[member]]\nstyle = 'sid'", r"member 1 \(sid\): .*did you mean 'side'"),
        ("[[member]]\nstyle = 'side'\n[[member]]\nname = 'x'\nstepz = 3", r"member 2 \(x\): stepz"),
        ("[[member]]\nsteps = 'many'", "member 1: steps: .*integer"),
        ("[[member]]\nstyle = 'side'\n[[member]]\nstyle = 'side'", "policies 1 and 2 are both named 'side'"),
        ("[[member]]\nseeds = []", "seeds is .*must be a list of whole numbers"),
        ("[[member]]\nseed = 1\nseeds = [2]", "give seed or seeds, not both"),
        ("[[member]]\nstyle = ['late']", "must name two or more styles"),
        ("[[member]]\nstyle = ['late', 'latte']", "did you mean 'late'"),
        ("[[member]]\nstyle = ['late', ['side']]", "style"),
        ("[[member]]\nstyle = ['late', { name = 'x', side = 2.0 }]", "Style.side is 2.0, must be a probability"),
        ("[[member]]\nstyle = ['late', { name = 'x', shy = 2.0 }]", "style: shy: "),
        ("[[member]]\nsplit = 'test'", "split"),
        ("[[member]]\nalgorithm = 'dqn'", "algorithm"),
        ("[[member]]\n[member.map]\ncheckpoints = 0", "map.*checkpoints is 0"),
        ("[[member]]\nhyperparameters = 3", "hyperparameters: .*dict"),
        ("controls = ['x']\n[[member]]\nstyle = 'side'", "controls: .*'x'"),
        ("defaults = 3\n[[member]]\nstyle = 'side'", "defaults must be a table"),
        ("[[member]", "cannot read training settings"),
    ],
)
def test_errors_name_file_member_and_field_in_one_line(tmp_path, text, said):
    path = written(tmp_path, text)
    with pytest.raises(TrainingError, match=said) as caught:
        Population.load(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_an_unknown_member_is_answered_with_the_nearest(tmp_path):
    population = Population.load(written(tmp_path, "[[member]]\nstyle = 'side'"))
    with pytest.raises(TrainingError, match="did you mean 'side'"):
        population.only(["sied"])


def test_hyperparameters_are_checked_before_anything_is_trained(tmp_path):
    path = written(tmp_path, "[[member]]\nstyle = 'side'\nhyperparameters = { learning_rat = 1.0 }")
    with pytest.raises(TrainingError, match=r"population.toml: side: PPO has no .*did you mean 'learning_rate'"):
        train_many(path, None, 1, None, tmp_path / "runs", Console())
    assert not (tmp_path / "runs").exists()


def test_the_page_shows_a_population_that_loads():
    page = (Path(__file__).parents[2] / "docs" / "adversaries" / "training.md").read_text()
    (shown,) = re.findall(r"```toml\n(.*?)```", page, flags=re.DOTALL)
    population = Population.from_mapping(tomllib.loads(shown), "page")
    population.check()
    assert [m.name for m in population.members] == ["side", "quiet-1", "quiet-2", "moody", "control-1", "control-2"]
    fields = set(
        re.findall(r"`(\w+)`", "".join(line.split("|")[1] for line in page.splitlines() if line.startswith("| `")))
    )
    known = {f.name for f in dataclasses.fields(TrainingSettings)}
    assert known - {"checkpoint_seconds"} <= fields, "every field of the settings is on the page"


def test_the_shipped_population_holds_every_style_in_both_splits_and_six_algorithms():
    population = Population.load("shipped")
    population.check()
    assert population.source == "shipped" and (FOLDER / "shipped.toml").exists()
    shipped = [m for m in population.members if m.name not in population.controls]
    assert len(shipped) >= 16 and len(population.controls) >= 2
    assert {m.algorithm for m in shipped} == set(ALGORITHMS)
    for split in ("development", "final"):
        styles = {m.style.name for m in shipped if m.split == split}
        assert {"direct", "side", "via", "camera-shy", "late", "wander", "fickle", "habits"} <= styles
    assert any(m.habits_against for m in shipped)
    assert all(m.description for m in shipped)
    controls = [m for m in population.members if m.name in population.controls]
    assert all(m.style == STYLES["direct"] for m in controls) and len({m.seed for m in controls}) == len(controls)


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Two members in processes; one is killed -9 when it first tells of training, and continued by a second call."""
    folder = tmp_path_factory.mktemp("population")
    population = Population.load(
        written(
            folder,
            TINY
            + "[[member]]\nname = 'steady'\n[[member]]\nname = 'doomed'\nseed = 5\nsteps = 8_000\ncheckpoint_seconds = 0.05\n",
        )
    )

    def kill(stand, stands):
        if stand.name == "doomed" and stand.status == TRAINING:
            for process in multiprocessing.active_children():
                if process.name == "doomed":
                    os.kill(process.pid, signal.SIGKILL)

    first = train_population(population, folder / "runs", 2, kill)
    told = []
    second = train_population(population, folder / "runs", 1, lambda stand, stands: told.append(stand))
    return population, folder / "runs", first, second, told


def test_a_killed_member_is_reported_and_does_not_stop_the_others(two):
    _, _, first, _, _ = two
    assert first["steady"].status == DONE and first["steady"].steps >= 800 and first["steady"].cpu_seconds > 0
    assert first["doomed"].status == FAILED and first["doomed"].error == "its process ended with status -9"


def test_the_same_call_continues_a_killed_member_to_the_weights_of_an_undisturbed_run(two, tmp_path):
    population, runs, _, second, told = two
    assert {s.status for s in second.values()} == {DONE}
    assert not [s for s in told if s.name == "steady" and s.status == TRAINING], "what is finished is not trained again"
    settings = population.members[1]
    rows = read_log(runs / "doomed").steps
    assert (np.diff(rows) > 0).all() and rows[-1] == settings.steps
    seldom = replace(settings, checkpoint_seconds=1e6)
    policy = export_policy(train(seldom, tmp_path), seldom, tmp_path)
    mine, theirs = load_file(policy / WEIGHTS_FILE), load_file(runs / "doomed" / "policy" / WEIGHTS_FILE)
    assert mine.keys() == theirs.keys() and all(np.array_equal(mine[name], theirs[name]) for name in mine)


def test_finished_runs_are_known_by_their_settings(two):
    population, runs, *_ = two
    steady = population.members[0]
    assert finished(steady, runs / "steady")
    assert not finished(replace(steady, seed=9), runs / "steady")
    assert not finished(replace(steady, split="final"), runs / "steady"), "its card must be written anew"
    assert not finished(steady, runs / "nowhere")
    stand = stand_of(steady, runs)
    assert stand.status == DONE and stand.steps == 800 and stand.cpu_seconds > 0
    assert stand_of(replace(steady, name="nobody"), runs).status == WAITING


def test_the_page_holds_a_learning_curve_per_policy_and_needs_nothing_else(two, tmp_path):
    population, runs, _, second, _ = two
    page = write_report(population, second, runs).read_text()
    assert (runs / PAGE_FILE).exists() and (runs / PICTURE_FILE).read_bytes().startswith(b"\x89PNG")
    assert page.count("Learning curve of") == 2 and "steady" in page and "doomed" in page
    assert not re.search(r"(src|href)=", page), "it is self-contained"
    never = {
        "ghost": MemberStand(replace(population.members[0], name="ghost"), tmp_path / "none", FAILED, error="a < b")
    }
    page = write_report(population, never, tmp_path).read_text()
    assert "a &lt; b" in page and "Learning curve of" not in page


def test_a_curve_shows_what_the_log_says():
    curve = LearningCurve(
        np.array([10.0, 20.0, 30.0]), np.array([60.0, 120.0, 180.0]), np.zeros(3), {"M1": np.array([np.nan, 0.0, 1.0])}
    )
    svg = ElementTree.fromstring(curve_svg(curve, ["M1"], "x<y"))
    points = [p.split(",") for p in svg.find("polyline").get("points").split()]
    assert len(points) == 2  # nan is left out
    (x1, y1), (x2, y2) = [(float(x), float(y)) for x, y in points]
    assert x2 > x1 and y1 > y2, "time goes right, success goes up"


class Collected(list):
    def send(self, changes):
        self.append(changes)

    def close(self):
        pass


def test_a_member_that_fails_says_why_in_one_line(tmp_path):
    settings = Population.load(written(tmp_path, TINY + "[[member]]\ninitial = 'no-such-policy'")).members[0]
    told = Collected()
    _work(settings, tmp_path / "run", "again", told)
    assert told[-1]["status"] == FAILED and "no-such-policy" in told[-1]["error"] and "\n" not in told[-1]["error"]
    assert "Traceback" in (tmp_path / "run" / ERROR_FILE).read_text()


def test_the_command_says_how_many_failed_and_returns_it(tmp_path, monkeypatch, capsys):
    path = written(tmp_path, TINY + "[[member]]\nname = 'good'\n[[member]]\nname = 'bad'\n")

    def play(population, out, workers, on_stand):
        stands = {m.name: MemberStand(m, out / m.name) for m in population.members}
        out.mkdir(parents=True)
        for status, changes in (
            ("tasks", {}),
            (TRAINING, {"steps": 400, "steps_per_second": 100.0, "success": {"M1": 0.5, "M2": float("nan")}}),
            (DONE, {"steps": 800}),
        ):
            stands["good"] = replace(stands["good"], status=status, **changes)
            on_stand(stands["good"], stands)
        stands["bad"] = replace(stands["bad"], status=FAILED, error="ValueError: no")
        on_stand(stands["bad"], stands)
        return stands

    monkeypatch.setattr("tab_marl.agents.population.run.train_population", play)
    for number, terminal in enumerate((False, True)):
        console = Console(force_terminal=terminal, width=160, highlight=False)
        assert not train_many(path, None, 2, None, tmp_path / f"out{number}", console)
        said = capsys.readouterr().out
        assert "1 of 2 policies trained" in said and "bad failed: ValueError: no" in said
        if not terminal:
            assert "good: training, 400 of 800 steps, M1 50 %; 0 of 2 ended, " in said


def test_time_left_counts_every_member_and_the_workers():
    members = [TrainingSettings(name=f"m{i}", steps=1_000_000) for i in range(4)]
    stands = {m.name: MemberStand(m, None) for m in members}
    alone, together = seconds_left(stands, 1), seconds_left(stands, 4)
    assert alone == pytest.approx(4 * expected_seconds(members[0])) and together == pytest.approx(alone / 4)
    stands["m0"] = replace(stands["m0"], status=TRAINING, steps=500_000, steps_per_second=1000.0, cpu_seconds=500.0)
    half = expected_seconds(replace(members[0], steps=500_000))
    assert seconds_left(stands, 4) == pytest.approx(max(500.0, expected_seconds(members[0]) * 500.0 / half))
    stands = {name: replace(stand, status=DONE) for name, stand in stands.items()}
    assert seconds_left(stands, 4) == 0.0


@pytest.mark.parametrize(("seconds", "said"), [(0, "0:00"), (62.4, "1:02"), (3723, "1:02:03")])
def test_a_clock_reads_well(seconds, said):
    assert clock(seconds) == said


@pytest.mark.parametrize(
    ("lowest", "minutes"),
    [([np.nan, 1.0, 0.5, 0.95, 0.9], 4.0), ([1.0] * 5, 1.0), ([0.95, 0.95, 0.95, 0.95, 0.8], np.nan)],
)
def test_competence_counts_from_where_it_lasted(lowest, minutes):
    ones = np.ones(5)
    curve = LearningCurve(ones, 60.0 * np.arange(1.0, 6.0), ones, {"M1": ones, "M2": np.array(lowest)})
    stand = MemberStand(TrainingSettings(), None)
    assert Line(stand, curve).competent_minutes == pytest.approx(minutes, nan_ok=True)
