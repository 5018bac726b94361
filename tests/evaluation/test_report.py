"""The page: complete, self-contained, safe against what stands in the rows, and readable without colour or script."""

import itertools
import json
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

import numpy as np
import pytest

from tab_marl.evaluation import settings
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.report import charts, explanation
from tab_marl.evaluation.report import page as report
from tab_marl.evaluation.report.page import ReportData
from tab_marl.evaluation.statistics import Interval

VOID = {"meta", "link", "input", "br", "img"}


class Outline(HTMLParser):
    """Collects what a browser would load and checks that elements nest."""

    def __init__(self):
        super().__init__()
        self.stack, self.ids, self.links, self.loads, self.text = [], [], [], [], []

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.ids += [attrs["id"]] if "id" in attrs else []
        self.links += [attrs["href"]] if tag == "a" else []
        self.loads += [attrs[k] for k in ("src", "href", "data", "srcset", "poster") if k in attrs and tag != "a"]
        if tag not in VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.stack.pop()

    def handle_endtag(self, tag):
        assert self.stack and self.stack[-1] == tag, f"</{tag}> closes {self.stack[-3:]}"
        self.stack.pop()

    def handle_data(self, data):
        self.text.append(data)


def outline(page):
    found = Outline()
    found.feed(page)
    found.close()
    assert found.stack == []
    return found


def test_page_is_whole_and_loads_nothing(page):
    found = outline(page)
    assert len(found.ids) == len(set(found.ids))
    for link in found.links:
        assert link.startswith("#") and link[1:] in found.ids, link
    assert all(load.startswith("data:") for load in found.loads)
    assert not re.search(r"https?://(?!www\.w3\.org/)", page)
    assert "default-src 'none'" in page
    text = " ".join(found.text)
    for expected in ("ATCR", "StI", "TAB-POMCP", "13.3", "545", "TAB-Field", "maximum entropy", "bootstrap", "abc123"):
        assert expected in text


def test_rows_cannot_smuggle_markup(page):
    assert "<script>alert" not in page and "<b>late" not in page
    assert "&lt;b&gt;late" in page
    embedded = re.search(r'<script type="application/json" id="replays">(.*?)</script>', page, re.DOTALL)[1]
    assert json.loads(embedded)[0]["episodes"][0]["outcome"].startswith("met </script>")


def test_a_page_of_little(synthetic):
    rows = [synthetic.row("random", 0)]
    page = report.render(ReportData(rows, {}, {}, "k"))
    outline(page)
    assert "no comparison with TAB-POMCP" in page and 'id="replays"' not in page


def test_broken_episodes_are_shown(page):
    text = " ".join(outline(page).text)
    assert "1 episodes broke down" in text and "ValueError: <script>" in text


def test_report_that_cannot_be_written(data, results, tmp_path):
    with pytest.raises(UserError, match="episodes are safe"):
        report.write_report(data, tmp_path / "missing" / "report.html", results)
    report.write_report(data, tmp_path / "report.html", results)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_every_plot_is_xml_and_keeps_inside_its_box():
    dots = [charts.Dot(p, Interval(0.2, 0.1, 0.9, 50), 13.3) for p in settings.PLANNERS]
    x = np.linspace(0, 50, 10)
    tracks = [charts.Track(p, x, x / 100 + 0.1 * i, x / 100, np.full(10, 1.2)) for i, p in enumerate(settings.PLANNERS)]
    plots = (
        charts.interval_plot(dots, 100, "u", 'a "title" & more', 100),
        charts.curve_plot(tracks, "t", "seconds", (0.0, 50.0)),
    )
    for svg in plots:
        tree = ET.fromstring(svg)
        _, _, width, height = (float(v) for v in tree.get("viewBox").split())
        for node in tree.iter():
            for name, limit in (
                ("x", width),
                ("x1", width),
                ("x2", width),
                ("cx", width),
                ("y", height),
                ("cy", height),
            ):
                if name in node.attrib:
                    assert 0 <= float(node.get(name)) <= limit, (node.tag, node.attrib)


