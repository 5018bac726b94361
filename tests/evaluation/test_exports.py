"""What is written beside the page: tables for papers, figures, films; and the command that asks for them."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from tab_marl.cli import app
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.report import episode_film, exports, plots, present
from tab_marl.evaluation.report.exports import Table
from tab_marl.evaluation.report.present import Wanted
from tab_marl.evaluation.settings import PLANNERS, settings_key
from tab_marl.evaluation.store import Store


def test_markdown_reads_back_as_the_table(results):
    (table,) = [t for t in exports.all_tables(results) if t.name == "results-point"]
    lines = exports.markdown(table).splitlines()
    header, rule, *body = [
        [c.strip(" *") for c in line.strip("|").split("|")] for line in lines if line.startswith("|")
    ]
    assert header == list(table.header) and all(re.fullmatch("-+:?", c) for c in rule)
    assert [tuple(row) for row in body] == list(table.rows)
    tab = next(x for x in results.lines if (x.family, x.mission, x.planner) == ("point", "M5", "TAB-POMCP"))
    (row,) = [r for r in table.rows if r[:2] == ("M5", "TAB-POMCP")]
    assert row[3].startswith(f"{100 * tab.atcr.value:.1f} [") and row[4].startswith(f"{tab.steps.value:.0f} [")


def test_latex_is_whole(results):
    tables = exports.all_tables(results)
    assert {t.name for t in tables} >= {"results-point", "aggregates-ambiguous", "beside-the-paper", "adversary-point", "slack-point", "decision-times"}  # fmt: skip
    for table in tables:
        text = exports.latex(table)
        assert text.count("{") == text.count("}")
        for command in ("\\toprule", "\\bottomrule", "\\begin{tabular}", "\\end{tabular}", "\\caption", "\\label"):
            assert text.count(command) == 1
        body = text.split("\\toprule\n")[1].split("\\bottomrule")[0]
        for line in body.splitlines():
            if line != "\\midrule":
                assert line.endswith(" \\\\")
                assert len(re.findall(r"(?<!\\)&", line)) == len(table.header) - 1
                assert not re.search(r"(?<!\\)[%#_]", line) and line.count("$") % 2 == 0
        assert not re.search(r"[^\x00-\x7f]", text), "plain LaTeX knows ASCII"


def test_latex_escapes():
    assert exports.escape_latex("50 % & a_b {-3} 1-2 -4 † < .001") == (
        r"50 \% \& a\_b \{$-$3\} 1-2 $-$4 $^\dagger$ $<$ .001"
    )
    text = exports.latex(Table("n", "c", ("a", "b"), (("x", "[1]"),)))
    assert "x & {}[1] \\\\" in text


def test_the_papers_figures_stand_beside_ours(results):
    (table,) = [t for t in exports.all_tables(results) if t.name == "beside-the-paper"]
    assert table.rows[-2][1:] == ("paper", "95.6", "88.9", "80.2", "30.9", "2312", "1871", "1533", "545")
    assert table.rows[-1][1:6] == ("paper, underwater", "97.2", "91.5", "85.6", "43.4")


def test_figures_are_drawn_in_every_kind_and_again_the_same(results, tmp_path, monkeypatch):
    part = type(results)(**{**vars(results), "lines": [x for x in results.lines if x.family == "point"]})
    written = plots.export_figures(part, tmp_path, ("svg", "pdf", "png"))
    assert {p.stem for p in written} == {"measures-point", "over-time-point", "profile-point", "adversaries-point"}
    for path in written:
        head = path.read_bytes()[:8]
        if path.suffix == ".svg":
            text = " ".join(ET.parse(path).getroot().itertext())
            assert "TAB" in text  # words stay words
        else:
            assert head.startswith(b"%PDF-" if path.suffix == ".pdf" else b"\x89PNG")
    (first,) = [p for p in written if p.name == "profile-point.svg"]
    before = first.read_bytes()
    profile = plots.figures(part)["profile-point"]
    monkeypatch.setattr(plots, "figures", lambda _: {"profile-point": profile})
    plots.export_figures(part, tmp_path, ("svg",))
    assert first.read_bytes() == before


def test_the_figures_numbers_are_the_tables(results):
    figure = plots._measures(results, "point")
    atcr = figure.axes[0]
    for container, planner in zip(atcr.containers, PLANNERS, strict=True):
        drawn = container.lines[0].get_ydata()
        lines = [x for x in results.lines if x.family == "point" and x.planner == planner]
        assert drawn == pytest.approx([100 * x.atcr.value for x in lines])


def test_film_shows_robots_belief_and_field(data, tmp_path):
    group = data.replays[0]
    frames = list(episode_film.film_frames(group))
    assert len(frames) == 20 and len({f.shape for f in frames}) == 1
    width = episode_film.PANEL_PIXELS
    scale = width / group["map"]["width"]

    def pixel(frame, x, y):
        row = episode_film.CAPTION + 4 + round(group["map"]["height"] * scale - y * scale)
        return frame[row, episode_film.GAP + round(x * scale)].astype(int)

    # The ego drives right along y = 1, the adversary (seen from step 6 on, and then filled) down along x = 2.
    assert np.abs(pixel(frames[0], 0.5, 1.0) - episode_film.COLOURS["ego"]).max() < 40
    assert np.abs(pixel(frames[-1], 1.45, 1.0) - episode_film.COLOURS["ego"]).max() < 40
    assert np.abs(pixel(frames[-1], 2.0, 1.05) - episode_film.COLOURS["adversary"]).max() < 40
    assert np.abs(pixel(frames[0], 2.0, 2.0) - episode_film.COLOURS["adversary"]).max() > 80
    without = list(episode_film.film_frames({**group, "field": None}))
    assert np.mean(frames[10] != without[10]) > 0.002
    trace = group["episodes"][0]["trace"]
    assert episode_film._state(trace, 1.0)[0] == "a camera sees the adversary"
    assert episode_film._state(trace, 1.6) == ("intercepted at 1.5 s", "goal")
    (path,) = episode_film.export_films([group], tmp_path, ("gif",))
    assert path.name == "M1-point-episode-0.gif" and path.stat().st_size > 1000


def test_bad_requests_are_refused_before_any_work(tmp_path):
    with pytest.raises(UserError, match="no kind of tables named 'txt': did you mean 'tex'"):
        Wanted(tables=("txt",))
    with pytest.raises(UserError, match="no kind of figures named 'jpg'"):
        Wanted(figures=("jpg",))
    assert Wanted(films=("GIF",)).films == ("gif",)
    (tmp_path / "films").write_text("in the way")
    with pytest.raises(UserError, match="cannot be written"):
        episode_film.check_kind(tmp_path / "films", "gif")


def test_what_cannot_be_written_is_said(results, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match="the table cannot be written"):
        exports.export_tables(results, tmp_path / "file", ("md",))
    with pytest.raises(UserError, match="the figure cannot be written"):
        plots.export_figures(results, tmp_path / "file", ("svg",))


@pytest.fixture
def folder(data, tmp_path):
    """A store that holds the page's rows, ready for `tab-marl report`."""
    content = {"seed": 1, "slack": None, "planner_preset": "default", "adversaries": ["gone"], "code": "x"}
    key = settings_key(content)
    with Store.create(tmp_path) as store:
        store.use(key, content, {"replays": 0})
        store.add(
            key,
            [(row, data.timings[row.key]) for row in data.rows if row.key in data.timings and row.family == "point"],
        )
    return tmp_path


