"""What a filter remembers: replays of a bounded memory against those of one that forgets nothing, at every phase of its cycle."""

from __future__ import annotations

import pickle
import warnings

import numpy as np
import pytest

from tab_marl.planning import textbook
from tab_marl.planning.beliefs.exact_filter import ExactFilter
from tab_marl.planning.beliefs.filter_report import BeliefWarning
from tab_marl.planning.beliefs.particle_filter import FilterOptions, ParticleFilter
from tab_marl.planning.tables import table_model

PARITY, CELL = 0, 1
NEVER = 4
"""An observation that no cell gives."""


def ring(cells=4):
    """A walker goes round: action 0 sees whether its cell is odd, action 1 the cell itself."""
    observation = np.zeros((2, cells, cells + 1))
    observation[PARITY, np.arange(cells), np.arange(cells) % 2] = 1.0
    observation[CELL, np.arange(cells), np.arange(cells)] = 1.0
    return table_model(np.repeat(np.roll(np.eye(cells), 1, axis=1)[None], 2, axis=0), observation, np.zeros((2, cells)))


RING = ring()


def followed(memory, events, model=RING):
    """(support, replays, fallbacks) after each event of a filter that believes the walker to be in cell 0 at first.

    Events: "parity" and "cell" are true readings, "never" an impossible one (the prior is believed, so the walker is put back
    to cell 0 too), "half" moves the particles round by half the ring first (unseen by parities), "one" by one cell.
    """
    cells = len(model.data.terminal)
    belief, cell, told = ParticleFilter(model, [0.0], FilterOptions(count=8, memory=memory)), 0, []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BeliefWarning)
        for event in events:
            if event in ("half", "one"):
                belief.states = (belief.states + (cells // 2 if event == "half" else 1)) % cells
            cell = 0 if event == "never" else (cell + 1) % cells
            if event == "never":
                belief.update(PARITY, cells)
            elif event == "cell":
                belief.update(CELL, cell)
            else:
                belief.update(PARITY, cell % 2)
            report = belief.report()
            told.append((set(belief.states[:, 0]), cell, report.replays, report.fallbacks))
            assert len(belief._history) < 2 * memory
    return told


@pytest.mark.parametrize("memory", [1, 2, 3, 5])
def test_after_a_fallback_at_any_time_a_replay_starts_where_its_history_does(memory):
    for fallen in range(2 * memory + 2):
        for shifted in range(fallen + 1, fallen + 3 * memory + 2):
            events = ["parity"] * (shifted + memory)
            events[fallen], events[shifted] = "never", "one"
            told = followed(memory, events)
            assert told == followed(10**6, events), (fallen, shifted)
            assert all(support == {cell} for support, cell, *_ in told)
            assert told[-1][2:] == (1, 1)


def test_the_ring_of_the_audit():
    told = followed(2, ["never", "parity", "parity", "parity", "one"])
    assert told[-1] == ({0.0}, 0, 1, 1)


def test_a_count_that_the_model_explains_is_not_given_up_after_a_fallback():
    support, cell, replays, fallbacks = followed(3, ["never"] + ["cell"] * 8 + ["one"], ring(20))[-1]
    assert (support, cell) == ({9.0}, 9)
    assert (replays, fallbacks) == (1, 1)


@pytest.mark.parametrize("memory", [2, 3, 5])
@pytest.mark.parametrize("seed", range(6))
def test_whatever_happens_bounded_memory_believes_what_unbounded_memory_does(memory, seed):
    events = np.random.default_rng(seed).choice(["parity", "cell", "one", "never"], size=60, p=[0.6, 0.15, 0.15, 0.1])
    assert followed(memory, events) == followed(10**6, events)


@pytest.mark.parametrize("memory", [2, 3, 5])
def test_a_replay_also_mends_the_belief_that_later_replays_start_from(memory):
    # Wrong since just before a belief is kept, noticed just after: the kept one must not come back in the next replay.
    events = ["parity"] * (memory - 1) + ["half", "cell"] + ["parity"] * memory + ["one", "cell"]
    told = followed(memory, events)
    assert told[memory - 1][0] != {float(memory % 4)}  # the belief kept was wrong
    assert told == followed(10**6, events)
    assert told[-1] == ({float(len(events) % 4)}, len(events) % 4, 2, 0)


# ---- the exact filter


def growls(lefts, rights, accuracy=1.0, **options):
    """The exact filter after that many growls from the left, then from the right."""
    belief = ExactFilter(textbook.tiger(accuracy=accuracy), **options)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BeliefWarning)
        for heard in [textbook.HEAR_LEFT] * lefts + [textbook.HEAR_RIGHT] * rights:
            belief.update(textbook.LISTEN, heard)
    return belief


@pytest.mark.parametrize("lefts", [1, 10, 100, 107, 110, 150, 500])
def test_one_contradiction_never_turns_certainty_round_however_long_it_grew(lefts):
    belief = growls(lefts, 1)
    odds = 1e-3 ** (lefts - 1)  # every growl excludes one side and is doubted in a thousand
    assert belief.probabilities == pytest.approx([1 / (1 + odds), odds / (1 + odds)], abs=1e-12)
    report = belief.report()
    assert (report.replays, report.fallbacks) == (1, 0)


def test_doubts_add_up_as_in_logarithms():
    for lefts, rights in [(40, 1), (40, 2), (40, 38), (40, 39)]:
        right_over_left = 10.0 ** (-3.0 * (lefts - rights))
        belief = growls(lefts, rights)
        assert belief.probabilities[1] / belief.probabilities[0] == pytest.approx(right_over_left)
        assert belief.report().replays == rights  # every one of them is told, not only the first
    # Who has been wrong for long is convinced in the end, and a doubt of nothing stays that.
    assert growls(40, 41).probabilities[1] == 1.0
    assert growls(500, 80).probabilities[1] > 0.999
    assert growls(500, 1, doubt=0.0).report().fallbacks == 1


def test_evidence_without_contradiction_does_not_round_a_state_away():
    belief = growls(600, 600, accuracy=0.85)
    assert belief.probabilities[1] > 0.99  # the floor is reached after 266 growls; from there on the right gains
    assert belief.report().events == ()
    assert growls(150, 150, accuracy=0.85).probabilities == pytest.approx([0.5, 0.5])


def test_a_state_that_is_excluded_without_doubt_stays_so():
    model = RING
    belief = ExactFilter(model, [1, 0, 0, 0])
    for step in range(1, 300):
        belief.update(PARITY, step % 2)
        assert np.flatnonzero(belief.probabilities).tolist() == [step % 4]


def test_the_exact_filter_s_memory_does_not_grow():
    def held(belief):
        return len(pickle.dumps([v for k, v in vars(belief).items() if k not in ("model", "_log")]))

    assert held(growls(3, 1)) == held(growls(1000, 1))


@pytest.mark.parametrize("doubt", [0.2, 1e-3])
def test_a_replay_is_what_the_whole_history_says_with_doubts(doubt):
    rng = np.random.default_rng(0)
    transition = rng.dirichlet(np.full(3, 0.6), size=(2, 3))
    transition[:, :, 0] += transition[:, :, 1]  # state 1 is never reached
    transition[:, :, 1] = 0.0
    observation = np.array([[[1, 0, 0], [0, 1, 0], [0.5, 0, 0.5]], [[0, 0.5, 0.5], [1, 0, 0], [0, 1, 0]]])
    prior = np.array([0.5, 0.3, 0.2])
    doubting, replays = prior, 0
    belief = ExactFilter(table_model(transition, observation, np.zeros((2, 3))), prior, doubt=doubt)
    for action, seen in rng.integers([2, 3], size=(60, 2)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", BeliefWarning)
            belief.update(int(action), int(seen))
        moved = doubting @ transition[action]
        best = observation[action][moved > 0, seen].max()
        if not best > 0:
            return
        doubting = moved * np.maximum(observation[action][:, seen], doubt * best)
        doubting /= doubting.sum()
        if belief.report().replays > replays:
            assert belief.probabilities == pytest.approx(doubting, abs=1e-12)
        replays = belief.report().replays
    assert replays > 2


def test_a_second_fallback_is_the_prior_led_through_the_last_step_as_the_first_was():
    belief = ExactFilter(RING, [1, 0, 0, 0])
    for _ in range(2):
        with pytest.warns(BeliefWarning, match="fallback"):
            belief.update(PARITY, NEVER)
        assert belief.probabilities.tolist() == [0, 1, 0, 0]
