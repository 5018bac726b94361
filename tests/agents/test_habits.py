"""Mixtures of habits: drawn by their weights, and learned to the mixed equilibrium of a game."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.optimize import linprog
from scipy.stats import chisquare

from tab_marl.agents.adversaries import ScriptedAdversary
from tab_marl.agents.hunted.habits import HabitSettings, MixtureLearner, learn_habits, learned_style, with_weights
from tab_marl.agents.hunted.study import HuntedRow, entropy_bits, habits_of, study, unhunted, values
from tab_marl.agents.policies.zoo import load_zoo
from tab_marl.agents.training.env import HELD_OUT, draw_tasks
from tab_marl.envs.adversary_observation import AdversaryTask
from tab_marl.envs.styles import STYLES, Habit, Style, mixture_of

THREE = Style(
    "three",
    mixture=(
        Habit(Style("plain"), 0.5, 0.1),
        Habit(Style("side", side=1.0), 0.3, 0.2),
        Habit(Style("late", arrival_fraction=(0.8, 0.8)), 0.2, 0.7),
    ),
)


@pytest.mark.parametrize("open_ended", [False, True])
def test_habits_are_drawn_by_their_weights(open_ended: bool) -> None:
    rng = np.random.default_rng(0)
    drawn = [THREE.draw(rng, open_ended) for _ in range(3000)]
    counts = [
        sum(x.side == 0 and x.arrival_fraction == 0 for x in drawn),
        sum(x.side != 0 for x in drawn),
        sum(x.arrival_fraction > 0 for x in drawn),
    ]
    assert sum(counts) == 3000
    assert chisquare(counts, 3000 * THREE.weights(open_ended)).pvalue > 0.001


def test_the_mission_decides_which_weights_count() -> None:
    certain = Style("two", mixture=(Habit(Style("a", side=1.0), 1.0, 0.0), Habit(Style("b"), 0.0, 1.0)))
    one, several = draw_tasks(HELD_OUT, 1, 2, ("M1",), ("point", "ambiguous"))
    for task, side in ((one, True), (several, False)):
        built = AdversaryTask.draw(task.scenario, task.mission, certain, np.random.default_rng(0), 4)
        assert [b.latents.side != 0 for b in built] == [side] * 4


def test_mixtures_are_checked_and_survive_a_card() -> None:
    with pytest.raises(ValueError, match=r"weights sum to 0\.5, must sum to 1"):
        Style(mixture=(Habit(Style(), 0.5, 1.0),))
    with pytest.raises(ValueError, match="must be a plain style"):
        Style(mixture=(Habit(THREE, 1.0, 1.0),))
    with pytest.raises(ValueError, match="probability"):
        Habit(Style(), 1.5, 1.0)
    reader = TypeAdapter(Style)
    assert reader.validate_json(reader.dump_json(STYLES["habits"])) == STYLES["habits"]
    assert THREE.varies


def equilibrium(payoff: np.ndarray) -> tuple[np.ndarray, float]:
    """The row player's maximin mixture and the game's value, by linear programming (the oracle)."""
    rows, columns = payoff.shape
    found = linprog(
        np.r_[np.zeros(rows), -1.0],
        A_ub=np.c_[-payoff.T, np.ones(columns)],
        b_ub=np.zeros(columns),
        A_eq=[np.r_[np.ones(rows), 0.0]],
        b_eq=[1.0],
        bounds=[(0, None)] * rows + [(None, None)],
    )
    return found.x[:rows], found.x[-1]


def test_learning_reaches_the_mixed_equilibrium_of_a_game() -> None:
    # Chances of completing the mission: matching pennies with one penny dearer, and a game with a habit that never pays.
    pennies = np.array([[0.9, 0.1], [0.2, 0.6], [0.1, 0.1]])
    other = np.array([[0.1, 0.7], [0.8, 0.3], [0.2, 0.3]])
    learner = MixtureLearner(2, 3, step=0.03, explore=0.1)
    rng = np.random.default_rng(0)
    rounds = 6000
    for t in range(rounds):
        contexts = np.repeat([0, 1], 6)
        choices = np.array([rng.choice(3, p=learner.trial[c]) for c in contexts])
        # The hunter knows the present mixture, not the draw, and answers it best.
        answers = [int(np.argmin(learner.mixture[c] @ game)) for c, game in enumerate((pennies, other))]
        chances = [(pennies, other)[c][k, answers[c]] for c, k in zip(contexts, choices, strict=True)]
        learner.update(contexts, choices, (rng.random(12) < chances).astype(float))
        learner.end_round(counts=2 * (t + 1) > rounds)
    for c, game in enumerate((pennies, other)):
        mixture, value = equilibrium(game)
        assert 0.05 < mixture.max() < 0.95  # really mixed
        np.testing.assert_allclose(learner.average()[c], mixture, atol=0.06)
        assert (learner.average()[c] @ game).min() > value - 0.03


class Stop(Exception):
    pass


def test_learning_continues_after_a_kill_to_the_same_end(tmp_path: Path) -> None:
    tasks = draw_tasks(HELD_OUT, 2, 2, ("M1",), ("ambiguous", "perimeter"))
    settings = HabitSettings(egos=("pursue",), episodes=15, together=5)

    def kill(done: int, total: int) -> None:
        if done == 2:
            raise Stop

    straight = learn_habits(ScriptedAdversary(), THREE, tasks, settings, tmp_path_of(tmp_path, "a"))
    killed = tmp_path_of(tmp_path, "b")
    with pytest.raises(Stop):
        learn_habits(ScriptedAdversary(), THREE, tasks, settings, killed, kill)
    assert learn_habits(ScriptedAdversary(), THREE, tasks, settings, killed) == straight
    assert learned_style(THREE, killed) == straight
    assert json.loads((killed / "habits.json").read_text())["updates"] == settings.updates == 3
    assert learned_style(THREE, tmp_path) == THREE
    with pytest.raises(ValueError, match="other settings"):
        learn_habits(ScriptedAdversary(), STYLES["habits"], tasks, settings, killed)
    with pytest.raises(ValueError, match="no mixture"):
        learn_habits(ScriptedAdversary(), Style(), tasks, settings, tmp_path)


def tmp_path_of(root: Path, name: str) -> Path:
    (root / name).mkdir()
    return root / name


def test_the_informed_ego_knows_the_mixture_but_not_the_draw(tmp_path: Path) -> None:
    tasks = draw_tasks(HELD_OUT, 3, 1, ("M1",), ("ambiguous",))
    settings = HabitSettings(egos=("population-POMCP",), episodes=3, together=3)
    style = learn_habits(ScriptedAdversary(), THREE, tasks, settings, tmp_path)
    assert sum(habit.open_weight for habit in style.mixture) == pytest.approx(1.0, abs=1e-3)
    assert sum(json.loads((tmp_path / "habits.json").read_text())["learner"]["tries"][1]) == 3


def test_rare_habits_are_dropped_and_weights_still_sum_to_one() -> None:
    style = mixture_of("three", [Style("a"), Style("b", side=1.0), Style("c", via=1.0)])
    kept = with_weights(style, np.array([[0.6, 0.396, 0.004], [0.333, 0.662, 0.005]]))
    assert [habit.style.name for habit in kept.mixture] == ["a", "b"]
    assert sum(habit.weight for habit in kept.mixture) == pytest.approx(1.0, abs=1e-9)
    assert kept.mixture[0].weight == pytest.approx(0.6 / 0.996, abs=1e-4)


def test_the_study_of_hunted_policies() -> None:
    policy = load_zoo()[0]
    players = {"a": (policy, STYLES["direct"]), "b": (policy, THREE)}
    blocks: list[int] = []
    rows = study(players, "ambiguous", 3, ["pursue"], 5, on_block=lambda block: blocks.append(len(block)))
    assert len(rows) == sum(blocks) == 6
    assert rows == study(players, "ambiguous", 3, ["pursue"], 5)
    assert not any(row.completed and row.caught for row in rows)
    assert list(habits_of(policy)) == [habit.style.name for habit in STYLES["habits"].mixture]
    # Against itself the direct style goes the same way.
    alike = unhunted(policy, STYLES["direct"], "ambiguous", 5, 5, draws=1)
    assert alike.same_last_goal == 1.0
    assert alike.stretch == pytest.approx(1.0, abs=0.3)
    assert entropy_bits(THREE) == pytest.approx(-(0.1 * np.log2(0.1) + 0.2 * np.log2(0.2) + 0.7 * np.log2(0.7)))


def test_a_mixtures_value_is_the_weighted_mean_of_its_habits_on_the_same_tasks() -> None:
    names = [habit.style.name for habit in STYLES["habits"].mixture]
    rng = np.random.default_rng(0)
    table = rng.random((50, len(names))) < np.linspace(0.1, 0.9, len(names))
    rows = [
        HuntedRow(name, name, "pursue", "M1", "ambiguous", task, False, bool(table[task, k]), not table[task, k], 1.0)
        for task in range(50)
        for k, name in enumerate(names)
    ]
    rows.append(HuntedRow("direct", "direct", "pursue", "M1", "ambiguous", 50, False, True, False, 1.0))  # left out
    two = Style("two", mixture=tuple(Habit(Style(names[k]), 1.0 - w, w) for k, w in ((0, 0.25), (5, 0.75))))
    found = values(rows, {"even": STYLES["habits"], "direct": STYLES["direct"], "two": two})
    assert found["even", "pursue"].share == pytest.approx(table.mean(), abs=1e-3)
    assert found["even", "pursue"].gain == pytest.approx(0.0, abs=1e-3)
    assert found["direct", "pursue"].share == pytest.approx(table[:, 0].mean())
    share = 0.25 * table[:, 0] + 0.75 * table[:, 5]
    value = found["two", "pursue"]
    assert value.share == pytest.approx(share.mean())
    assert value.gain == pytest.approx(share.mean() - table.mean(), abs=1e-9)
    # The bootstrap's interval is about that of the normal approximation.
    half = 1.96 * share.std() / np.sqrt(50)
    assert value.high - value.low == pytest.approx(2 * half, rel=0.15)
