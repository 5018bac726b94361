"""Rows as a table with the columns that everything here computes from, and the statistics of such tables.

`frame` takes episode rows of a store as well as the CSV or Parquet that `tab-marl` exports, read with pandas.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace

import numpy as np
import pandas as pd

from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.rows import EpisodeRow
from tab_marl.evaluation.settings import FAMILIES, HEADLINE, MISSIONS, OWN_PLANNERS, PLANNERS, REFERENCE_PLANNERS
from tab_marl.evaluation.statistics.aggregates import (
    aggregate,
    performance_profile,
    probability_of_improvement,
)
from tab_marl.evaluation.statistics.intervals import SEED, Floats, bootstrap_mean, share
from tab_marl.evaluation.statistics.paired import Paired, holm, paired_shares, paired_steps
from tab_marl.evaluation.statistics.survival import Curve, cumulative_incidence, mean_curve, restricted_mean

ALL = "all"
"""In place of a mission: the mean over the missions, each with equal weight."""
STEPS_PER_SECOND = 100
SLACK_EDGES = (1.3, 1.6, 2.0)
"""Bounds between the bins of slack."""
COMPLETED, MET, FAILED = 1, 2, 3
"""Causes that end the race between completion and interception (column `first_cause`)."""
METRICS = ("ATCR", "StI")
NEEDED = ("mission", "family", "planner", "seed", "intercepted", "completed", "physics_steps", "horizon_steps")
CURVE_POINTS = 121

Key = tuple[str, str, str]
"""(family, mission, planner)."""


def frame(rows: pd.DataFrame | Sequence[EpisodeRow], styles: Mapping[str, str] | None = None) -> pd.DataFrame:
    """The rows with what is scored: `lost` (1 where the mission counts as completed), `sti` (censored steps), `score`
    (1 - sti / horizon), `first_steps` and `first_cause` (what ended the race: COMPLETED, MET, FAILED or 0), `slack_bin`,
    `style` (by `styles`: adversary -> style). An episode that broke down counts as its planner's worst case. Raises
    UserError for a table that lacks a column."""
    table = rows.copy() if isinstance(rows, pd.DataFrame) else pd.DataFrame([asdict(row) for row in rows])
    if not len(table):
        table = pd.DataFrame({name: pd.Series(dtype=object) for name in (*NEEDED, "error")})
    missing = [name for name in NEEDED if name not in table]
    if missing:
        raise UserError(f"the rows lack the column {missing[0]!r}: a table of episodes has {', '.join(NEEDED)}")
    for name, otherwise in (("error", None), ("completed_step", np.nan), ("slack", np.nan), ("adversary", ""), ("failed", False), ("ego_first", False)):  # fmt: skip
        if name not in table:
            table[name] = otherwise
    for name in ("mission", "family", "planner", "adversary"):
        table[name] = table[name].astype(object)  # plain texts: grouping by them is what happens most
    broken = table["error"].notna() & (table["error"].astype(str) != "")
    for name in ("intercepted", "completed", "failed", "ego_first"):
        table[name] = table[name].astype(bool)
    horizon = pd.to_numeric(table["horizon_steps"]).astype(float)
    # An episode that broke down before its task was drawn has no horizon: take the longest of its kind.
    longest = horizon.groupby([table["mission"], table["family"]]).transform("max") if len(table) else horizon
    horizon = horizon.where(horizon > 0, longest).clip(lower=1)
    steps = pd.to_numeric(table["physics_steps"]).astype(float)
    done = pd.to_numeric(table["completed_step"]).astype(float).fillna(horizon)
    table["broken"], table["horizon"] = broken, horizon
    table["lost"] = (table["completed"] | broken).astype(float)
    table["met"] = (table["intercepted"] & ~broken).astype(float)
    table["sti"] = steps.where(table["met"] == 1, horizon)
    table["score"] = 1 - table["sti"] / horizon
    table["first_steps"] = np.where(broken, horizon, np.where(table["completed"], done, table["sti"]))
    table["first_cause"] = np.select(
        [table["lost"] == 1, table["met"] == 1, table["failed"]], [COMPLETED, MET, FAILED], 0
    )
    table["slack_bin"] = [slack_bin(float(s)) for s in pd.to_numeric(table["slack"])]
    if styles is not None:
        table["style"] = table["adversary"].map(dict(styles))
    return table


def slack_bin(slack: float) -> str | None:
    """Text of the bin a slack falls in; None without a slack."""
    if not np.isfinite(slack):
        return None
    edges = (1.0, *SLACK_EDGES)
    for low, high in zip(edges, SLACK_EDGES, strict=False):
        if slack < high:
            return f"{low:g} to {high:g}"
    return f"{edges[-1]:g} or more"


def order(names: Sequence[str] | set[str] | pd.Series, known: Sequence[str]) -> list[str]:
    """Each once, in the order of `known`, strangers last by name."""
    once = names.unique() if isinstance(names, pd.Series) else set(names)
    return sorted(once, key=lambda n: (known.index(n) if n in known else len(known), n))


def cells(table: pd.DataFrame) -> Iterator[tuple[str, str, dict[str, pd.DataFrame]]]:
    """(family, mission, planner -> its rows): each mission, then ALL where a family has several."""
    for family in order(table["family"], FAMILIES):
        part = table[table["family"] == family]
        missions = order(part["mission"], MISSIONS)
        by_planner = {p: g for p, g in part.groupby("planner", sort=False)}
        for mission in missions + ([ALL] if len(missions) > 1 else []):
            found = {
                p: (g if mission == ALL else g[g["mission"] == mission])
                for p in order(part["planner"], PLANNERS)
                if len(g := by_planner[p])
            }
            yield family, mission, {p: g.sort_values(["mission", "seed"]) for p, g in found.items() if len(g)}


def paired(table: pd.DataFrame, baseline: str = HEADLINE, seed: int = SEED) -> dict[tuple[str, str, str, str], Paired]:
    """(family, mission, planner, metric) -> the planner minus the baseline over the episodes both played.

    Corrected with Holm: within a family of scenarios and a metric, the comparisons of all missions and rivals are made
    together; so are those of the lines over all missions; reference planners, which do not compete, form groups apart, and
    so do planners beyond the paper's.
    """
    found: dict[tuple[str, str, str, str], Paired] = {}
    for family, mission, parts in cells(table):
        if baseline not in parts:
            continue
        columns = ["mission", "seed", "lost", "sti"]
        for planner, part in parts.items():
            if planner == baseline:
                continue
            both = part[columns].merge(parts[baseline][columns], on=["mission", "seed"], suffixes=("", "_base"))
            if len(both):
                where = both["mission"].tolist()
                found[family, mission, planner, "ATCR"] = paired_shares(both["lost"], both["lost_base"], where, seed)
                found[family, mission, planner, "StI"] = paired_steps(both["sti"], both["sti_base"], where, seed)
    groups: dict[tuple[str, str, bool, tuple[str, ...]], dict[object, float]] = {}
    for (family, mission, planner, metric), one in found.items():
        apart = next((kind for kind in (OWN_PLANNERS, REFERENCE_PLANNERS) if planner in kind), ())
        group = (family, metric, mission == ALL, apart)
        groups.setdefault(group, {})[family, mission, planner, metric] = one.p_value
    for together in groups.values():
        for key, p in holm(together).items():
            found[key] = replace(found[key], adjusted=p, comparisons=len(together))  # type: ignore[index]
    return found


def paired_differences(table: pd.DataFrame, baseline: str = HEADLINE, seed: int = SEED) -> pd.DataFrame:
    """As `paired`, as a table: a row per family, mission, planner and metric."""
    return pd.DataFrame(
        [
            {"family": f, "mission": m, "planner": p, "metric": metric, "pairs": one.pairs, "difference": one.difference.value, "low": one.difference.low, "high": one.difference.high, "p": one.p_value, "p_holm": one.adjusted, "comparisons": one.comparisons, "verdict": one.verdict}
            for (f, m, p, metric), one in paired(table, baseline, seed).items()
        ]
    )  # fmt: skip


def scores_by_mission(table: pd.DataFrame, family: str, planner: str) -> list[Floats]:
    """Scores of each mission that this family's rows hold."""
    part = table[(table["family"] == family) & (table["planner"] == planner)]
    return [part.loc[part["mission"] == m, "score"].to_numpy() for m in order(part["mission"], MISSIONS)]


