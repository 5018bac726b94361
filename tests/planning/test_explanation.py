"""What a plan says about itself, against its own tree and against entropies worked out by hand."""

from __future__ import annotations

import dataclasses
import io
import math

import numpy as np
import pytest
from rich.console import Console

from tab_marl.planning import textbook
from tab_marl.planning.beliefs.exact_filter import ExactFilter
from tab_marl.planning.beliefs.particle_filter import FilterOptions, ParticleFilter
from tab_marl.planning.model import Particles
from tab_marl.planning.search.explanation import summarise
from tab_marl.planning.search.pomcp import Pomcp, PomcpOptions
from tab_marl.planning.search.tree import ROOT
from tab_marl.planning.tables import table_model

GROWLS = ("growl left", "growl right").__getitem__


def tiger_plan(simulations=400):
    belief = ExactFilter(textbook.tiger()).update(textbook.LISTEN, textbook.HEAR_LEFT)
    options = PomcpOptions(simulations=simulations, exploration=110.0, max_depth=20)
    return belief, Pomcp(textbook.tiger(), options).plan(belief.sample, 0)


def test_an_explanation_says_what_the_tree_holds():
    belief, plan = tiger_plan()
    why = plan.explain(belief, GROWLS)
    assert why.action == "listen"
    assert [a.name for a in why.actions] == ["listen", "open right", "open left"]
    assert sum(a.visits for a in why.actions) == 400
    assert sum(a.share for a in why.actions) == pytest.approx(1)
    assert why.lead == pytest.approx(plan.values[0] - plan.values[2])
    first = why.line[0]
    edge = plan.tree.edge(ROOT, 0)
    counts = {plan.tree.observation(n): int(plan.tree.nodes["visits"][n]) for n in plan.tree.children(edge)}
    assert first.visits == plan.visits[0]
    assert first.observation == max(counts, key=lambda seen: counts[seen]) == 0  # left was heard before
    assert first.chance == pytest.approx(counts[0] / sum(counts.values()))
    assert all(step.visits >= 10 for step in why.line)
    assert why.belief.states == 2
    assert why.belief.entropy == pytest.approx(-0.85 * math.log(0.85) - 0.15 * math.log(0.15))


def test_it_reads_well_as_text_and_as_a_table():
    belief, plan = tiger_plan()
    text = str(plan.explain(belief, GROWLS))
    assert text.startswith(plan.table())
    assert "* listen" in text
    assert "most likely line: listen (sees growl left" in text
    assert "belief: 2 states, entropy 0.42 nats (as spread as 1.5 equally likely ones)" in text
    console = Console(file=io.StringIO(), width=120)
    console.print(plan.explain(belief))
    shown = console.file.getvalue()
    assert "open right" in shown
    assert "400 simulations" in shown
    assert str(plan) == str(plan.explain())


def test_a_belief_is_summarised_whatever_it_is_made_of():
    weighted = summarise(Particles(np.array([[0.0], [1.0], [1.0]]), np.array([2.0, 1.0, 1.0])))
    assert (weighted.states, weighted.spread) == (2, (0.5,))
    assert weighted.entropy == pytest.approx(math.log(2))
    assert weighted.perplexity == pytest.approx(2)
    assert summarise([[3.0, 9.0], [3.0, 20.0]]).states == 2
    assert summarise(lambda count, rng: rng.integers(4, size=count)).entropy == pytest.approx(math.log(4), abs=0.01)
    objects = summarise([("left", 0), ("right", 0), ("left", 0), ("left", 0)])
    assert objects.entropy == pytest.approx(-0.75 * math.log(0.75) - 0.25 * math.log(0.25))
    assert objects.spread == ()


@dataclasses.dataclass
class Cave:
    """A state that cannot be hashed, as a dataclass that can be changed."""

    lit: bool
    rooms: object


