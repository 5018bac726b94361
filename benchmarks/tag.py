"""Tag: how fast the planner searches and how well it plays, beside figures measured or published for others.

    python benchmarks/tag.py                     # speed, and 100 games a row
    python benchmarks/tag.py --games 500 --large # narrower intervals, and 10,000 simulations a move

Rates are per CPU second of the whole `plan` call, one thread, over 50 beliefs met in play; of each the quickest of `--repeats`
identical plans counts, which a busy machine disturbs least. A step is one application of Tag's rules, in the tree or in a rollout.
Rollouts "history-aware" and "uniform" are Tag's own compiled functions; "the engine's own" calls the model's step, as pomdp-py's does.
pomdp-py draws from a global stream and cannot repeat a plan: it, and plain Python, are timed over the first 5 of those beliefs,
pomdp-py in one pass, plain Python as the quicker of two.
"""

from __future__ import annotations

import argparse
import platform
import sys
import time
from dataclasses import dataclass, replace
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from tab_marl.planning import CompiledModel, Pomcp, PomcpOptions
from tab_marl.planning.random_kernels import GOLDEN
from tab_marl.planning.textbook import SEES_TARGET, TAG, TagBelief, TagData, play_tag, tag, tag_data, tag_kernels

DISCOUNT = 0.95
PER_WORD = np.uint64(pow(int(GOLDEN), -1, 2**64))
"""Every random number adds GOLDEN to a stream's word: a difference of words, times this, is how many were drawn between."""


class PlainTag:
    """Tag in plain Python, with the history-aware rollout: what the compiled search is compared with."""

    actions = 5

    def __init__(self) -> None:
        data = tag_data()
        self.robot_moves = data.robot_moves.reshape(29, 5).tolist()
        self.target_moves = data.target_moves.reshape(29, 29, 5).tolist()
        self.rollout_moves = data.rollout_moves.reshape(29, 5, 12).tolist()
        self.steps = 0

    def step(
        self, state: tuple[int, int], action: int, rng: np.random.Generator
    ) -> tuple[tuple[int, int], int, float, bool]:
        robot, target = state
        if action == TAG and robot == target:
            return state, SEES_TARGET, 10.0, True
        target = self.target_moves[robot][target][int(rng.random() * 5)]
        robot = self.robot_moves[robot][action]
        return (robot, target), SEES_TARGET if robot == target else robot, -10.0 if action == TAG else -1.0, False

    def rollout(
        self,
        state: tuple[int, int],
        action: int,
        observation: int,
        depth: int,
        max_depth: int,
        discount: float,
        rng: np.random.Generator,
    ) -> float:
        robot, target = state
        total, weight = 0.0, 1.0
        for _ in range(depth, max_depth):
            self.steps += 1
            if robot == target:
                return total + weight * 10.0
            total -= weight
            weight *= discount
            target = self.target_moves[robot][target][int(rng.random() * 5)]
            action, robot = divmod(self.rollout_moves[robot][action][int(rng.random() * 12)], 32)
        return total


def counted_step(state, action, data, rng):
    tables, _ = data
    return _step(state, action, tables, rng)


def counted_uniform(state, action, observation, depth, max_depth, discount, data, rng):
    tables, steps = data
    word = rng[0]
    total = _uniform(state, action, observation, depth, max_depth, discount, tables, rng)
    steps[0] += (rng[0] - word) * PER_WORD  # each step draws one
    return total


def counted_history(state, action, observation, depth, max_depth, discount, data, rng):
    tables, steps = data
    word = rng[0]
    total = _history(state, action, observation, depth, max_depth, discount, tables, rng)
    drawn = (rng[0] - word) * PER_WORD
    steps[0] += min(drawn + np.uint64(1), np.uint64(max_depth - depth))  # the tag at the end draws none
    return total