def aggregates(table: pd.DataFrame, baseline: str = HEADLINE, seed: int = SEED) -> pd.DataFrame:
    """Per family and planner: interquartile mean of the score with interval, and the probability that the baseline's
    episode scores higher than one of the planner's (rliable's probability of improvement; nan for the baseline)."""
    found = []
    for family in order(table["family"], FAMILIES):
        base = scores_by_mission(table, family, baseline)
        for planner in order(table.loc[table["family"] == family, "planner"], PLANNERS):
            scores = scores_by_mission(table, family, planner)
            middle = aggregate(scores, seed=seed)
            comparable = planner != baseline and len(base) == len(scores)
            better = probability_of_improvement(base, scores) if comparable else np.nan
            found.append({"family": family, "planner": planner, "episodes": middle.count, "iqm": middle.value, "low": middle.low, "high": middle.high, "improvement": better})  # fmt: skip
    return pd.DataFrame(found)


def performance_profiles(table: pd.DataFrame, points: int = 101, seed: int = SEED) -> pd.DataFrame:
    """Per family and planner: the share of episodes that score above each of `points` thresholds from 0 to 1."""
    tau = np.linspace(0, 1, points)
    found = []
    for family in order(table["family"], FAMILIES):
        for planner in order(table.loc[table["family"] == family, "planner"], PLANNERS):
            value, low, high = performance_profile(scores_by_mission(table, family, planner), tau, seed)
            found.append(pd.DataFrame({"family": family, "planner": planner, "threshold": tau, "value": value, "low": low, "high": high}))  # fmt: skip
    return pd.concat(found, ignore_index=True)


