"""The published result: the rows are those of the page, and its numbers are theirs."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
import pytest

from tab_marl.evaluation import export
from tab_marl.evaluation.settings import PLANNERS, short

ROOT = Path(__file__).parent.parent.parent
FOLDER = ROOT / "docs" / "results"
SHORT = {short(p): p for p in PLANNERS} | {"**TAB**": "TAB-POMCP"}


EPISODES, PERIMETER = (pd.read_csv(FOLDER / f"{name}.csv.xz") for name in ("episodes", "perimeter"))


def table(path: Path, name: str) -> tuple[list[str], list[list[str]]]:
    """Header and lines of a generated table."""
    (block,) = re.findall(rf"<!-- begin {name} -->\n\n(.*?)\n\n<!-- end {name} -->", path.read_text(), flags=re.DOTALL)
    header, _, *lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in block.splitlines()]
    return header, lines


@pytest.mark.parametrize(("episodes", "each"), [(EPISODES, 150), (PERIMETER, 60)], ids=["episodes", "perimeter"])
def test_the_checksum_on_the_page_is_that_of_the_rows(episodes: pd.DataFrame, each: int) -> None:
    page = (FOLDER / "README.md").read_text()
    assert f"`{export.checksum(episodes)}`" in page and f"| rows | {len(episodes)} |" in page
    assert episodes["error"].isna().all(), "a broken episode would have to be explained on the page"
    assert (episodes.groupby(["mission", "family", "planner"]).size() == each).all()


@pytest.mark.parametrize(
    ("episodes", "path", "name"),
    [
        (EPISODES, FOLDER / "README.md", "summary"),
        (EPISODES, ROOT / "README.md", "summary"),
        (PERIMETER, FOLDER / "README.md", "control-summary"),
    ],
    ids=["page", "readme", "perimeter"],
)
def test_the_short_table_is_of_the_rows(episodes: pd.DataFrame, path: Path, name: str) -> None:
    header, lines = table(path, name)
    shares = episodes.groupby(["family", "planner", "mission"])[["scored_completed", "scored_steps"]].mean()
    assert len(lines) == 2 * episodes["family"].nunique()
    for line, *cells in lines:
        family, measure = re.findall(r"`(\w+)`, (\w+)", line)[0]
        for planner, cell in zip(header[1:], cells, strict=True):
            of_missions = shares.loc[family, SHORT.get(planner, planner)]
            value = of_missions["scored_completed"] * 100 if measure == "ATCR" else of_missions["scored_steps"]
            assert float(cell.split()[0]) == pytest.approx(value.mean(), abs=0.06 if measure == "ATCR" else 0.6)


@pytest.mark.parametrize(("episodes", "name"), [(EPISODES, "ceiling"), (PERIMETER, "control-ceiling")])
def test_the_table_of_the_ceiling_is_of_the_rows(episodes: pd.DataFrame, name: str) -> None:
    """TAB-POMCP less population-POMCP, per mission and over all, in points and steps."""
    header, lines = table(FOLDER / "README.md", name)
    assert len(lines) == 6 * episodes["family"].nunique()
    means = episodes.groupby(["family", "mission", "planner"])[["scored_completed", "scored_steps"]].mean()
    for family, mission, *cells in lines:
        part = means.loc[family.strip("`")]
        of_mission = part.groupby("planner").mean() if mission == "all" else part.loc[mission]
        for said, cell in zip(header[2:], cells, strict=True):
            measure, planner = said.split(", ")
            column = of_mission["scored_completed"] * 100 if measure == "ATCR" else of_mission["scored_steps"]
            difference = column[SHORT.get(planner, planner)] - column["population-POMCP"]
            assert float(cell.split()[0]) == pytest.approx(difference, abs=0.06 if measure == "ATCR" else 0.6)
