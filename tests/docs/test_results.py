"""The published result: the rows are those of the page, and its numbers are theirs."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
import pytest

from tab_marl.evaluation import export

ROOT = Path(__file__).parent.parent.parent
FOLDER = ROOT / "docs" / "results"
SHORT = {"**TAB**": "TAB-POMCP", "S": "S-POMCP", "FP": "FP-POMCP", "MLE": "MLE-POMCP", "population": "population-POMCP"}


@pytest.fixture(scope="module")
def episodes() -> pd.DataFrame:
    return pd.read_csv(FOLDER / "episodes.csv.xz")


def test_the_checksum_on_the_page_is_that_of_the_rows(episodes: pd.DataFrame) -> None:
    page = (FOLDER / "README.md").read_text()
    assert f"`{export.checksum(episodes)}`" in page and f"| rows | {len(episodes)} |" in page
    perimeter = pd.read_csv(FOLDER / "perimeter.csv.xz")
    assert f"`{export.checksum(perimeter)}`" in page and (perimeter["family"] == "perimeter").all()
    assert episodes["error"].isna().all(), "a broken episode would have to be explained on the page"
    assert (episodes.groupby(["mission", "family", "planner"]).size() == 150).all()


@pytest.mark.parametrize("path", [FOLDER / "README.md", ROOT / "README.md"], ids=["page", "readme"])
def test_the_short_table_is_of_the_rows(episodes: pd.DataFrame, path: Path) -> None:
    (block,) = re.findall(r"<!-- begin summary -->\n\n(.*?)\n\n<!-- end summary -->", path.read_text(), flags=re.DOTALL)
    header, _, *lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in block.splitlines()]
    shares = episodes.groupby(["family", "planner", "mission"])[["scored_completed", "scored_steps"]].mean()
    assert len(lines) == 2 * episodes["family"].nunique()
    for name, *cells in lines:
        family, measure = re.findall(r"`(\w+)`, (\w+)", name)[0]
        for planner, cell in zip(header[1:], cells, strict=True):
            of_missions = shares.loc[family, SHORT.get(planner, planner)]
            value = of_missions["scored_completed"] * 100 if measure == "ATCR" else of_missions["scored_steps"]
            assert float(cell.split()[0]) == pytest.approx(value.mean(), abs=0.06 if measure == "ATCR" else 0.6)