def survival_curves(table: pd.DataFrame, event: str = "completed") -> dict[Key, Curve]:
    """(family, mission, planner) -> the share of episodes over seconds in which the mission was "completed" before
    interception (failure and interception competing), or in which the adversary was "met" (censored at the horizon).

    ALL is the mean of the missions' curves over time in percent of each episode's own horizon.
    """
    if event not in ("completed", "met"):
        raise ValueError(f"event is {event!r}, must be 'completed' or 'met'")
    found: dict[Key, Curve] = {}
    for family, mission, parts in cells(table):
        for planner, part in parts.items():
            steps, cause = ("first_steps", "first_cause") if event == "completed" else ("sti", "met")
            if mission == ALL:
                several = [
                    cumulative_incidence(100 * one[steps] / one["horizon"], one[cause])
                    for _, one in part.groupby("mission")
                ]
                found[family, mission, planner] = mean_curve(several, np.linspace(0, 100, CURVE_POINTS))
            else:
                found[family, mission, planner] = cumulative_incidence(part[steps] / STEPS_PER_SECOND, part[cause])
    return found


def restricted_means(table: pd.DataFrame, met: Mapping[Key, Curve] | None = None) -> pd.DataFrame:
    """Per family, mission and planner: mean seconds to interception, counted up to the mission's median horizon.

    `met`: the curves of `survival_curves`, where they are there already.
    """
    found = []
    for (family, mission, planner), curve in (met or survival_curves(table, "met")).items():
        if mission == ALL:
            continue
        kind = table[(table["family"] == family) & (table["mission"] == mission)]
        until = float(np.median(kind["horizon"])) / STEPS_PER_SECOND
        mean, error = restricted_mean(curve, until)
        found.append({"family": family, "mission": mission, "planner": planner, "until_seconds": until, "mean_seconds": mean, "low": max(mean - 1.96 * error, 0.0), "high": min(mean + 1.96 * error, until)})  # fmt: skip
    return pd.DataFrame(found)


def breakdown(table: pd.DataFrame, by: str | Sequence[str], seed: int = SEED) -> pd.DataFrame:
    """ATCR and StI with intervals per family, part and planner, each episode with equal weight; rows without a part
    are left out.

    `by`: one column or several ("adversary", "slack_bin", "style", "mission", "split", ...).
    """
    columns = [by] if isinstance(by, str) else list(by)
    missing = [c for c in columns if c not in table]
    if missing:
        raise UserError(f"the rows have no column {missing[0]!r} to break down by")
    found = []
    kept = table.dropna(subset=columns)
    for key, part in kept.groupby(["family", *columns, "planner"], sort=True):
        family, *values, planner = (key if isinstance(key, tuple) else (key,))  # fmt: skip
        lost, sti = share(part["lost"], seed=seed), bootstrap_mean(part["sti"], seed=seed)
        found.append({"family": family, "part": ", ".join(str(v) for v in values), "planner": planner, "episodes": len(part), "atcr": lost.value, "atcr_low": lost.low, "atcr_high": lost.high, "exact": lost.exact, "sti": sti.value, "sti_low": sti.low, "sti_high": sti.high})  # fmt: skip
    return pd.DataFrame(found)