_step, _uniform, _history = map(
    numba.njit, (tag_kernels.step, tag_kernels.uniform_rollout, tag_kernels.history_rollout)
)
_COUNTED = {tag_kernels.uniform_rollout: counted_uniform, tag_kernels.history_rollout: counted_history}


def steps_of(model: CompiledModel, options: PomcpOptions, states: Any, seed: int) -> int:
    """Steps of one plan, in the tree and in rollouts: the same search with rollouts that count theirs."""
    counter = np.zeros(1, dtype=np.uint64)
    counted: tuple[TagData, NDArray[np.uint64]] = model.data, counter
    rollout = None if model.rollout is None else _COUNTED[model.rollout]
    plan = Pomcp(replace(model, step=counted_step, rollout=rollout, data=counted), options).plan(states, seed)
    return plan.steps + int(counter[0])


@dataclass
class Rate:
    simulations: float
    steps: float


def situations(count: int, seed: int) -> list[TagBelief]:
    """Beliefs met in games that the planner plays."""
    rng = np.random.default_rng(seed)
    model = tag()
    planner = Pomcp(model, PomcpOptions(simulations=200))
    met: list[TagBelief] = []

    def remembered(belief: TagBelief, rng: np.random.Generator) -> int:
        met.append(belief)
        return planner.plan(belief.sample(200, rng), rng).action

    while len(met) < count:
        play_tag(remembered, rng, model.data, DISCOUNT)
    return met[:count]


def rate(model: Any, options: PomcpOptions, beliefs: list[TagBelief], repeats: int) -> Rate:
    """Simulations and steps per CPU second of `plan`."""
    planner = Pomcp(model, options)
    rng = np.random.default_rng(0)
    simulations = steps = 0
    seconds = 0.0
    for seed, belief in enumerate(beliefs):
        states: Any = belief.sample(options.simulations, rng)
        if isinstance(model, PlainTag):
            states = [(int(robot), int(target)) for robot, target in states]
            model.steps = 0
        plan = planner.plan(states, seed)  # compiles, or loads; the same seed takes the same steps each time
        simulations += plan.simulations
        if isinstance(model, PlainTag):
            steps += plan.steps + model.steps
        else:
            steps += steps_of(model, options, states, seed)
        times = []
        for _ in range(repeats):
            started = time.process_time()
            planner.plan(states, seed)
            times.append(time.process_time() - started)
        seconds += min(times)
    return Rate(simulations / seconds, steps / seconds)


def peer_rows(measured: dict[str, Rate], beliefs: list[TagBelief]) -> None:
    """pomdp-py in the same run: POUCT, 1,000 simulations, 90 steps deep, uniform rollouts, CPU clock, one pass."""
    try:
        from pomdp_py_tag import Peer, ShippedPeer
    except ImportError:
        print("  pomdp-py is not installed: pip install 'tab-marl[benchmarks]'")
        return
    for name, make in (("its own Tag", ShippedPeer), ("Tag rewritten for it", Peer)):
        peer = make(1000, exploration=10.0, discount=DISCOUNT, max_depth=90, seed=0)
        rng = np.random.default_rng(0)
        started = time.process_time()
        for belief in beliefs:
            peer.plan(belief, rng)
        seconds = time.process_time() - started
        simulations, steps = 1000 * len(beliefs) / seconds, peer.transition.calls / seconds
        print(f"  {'pomdp-py, ' + name + ', uniform rollout':<42}{simulations / 1e3:>10,.2f}{steps / 1e6:>11,.3f}")
        for row, ours in measured.items():
            print(
                f"    {row}: {ours.simulations / simulations:,.0f} x its simulations, {ours.steps / steps:,.0f} x its steps"
            )


def returns(model: CompiledModel, options: PomcpOptions, games: int) -> NDArray[np.float64]:
    planner = Pomcp(model, options)

    def move(belief: TagBelief, rng: np.random.Generator) -> int:
        return planner.plan(belief.sample(options.simulations, rng), rng).action

    return np.array([play_tag(move, np.random.default_rng(seed), model.data, DISCOUNT) for seed in range(games)])


