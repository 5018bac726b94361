"""MLE-POMCP's data: from the development policies, through cameras, and nothing from the final table."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from tab_marl.agents.adversaries import ScriptedAdversary
from tab_marl.agents.measures.rollouts import rollout_unopposed
from tab_marl.agents.policies.zoo import PolicyError, load_zoo
from tab_marl.agents.pretraining import MOVES_FILE, count_moves, pretrained, read_moves, untrained, write_moves
from tab_marl.mission.tasks import sample_task


def tasks(count: int = 3):
    return [sample_task(np.random.default_rng((8, i)), m, "point") for i, m in zip(range(count), ("M1", "M4", "M5"))]  # noqa: B905


def test_what_ships_was_counted_from_the_development_policies_that_ship() -> None:
    """And from no other: the final ones' moves are not in it."""
    record = read_moves()
    assert record["policies"] == {p.name: p.card.sha256 for p in load_zoo(split="development")}
    assert record["ticks_seen"] > 500
    # Every two consecutive ticks under a camera are one move.
    assert 0.5 * record["ticks_seen"] < pretrained().counts.sum() < record["ticks_seen"]


def test_counts_are_of_the_moves_under_cameras() -> None:
    """By an independent count: consecutive ticks under a camera, whatever their direction."""
    expected = 0
    for i, task in enumerate(tasks()):
        positions, completed = rollout_unopposed(ScriptedAdversary(), task, np.random.default_rng((5, i, 0)), 2)
        for path, end in zip(positions, completed, strict=True):
            seen = task.scenario.seen(path[: end + 1])
            expected += int((seen[1:] & seen[:-1]).sum())
    moves, ticks = count_moves([ScriptedAdversary()], tasks(), 5, per_task=2)
    assert expected > 10 and moves.counts.sum() == pytest.approx(expected) and ticks > expected
    again, _ = count_moves([ScriptedAdversary()], tasks(), 5, per_task=2)
    np.testing.assert_array_equal(moves.counts, again.counts)


def test_a_follower_of_shortest_ways_is_counted_along_its_way() -> None:
    """Nearly all its moves lie within a bin of straight ahead."""
    moves, _ = count_moves([ScriptedAdversary()], tasks(), 5)
    assert moves.counts[[-1, 0, 1]].sum() > 0.7 * moves.counts.sum()
    assert math.isclose(untrained().counts.sum(), 0.0)


def test_policies_of_the_final_table_lend_no_moves(tmp_path) -> None:
    with pytest.raises(ValueError, match=r"is for the final table: MLE-POMCP's data come from development policies"):
        write_moves(load_zoo(split="final")[:1], untrained(), 0, 0, tmp_path / "moves.json")
    assert not list(tmp_path.iterdir())


def test_written_counts_are_read_again_and_broken_ones_refused(tmp_path) -> None:
    moves, ticks = count_moves([ScriptedAdversary()], tasks(1), 5)
    write_moves(load_zoo(split="development"), moves, ticks, 1, tmp_path / "moves.json")
    np.testing.assert_allclose(pretrained(tmp_path / "moves.json").counts, moves.counts, atol=1e-3)
    record = json.loads(MOVES_FILE.read_text())
    record["moves"]["counts"] = [1, 2, 3]
    (tmp_path / "broken.json").write_text(json.dumps(record))
    for name in ("broken.json", "missing.json"):
        with pytest.raises(PolicyError, match=r"cannot read the counted moves .*write them anew"):
            pretrained(tmp_path / name)