def test_interval_is_drawn_to_scale():
    tree = ET.fromstring(
        charts.interval_plot([charts.Dot("TAB-POMCP", Interval(0.5, 0.25, 1.0, 9))], 100, "u", "t", 100)
    )
    (line,) = [n for n in tree.iter() if n.get("class") == "whisker"]
    (dot,) = [n for n in tree.iter() if n.get("class") == "mark"]
    x0, x1 = float(line.get("x1")), float(line.get("x2"))
    span = charts.WIDTH - charts.LABELS - charts.RIGHT
    assert x1 == pytest.approx(charts.LABELS + span, abs=0.1)
    assert x1 - x0 == pytest.approx(0.75 * span, abs=0.1)
    assert float(dot.get("cx")) == pytest.approx(charts.LABELS + 0.5 * span, abs=0.1)


def test_labels_are_spread():
    placed = charts.spread_labels({"a": 50, "b": 51, "c": 52, "d": 200}, 13, 0, 210)
    heights = sorted(placed.values())
    assert all(b - a >= 13 for a, b in itertools.pairwise(heights))
    assert placed["a"] < placed["b"] < placed["c"] < placed["d"] == 200


def test_planners_differ_by_shape_not_colour_alone():
    shapes = {
        re.sub(r"class=\"[^\"]*\"", "", charts.mark(p, 0, 0)) + str("hollow" in charts.mark(p, 0, 0))
        for p in settings.PLANNERS
    }
    assert len(shapes) == len(settings.PLANNERS)


def seen_by(colour, kind):
    """CIELAB of a colour as a protanope or deuteranope sees it (Machado, Oliveira and Fernandes 2009, severity 1)."""
    linear = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(linear <= 0.04045, linear / 12.92, ((linear + 0.055) / 1.055) ** 2.4)
    matrices = {
        "normal": np.eye(3),
        "protanope": [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ],
        "deuteranope": [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ],
    }
    rgb = np.clip(np.array(matrices[kind]) @ linear, 0, 1)
    to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    ratio = np.array(to_xyz) @ rgb / np.array([0.9505, 1.0, 1.089])
    f = np.where(ratio > 0.008856, np.cbrt(ratio), 7.787 * ratio + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def themes():
    css = report._template("report.css")
    return [
        dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", block)) for block in re.findall(r"\{[^{}]*--page:[^{}]*\}", css)
    ]


@pytest.mark.parametrize("kind", ["normal", "protanope", "deuteranope"])
def test_colours_differ_for_every_eye(kind):
    """Beside their marks, the four planners that compete, and what lies on a map, differ in colour (CIE 1976 difference)."""
    for theme in themes()[:2]:
        for group in (("s", "fp", "mle", "tab"), ("ego", "adversary"), ("heat", "field")):
            for first, second in itertools.combinations(group, 2):
                apart = np.linalg.norm(seen_by(theme[first], kind) - seen_by(theme[second], kind))
                assert apart > 15, (first, second, apart)


def contrast(first, second):
    def luminance(colour):
        channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        r, g, b = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels)
        return 0.2126 * r + 0.7152 * g + 0.0722 * b

    a, b = sorted((luminance(first), luminance(second)))
    return (b + 0.05) / (a + 0.05)


def test_text_has_contrast_in_light_and_dark():
    light, dark, chosen = themes()
    assert dark == chosen  # dark by preference is dark by choice
    for theme in (light, dark):
        for ink in [
            "ink",
            "soft",
            "link",
            "adversary",
            "ego",
            "goal",
            "heat",
            "camera",
            "tab",
            "s",
            "fp",
            "mle",
            "reference",
        ]:
            # WCAG AA: 4.5 for running text, 3 for graphics and large text.
            need = 3.0 if ink in ("camera",) else 4.5
            assert contrast(theme[ink], theme["card"]) >= need, ink


def test_explanation_draws_the_field():
    drawn = explanation.explanation()
    assert drawn["field"].count("<figure>") == len(explanation.MOMENTS) == drawn["walk"].count("<figure>")
    done = [int(n) for n in re.findall(r"(\d+) % done", drawn["field"])]
    assert done == sorted(done) and done[-1] > 50
    assert drawn["field"] != drawn["walk"]