def speed_table(repeats: int, peer: bool) -> None:
    beliefs = situations(200, seed=1)[::4]
    options = PomcpOptions(simulations=1000, exploration=10.0, discount=DISCOUNT)
    print(f"{'speed at 1,000 simulations a move':<44}{'k sims/s':>10}{'M steps/s':>11}")
    rows = [
        ("history-aware rollout", tag("history")),
        ("uniform rollout", tag("uniform")),
        ("uniform rollout, the engine's own", tag("engine")),
    ]
    measured = {}
    for name, model in rows:
        measured[name] = rate(model, options, beliefs, repeats)
        print(f"  {name:<42}{measured[name].simulations / 1e3:>10,.0f}{measured[name].steps / 1e6:>11,.1f}", flush=True)
    if peer:
        peer_rows(measured, beliefs[:5])
    plain = rate(PlainTag(), options, beliefs[:5], 2)
    print(f"  {'plain Python, history-aware rollout':<42}{plain.simulations / 1e3:>10,.1f}{plain.steps / 1e6:>11,.2f}")
    fast = measured["history-aware rollout"]
    print(f"  compiled against plain Python: {fast.simulations / plain.simulations:,.0f} times the simulations")
    print("  for comparison: POMCP 1.0 (C++) 263 k, 14.3 M; APPL Online POMCP (C++) 291 k, 22.6 M (another machine)\n")


def return_table(games: int, large: bool) -> None:
    print(f"{'discounted return, ' + str(games) + ' games':<44}{'mean':>8}{'+- s.e.':>9}{'ms/move':>9}")
    rows = [
        ("uniform rollout, 1,000 simulations", tag("uniform"), 1000, 10.0),
        ("history-aware rollout, 100 simulations", tag("history"), 100, 10.0),
        ("history-aware rollout, 1,000 simulations", tag("history"), 1000, 10.0),
    ]
    if large:
        rows.append(("uniform rollout, 10,000 simulations", tag("uniform"), 10000, 20.0))
        rows.append(("history-aware rollout, 10,000 simulations", tag("history"), 10000, 20.0))
    for name, model, simulations, exploration in rows:
        options = PomcpOptions(simulations=simulations, exploration=exploration, discount=DISCOUNT)
        states = TagBelief(4).sample(simulations, np.random.default_rng(0))
        milliseconds = 1e3 * min(Pomcp(model, options).plan(states, seed).seconds for seed in range(5))
        got = returns(model, options, games)
        error = got.std(ddof=1) / np.sqrt(games)
        print(f"  {name:<42}{got.mean():>8.2f}{error:>9.2f}{milliseconds:>9.2f}", flush=True)
    print("  for comparison: SARSOP -6.03, DESPOT -6.23, POMCP -7.14 (Ye et al. 2017, at 1 s a move);")
    print("  POMCP 1.0 at 1,024 simulations -8.0, APPL Online POMCP at 1,000 -14.0 (uniform rollout)")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--games", type=int, default=100, help="games a row (0: speed only)")
    parser.add_argument("--large", action="store_true", help="also 10,000 simulations a move")
    parser.add_argument("--repeats", type=int, default=20, help="timings of each plan, of which the quickest counts")
    parser.add_argument("--without-peer", action="store_true", help="do not run pomdp-py")
    arguments = parser.parse_args()
    if arguments.repeats < 1 or arguments.games < 0 or arguments.games == 1:
        parser.error("--repeats must be >= 1 and --games 0 or >= 2")
    print(f"Python {platform.python_version()}, numba {numba.__version__}, {platform.machine()}, one thread\n")
    speed_table(arguments.repeats, not arguments.without_peer)
    if arguments.games:
        return_table(arguments.games, arguments.large)
    return 0


if __name__ == "__main__":
    sys.exit(main())