def caves(kind):
    """Two distinct states of a kind, the first of them twice, none of them hashable."""
    large = np.zeros(5000)
    dark = large.copy()
    dark[2500] = 1.0  # where numpy writes an ellipsis
    return {
        "arrays": [large, dark, large.copy()],
        "arrays of two shapes": [np.zeros(4), np.zeros((2, 2)), np.zeros(4)],
        "arrays of objects": [np.array([{"a": 1}, None]), np.array([{"a": 2}, None]), np.array([{"a": 1}, None])],
        "dicts": [{"at": 1, "seen": {2}}, {"at": 1, "seen": set()}, {"seen": {2}, "at": 1}],
        "lists": [[1, ["a"]], [1, ["b"]], [1, ["a"]]],
        "tuples of arrays": [("a", large), ("a", dark), ("a", large.copy())],
        "dataclasses": [Cave(True, large), Cave(True, dark), Cave(True, large.copy())],
    }[kind]


KINDS = ("arrays", "arrays of two shapes", "arrays of objects", "dicts", "lists", "tuples of arrays", "dataclasses")


@pytest.mark.parametrize("kind", KINDS)
def test_states_that_cannot_be_hashed_are_told_apart(kind):
    states = np.empty(3, dtype=object)
    for i, state in enumerate(caves(kind)):
        states[i] = state
    said = summarise(Particles(states, np.array([0.25, 0.5, 0.25])))
    assert said.states == 2
    assert said.entropy == pytest.approx(math.log(2))


class Corridor:
    """A light is on or off, whatever the states are made of."""

    actions = 2

    def step(self, state, action, rng):
        return state, int(rng.random() < 0.5), float(action), False


@pytest.mark.parametrize("wrapped", [lambda lit: np.array([lit, 1.0]), lambda lit: {"lit": lit}])
@pytest.mark.filterwarnings("ignore::tab_marl.planning.model.PlainPythonWarning")
def test_a_plan_over_states_that_cannot_be_hashed_explains_itself(wrapped):
    model = Corridor()
    belief = ParticleFilter(model, [wrapped(0.0), wrapped(1.0)], FilterOptions(count=40), 0)
    plan = Pomcp(model, PomcpOptions(simulations=50, max_depth=3)).plan(belief, 0)
    assert "belief: 2 states, entropy 0.69 nats" in str(plan.explain(belief))


def test_the_only_action_leads_by_everything():
    model = table_model([np.eye(1)], [np.eye(1)], [[1.0]])
    why = Pomcp(model, PomcpOptions(simulations=50, max_depth=3)).plan([0.0], 0).explain()
    assert why.lead == math.inf
    assert "leads by" not in str(why)
    assert [step.action for step in why.line] == ["0", "0", "0"]
    assert why.line[-1].observation is None


def test_the_tree_is_drawn_with_its_labels_and_what_is_left_out_is_counted(tmp_path):
    _, plan = tiger_plan()
    path = tmp_path / "tree.svg"
    figure = plan.draw(path, steps=2, name_of=GROWLS)
    svg = path.read_text()
    labels = [text.get_text() for text in figure.axes[0].texts]
    assert "now\n400" in labels
    assert f"listen\n{plan.values[0]:.2f} · {plan.visits[0]}" in labels
    assert any(label.startswith("growl left\n") for label in labels)
    assert "growl left" in svg
    everything = plan.draw(steps=1, actions=9, observations=9, least_share=0.0)
    shown = [text.get_text() for text in everything.axes[0].texts]
    assert len(shown) == 1 + 3 + sum(len(list(plan.tree.children(e))) for e in plan.tree.edges_of(ROOT))
    assert not any(label.startswith("+") for label in shown)
    one = [text.get_text() for text in plan.draw(steps=1, actions=1).axes[0].texts]
    assert f"+2 actions\n{400 - plan.visits[0]}" in one
    with pytest.raises(ValueError, match="steps is 0, must be >= 1"):
        plan.draw(steps=0)