def test_the_command_writes_what_it_is_asked_for(folder, monkeypatch):
    from tab_marl.evaluation.report import explanation

    monkeypatch.setattr(explanation, "explanation", lambda: {"map": "<svg></svg>", "map_text": ""})
    done = CliRunner().invoke(app, ["report", "--out", str(folder), "--tables", "md,tex", "--figures", "pdf"])
    assert done.exit_code == 0, done.output
    assert "no network" not in done.output and f"report: {folder / 'report.html'}" in done.output.replace("\n", "")
    assert len(list((folder / "tables").glob("*.md"))) == len(list((folder / "tables").glob("*.tex"))) >= 4
    assert len(list((folder / "figures").glob("*.pdf"))) == 4
    done = CliRunner().invoke(app, ["report", "--out", str(folder), "--films", "gif"])
    assert isinstance(done.exception, UserError) and "there are none: ask for --replays" in str(done.exception)


def test_the_runs_are_described(folder):
    with Store.open(folder) as store:
        (settings,) = store.settings()
        for _ in range(5):
            store.end_run(store.begin_run(settings.key, {"versions": {"numpy": "2.4"}, "machine": {"processor": "p", "cores": 2}}), "finished")  # fmt: skip
        record = present.record_of(store, settings.key)
    assert record["runs"] == "5 on this store; the latest 3 are described"
    assert [k for k in record if k.startswith("run ")] == ["run 3", "run 4", "run 5"]
    assert "numpy 2.4" in record["run 5"]["versions"]
    assert present.describe_adversaries(["no such policy"]) == []


def test_twenty_thousand_rows_are_quick_and_small(synthetic, data):
    """The report of 20,000 rows: under a minute, under ten megabytes with replays of M5's length."""
    import time

    from tab_marl.evaluation.report.page import ReportData, render

    rng = np.random.default_rng(0)
    planners = PLANNERS[:6]
    count = 222
    tables = []
    for mission in ("M1", "M2", "M3", "M4", "M5"):
        for family in ("point", "perimeter", "ambiguous"):
            luck = rng.random(count)
            for k, planner in enumerate(planners):
                steps = np.minimum(200 + 4000 * luck * rng.random(count) * (1.5 - 0.1 * k), 6000).round()
                met = steps < 3500
                tables.append(
                    pd.DataFrame(
                        {"mission": mission, "family": family, "planner": planner, "seed": np.arange(count), "adversary": [f"p{s % 12}" for s in range(count)], "slack": 1.2 + luck, "intercepted": met, "completed": steps > 3000, "failed": False, "physics_steps": np.where(met, steps, 6000), "horizon_steps": 6000, "completed_step": np.where(steps > 3000, 3000.0, np.nan), "ego_first": luck < 0.3, "fallbacks": 0, "error": None}
                    )
                )  # fmt: skip
    rows = pd.concat(tables, ignore_index=True)
    assert len(rows) == 19980
    began = time.process_time()
    page = render(ReportData(rows, {}, {"seed": 1}, "k"))
    assert time.process_time() - began < 60
    assert len(page) < 4_000_000
