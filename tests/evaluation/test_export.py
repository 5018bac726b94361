"""Rows as files of other programs: everything arrives, in the same order, and what is missing is said."""

import importlib.util
import sys

import numpy as np
import pandas as pd
import pytest

from tab_marl.cli import main
from tab_marl.evaluation import export
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.rows import EpisodeRow
from tab_marl.evaluation.store import Store


@pytest.fixture
def store(tmp_path, synthetic):
    with Store.create(tmp_path / "out") as store:
        store.use("abc", {"seed": 1}, {})
        rows = [
            synthetic.row(seed=1, slack=1.234567890123),
            synthetic.row(
                "S-POMCP", 0, intercepted=False, completed=True, slack=float("nan"), error='odd, "quoted"\ntext'
            ),
        ]
        store.add("abc", [(r, synthetic.timing()) for r in rows])
        yield store


@pytest.mark.parametrize("kind", export.FORMATS)
def test_both_formats_hold_every_column(store, tmp_path, kind):
    path = tmp_path / "deep" / f"rows.{kind}"
    assert export.export(store, "abc", kind, path)[0] == 2
    back = pd.read_csv(path) if kind == "csv" else pd.read_parquet(path)
    assert list(back["planner"]) == ["S-POMCP", "TAB-POMCP"], "sorted by key"
    fields = set(EpisodeRow.__dataclass_fields__) - {"learned"}
    assert fields | {"settings", "censored", "scored_completed", "scored_steps", *export.MEASURED} == set(back.columns)
    broken, good = back.iloc[0], back.iloc[1]
    assert good["slack"] == 1.234567890123 and good["intercepted"] and pd.isna(good["error"])
    assert np.isnan(broken["slack"]) and broken["error"] == 'odd, "quoted"\ntext' and broken["completed_step"] == 1200
    assert broken["scored_steps"] == broken["horizon_steps"] and broken["scored_completed"]
    assert good["decisions"] == 120 and np.isnan(good["processor_seconds"])
    assert [p.name for p in path.parent.iterdir()] == [path.name], "no half file is left"


def test_the_same_rows_make_the_same_file(store, tmp_path):
    for name in ("a", "b"):
        export.export(store, "abc", "csv", tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_the_checksum_is_of_what_was_decided_and_can_be_had_from_the_file(store, tmp_path, synthetic):
    path = tmp_path / "rows.csv.xz"
    count, checksum = export.export(store, "abc", "csv", path)
    assert path.read_bytes()[:6] == b"\xfd7zXZ\x00" and count == 2
    back = pd.read_csv(path)
    assert export.checksum(back) == export.checksum(back.sample(frac=1.0, random_state=1)) == checksum
    slower = back.assign(seconds=1e9, decisions=1, settings="other")
    assert export.checksum(slower) == checksum
    assert export.checksum(back.assign(physics_steps=back["physics_steps"] + [0, 1])) != checksum


def test_refusals(store, tmp_path, monkeypatch):
    with pytest.raises(UserError, match="must be one of csv, parquet"):
        export.export(store, "abc", "xlsx", tmp_path / "x")
    with pytest.raises(UserError, match="no episode is stored under settings zzz"):
        export.export(store, "zzz", "csv", tmp_path / "x")
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        export.export(store, "abc", "csv", tmp_path / "file" / "x.csv")
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "pyarrow" else found(name, *a))
    with pytest.raises(UserError, match=r"pip install 'tab-marl\[parquet\]', or choose --format csv"):
        export.export(store, "abc", "parquet", tmp_path / "x")


def test_command(store, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["tab-marl", "export", "--out", str(store.path.parent), "--settings", "ab"])
    with pytest.raises(SystemExit, match="0"):
        main()
    path = store.path.parent / "episodes.csv"
    said = capsys.readouterr().out.splitlines()
    assert said[0] == f"2 episodes: {path}" and len(pd.read_csv(path)) == 2
    assert said[1] == f"sha256 of what settings and seeds decide: {export.checksum(pd.read_csv(path))}"
