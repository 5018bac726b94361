"""Replays: an honest choice, and an encoding that the page can read back."""

import json

import numpy as np
import pytest

from tab_marl.evaluation.report import replay
from tab_marl.evaluation.units import Unit
from tab_marl.world.scenario import Scenario


def test_encoded_image_reads_back():
    rng = np.random.default_rng(0)
    for image in (rng.random((30, 30)) ** 8, np.zeros((3, 5)), np.ones((20, 20)), rng.random((1, 1))):
        back = replay.decode_image(replay.encode_image(image), image.shape)
        assert np.array_equal(back, replay.quantised(image))
    assert replay.quantised(np.array([[0.0, 1.0, 4.0, np.nan]])).tolist() == [[0, 8, 15, 0]]


def test_shrink_keeps_the_mass_in_place():
    image = np.zeros((60, 60))
    image[10, 50] = 0.7
    image[11, 51] = 0.3
    small = replay.shrink(image, 3.0, 3.0)
    assert small.shape == (30, 30)
    assert small[5, 25] == pytest.approx(1.0) and small.sum() == pytest.approx(1.0)
    assert replay.shrink(image[:20, :20], 3.0, 3.0).shape == (20, 20)


def test_trace_is_json(synthetic):
    trace = replay.Trace(10, [(0.5, 1.0, 3.14159, 2.0, 2.5, -1.0, True)], [(0, np.eye(3))], [(1.23456, "intercepted")])
    back = json.loads(json.dumps(replay.encode_trace(trace), allow_nan=False))
    assert back["poses"] == [[500], [1000], [314], [2000], [2500], [-100]]
    assert back["seen"] == "1" and back["events"] == [[1.23, "intercepted"]]


def test_map_holds_what_is_drawn():
    scenario = Scenario.preset("lab")
    drawn = replay.encode_map(scenario, [scenario.region("Checkpoint A")], [scenario.region("left half")])
    assert [c["label"] for c in drawn["checkpoints"]] == list("ABCDE")
    assert drawn["goals"] == [["disc", 0.5, 2.5, 0.18]]
    assert drawn["forbidden"] == [["box", 0, 0, 1.5, 3.0]]


def rows_of(synthetic, outcomes):
    """{(mission, family): [per seed (TAB's steps, S's steps)]}; 0 means completed and never met."""
    return [
        synthetic.row(p, seed, mission, family, steps > 0, steps == 0, steps)
        for (mission, family), seeds in outcomes.items()
        for seed, pair in enumerate(seeds)
        for p, steps in zip(("TAB-POMCP", "S-POMCP"), pair, strict=True)
    ]


def test_choice_is_typical_not_flattering(synthetic):
    rows = rows_of(synthetic, {("M1", "ambiguous"): [(10, 0), (300, 900), (310, 1000), (320, 1100), (4000, 4000)]})
    (first,) = replay.choose(rows, 1)
    assert first.unit.seed in (1, 2, 3)
    assert "typical" in first.why


def test_widest_and_a_defeat_are_shown_and_named_so(synthetic):
    rows = rows_of(
        synthetic,
        {("M1", "ambiguous"): [(300, 900), (310, 910), (320, 920)], ("M2", "point"): [(100, 200), (100, 0), (0, 5000)]},
    )
    chosen = replay.choose(rows, 4)
    assert (chosen[0].unit.mission, chosen[0].unit.family) == ("M1", "ambiguous") and "typical" in chosen[0].why
    assert chosen[1].unit == Unit("M2", "point", 1) and "differ most" in chosen[1].why
    assert chosen[2].unit == Unit("M2", "point", 2) and "TAB-POMCP lost" in chosen[2].why
    assert chosen[3].unit.family == "point" and "typical" in chosen[3].why
    every = replay.choose(rows, 30)
    assert len({c.unit for c in every}) == len(every)


def test_nothing_to_choose_from(synthetic):
    assert replay.choose([], 3) == []
    assert replay.choose([synthetic.row(error="x")], 3) == []


def test_replays_of_the_longest_episodes_are_small():
    """Three replays of eight planners over 100 s, beliefs as they are: a page with them stays well below ten megabytes."""
    rng = np.random.default_rng(0)
    place = np.stack(np.meshgrid(np.arange(30), np.arange(30)), axis=-1)
    walk = 1.5 + np.cumsum(rng.normal(0, 0.02, size=(1000, 6)), axis=0)
    trace = replay.Trace(10, [(*step, k % 7 == 0) for k, step in enumerate(walk)])
    for k in range(0, 1000, 5):
        spread = np.exp(-((place - rng.uniform(5, 25, size=2)) ** 2).sum(axis=-1) / rng.uniform(5, 200))
        trace.beliefs.append((k, spread * (spread > 1e-3)))
    size = len(json.dumps(replay.encode_trace(trace), separators=(",", ":")))
    assert 3 * 8 * size < 5_000_000
