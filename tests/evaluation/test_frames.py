"""Statistics of tables of rows: from the store and from an exported file alike, worked out by hand."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tab_marl.evaluation import statistics
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.statistics import frames

PUBLISHED = Path(__file__).parents[2] / "docs" / "results" / "episodes.csv.xz"


@pytest.fixture
def rows(synthetic):
    """Ten episodes of three planners: S lets the first six through, TAB one, the oracle none."""
    found = []
    for planner, lost in (("S-POMCP", 6), ("TAB-POMCP", 1), ("oracle", 0)):
        for seed in range(10):
            found.append(
                synthetic.row(planner, seed, intercepted=seed >= lost, completed=seed < lost, steps=100 * seed)
            )
    return found


def test_scores_by_hand(rows, synthetic):
    broken = synthetic.row("TAB-POMCP", 10, intercepted=False, error="boom")
    unborn = synthetic.row("TAB-POMCP", 11, intercepted=False, error="no task")
    unborn = type(unborn)(**{**vars(unborn), "horizon_steps": 0, "physics_steps": 0})
    table = statistics.frame([*rows, broken, unborn], styles={"policy-0": "direct"})
    last = table.iloc[-2:]
    assert last["lost"].tolist() == [1, 1] and last["sti"].tolist() == [6000, 6000] and last["score"].tolist() == [0, 0]
    assert last["first_cause"].tolist() == [frames.COMPLETED] * 2
    first = table.iloc[0]  # completed at 1200, never met
    assert (first["first_steps"], first["first_cause"], first["sti"]) == (1200, frames.COMPLETED, 6000)
    assert table.iloc[7]["first_cause"] == frames.MET and table.iloc[7]["score"] == pytest.approx(1 - 700 / 6000)
    assert table["style"].notna().sum() == sum(r.adversary == "policy-0" for r in [*rows, broken, unborn])


def test_paired_differences_are_corrected_within_their_family(rows):
    found = statistics.paired_differences(statistics.frame(rows)).set_index(["planner", "metric"])
    s = found.loc["S-POMCP", "ATCR"]
    assert s["difference"] == pytest.approx(0.5) and s["p"] == pytest.approx(2 / 2**5) == s["p_holm"]
    assert s["comparisons"] == 1  # the oracle does not compete
    ours = [type(r)(**{**vars(r), "planner": "TAB-POMCP+precedents"}) for r in rows if r.planner == "S-POMCP"]
    found = statistics.paired_differences(statistics.frame([*rows, *ours])).set_index(["planner", "metric"])
    assert found.loc["S-POMCP", "ATCR"]["comparisons"] == 1, (
        "a planner of ours makes the paper's comparisons no stricter"
    )
    assert found.loc["TAB-POMCP+precedents", "ATCR"]["p_holm"] == found.loc["S-POMCP", "ATCR"]["p_holm"]
    more = [type(r)(**{**vars(r), "mission": m}) for r in rows for m in ("M1", "M2", "M3")]
    found = statistics.paired_differences(statistics.frame(more)).set_index(["planner", "mission", "metric"])
    assert found.loc["S-POMCP", "M2", "ATCR"]["comparisons"] == 3
    assert found.loc["S-POMCP", "M2", "ATCR"]["p_holm"] == pytest.approx(3 * 2 / 2**5)
    assert found.loc["S-POMCP", "all", "ATCR"]["comparisons"] == 1


def test_exported_rows_serve_as_well():
    table = statistics.frame(pd.read_csv(PUBLISHED))
    curves = statistics.survival_curves(table, "completed")
    line = table[(table["family"] == "point") & (table["mission"] == "M1") & (table["planner"] == "S-POMCP")]
    # Every episode of this table ends by one event or the other: the curve ends at the ATCR.
    assert curves["point", "M1", "S-POMCP"].value[-1] == pytest.approx(line["lost"].mean()) == pytest.approx(67 / 150)
    assert 0 < curves["point", "all", "S-POMCP"].value[-1] < 1
    means = statistics.restricted_means(table[table["family"] == "point"])
    best = means[means["mission"] == "M1"].set_index("planner")["mean_seconds"]
    assert best["oracle"] < best["TAB-POMCP"] < best["random"]
    parts = statistics.breakdown(table, ["mission", "slack_bin"])
    assert parts["episodes"].sum() == len(table.dropna(subset=["slack_bin"]))
    profiles = statistics.performance_profiles(table[table["family"] == "point"], 11)
    tab = profiles[profiles["planner"] == "TAB-POMCP"]
    assert np.all(np.diff(tab["value"]) <= 0) and np.all((tab["low"] <= tab["value"]) & (tab["value"] <= tab["high"]))
    ranks = statistics.aggregates(table[table["family"] == "point"]).set_index("planner")
    assert ranks.loc["oracle", "iqm"] > ranks.loc["TAB-POMCP", "iqm"] > ranks.loc["random", "iqm"]
    assert ranks.loc["random", "improvement"] > 0.8


def test_what_is_missing_is_said(rows):
    with pytest.raises(UserError, match="lack the column 'horizon_steps'"):
        statistics.frame(pd.DataFrame({"mission": ["M1"], "family": "point", "planner": "x", "seed": 0, "intercepted": 1, "completed": 0, "physics_steps": 3}))  # fmt: skip
    with pytest.raises(UserError, match="no column 'split'"):
        statistics.breakdown(statistics.frame(rows), "split")
    with pytest.raises(ValueError, match="must be 'completed' or 'met'"):
        statistics.survival_curves(statistics.frame(rows), "lost")


def test_same_rows_same_figures_in_any_order(rows):
    table = statistics.frame(rows)
    shuffled = table.sample(frac=1, random_state=0)
    pd.testing.assert_frame_equal(statistics.paired_differences(table), statistics.paired_differences(shuffled))
