"""How well the planners play textbook problems, beside published figures.

    python benchmarks/textbook.py                                    # 100 games a row
    python benchmarks/textbook.py --problems rocksample-7-8 lasertag --games 500

Mean discounted returns (discount .95) with standard errors over games whose start, world and planner are seeded by the game's
number; beliefs are exact, but for light-dark's, which has 10,000 particles as in its paper. Tiger is not played: a game is the exact
return of the policy that the plans of one seed make up. Milliseconds are the median wall time of a plan. Published figures are at about 1 s a move, ours at the simulations (POMCP) or seconds (DESPOT) named.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from tab_marl.planning import Despot, DespotOptions, Particles, Pomcp, PomcpOptions, Pomcpow, PomcpowOptions
from tab_marl.planning.beliefs.particle_filter import FilterOptions, ParticleFilter
from tab_marl.planning.cycle import play
from tab_marl.planning.textbook import (
    LaserTagBelief,
    RockBelief,
    TagBelief,
    laser_tag,
    light_dark,
    light_dark_binned,
    light_dark_start,
    rock_sample,
    tag,
    tiger,
)

DISCOUNT = 0.95
PUBLISHED = {
    "tiger": "optimum 19.37 (value iteration; Kaelbling, Littman and Cassandra 1998)",
    "tag": "SARSOP -6.03, DESPOT -6.23, POMCP -7.14 (Ye et al. 2017)",
    "rocksample-7-8": "see Ye et al. 2017, Silver and Veness 2010",
    "rocksample-11-11": "see Ye et al. 2017, Silver and Veness 2010",
    "rocksample-15-15": "see Ye et al. 2017, Silver and Veness 2010; their rocks are others",
    "lasertag": "POMCP -19.58 (Ye et al. 2017); DESPOT -8.9, POMCPOW -10.3, POMCP -14.1 (Sunberg 2018)",
    "light-dark": "POMCP on bins 61.1, POMCPOW 56.1, DESPOT on bins 54.2 (Sunberg and Kochenderfer 2018)",
}


def tiger_value(planner: Any, games: int, reach: int = 12) -> tuple[float, float, float]:
    """(mean return from the uniform belief, standard error over seeds, median milliseconds of a plan).

    Tiger's belief is the surplus of growls heard on the left, so one plan a surplus is a whole policy, and its return is
    computed, not played: games scatter by tens.
    """
    surplus = np.arange(-reach, reach + 1)
    left = 1 / (1 + (0.15 / 0.85) ** surplus)
    hears_left = 0.85 * left + 0.15 * (1 - left)
    returns, seconds = [], list[float]()
    for seed in range(games):
        plans = [planner.plan(Particles(np.array([0.0, 1.0]), np.array([p, 1 - p])), seed) for p in left]
        chosen, value = np.array([plan.action for plan in plans]), np.zeros(len(surplus))
        for _ in range(1000):
            up, down = np.append(value[1:], value[-1]), np.insert(value[:-1], 0, value[0])
            worth = [
                -1 + DISCOUNT * (hears_left * up + (1 - hears_left) * down),
                -100 * left + 10 * (1 - left) + DISCOUNT * value[reach],
                10 * left - 100 * (1 - left) + DISCOUNT * value[reach],
            ]
            value = np.choose(chosen, worth)
        returns.append(value[reach])
        seconds += [plan.seconds for plan in plans]
    return float(np.mean(returns)), float(np.std(returns, ddof=1) / games**0.5), 1000 * float(np.median(seconds))


def tag_game(seed: int) -> tuple[Any, Any, Any, Any, Callable[..., Any]]:
    """(model, the world it is played in, start, belief, update)."""
    model, rng = tag(), np.random.default_rng(seed)
    start = rng.integers(29, size=2)
    return model, model, start, TagBelief(int(start[0])), lambda b, a, o: b.updated(model.data, a, int(o))


def rock_game(size: int, rocks: int) -> Callable[[int], tuple[Any, Any, Any, Any, Callable[..., Any]]]:
    model = rock_sample(size, rocks)

    def game(seed: int) -> tuple[Any, Any, Any, Any, Callable[..., Any]]:
        belief = RockBelief(model.data)
        return (
            model,
            model,
            belief.sample(1, np.random.default_rng(seed))[0],
            belief,
            lambda b, a, o: b.updated(a, int(o)),
        )

    return game


def laser_game(seed: int) -> tuple[Any, Any, Any, Any, Callable[..., Any]]:
    model = laser_tag(seed)
    start = np.random.default_rng(seed).integers(model.data.cells, size=2)
    return model, model, start, LaserTagBelief(model.data, int(start[0])), lambda b, a, o: b.updated(a, int(o))


def dark_game(binned: bool) -> Callable[[int], tuple[Any, Any, Any, Any, Callable[..., Any]]]:
    def game(seed: int) -> tuple[Any, Any, Any, Any, Callable[..., Any]]:
        world = light_dark()
        belief = ParticleFilter(world, light_dark_start, FilterOptions(count=10_000), rng=seed)
        model = light_dark_binned(0.05) if binned else world
        return model, world, light_dark_start(1, np.random.default_rng(seed))[0], belief, lambda b, a, o: b.update(a, o)

    return game


def pomcp(simulations: int, exploration: float, **more: Any) -> Callable[[Any], Any]:
    return lambda model: Pomcp(model, PomcpOptions(simulations, exploration, DISCOUNT, **more))


def despot(seconds: float, **more: Any) -> Callable[[Any], Any]:
    return lambda model: Despot(model, DespotOptions(trials=10**6, seconds=seconds, discount=DISCOUNT, **more))


def pomcpow(simulations: int, exploration: float) -> Callable[[Any], Any]:
    return lambda model: Pomcpow(model, PomcpowOptions(simulations, exploration, discount=DISCOUNT, max_depth=20))


def tiger_rows() -> Iterator[tuple[str, Any]]:
    """(what is run, planner) of Tiger."""
    for simulations in (100, 1000, 10_000):
        yield f"POMCP, {simulations:,} simulations", Pomcp(tiger(), PomcpOptions(simulations, 50.0, DISCOUNT))
    options = DespotOptions(trials=100, discount=DISCOUNT, reward_bounds=(-100, 10))
    yield "DESPOT, 100 trials", Despot(tiger(), options)


def rows(problem: str) -> Iterator[tuple[str, Callable[[int], Any], Callable[[Any], Any]]]:
    """(what is run, game, planner) of a problem."""
    if problem == "tag":
        for simulations, exploration in ((100, 10.0), (1000, 10.0), (10_000, 20.0)):
            yield f"POMCP, {simulations:,} simulations", tag_game, pomcp(simulations, exploration)
        yield "DESPOT, 0.1 s", tag_game, despot(0.1)
    elif problem.startswith("rocksample"):
        game = rock_game(*map(int, problem.split("-")[1:]))
        for simulations in (100, 1000, 10_000):
            yield f"POMCP, {simulations:,} simulations", game, pomcp(simulations, 10.0)
        yield "DESPOT, 0.1 s", game, despot(0.1)
    elif problem == "lasertag":
        for simulations in (100, 1000, 10_000):
            yield f"POMCP, {simulations:,} simulations", laser_game, pomcp(simulations, 10.0)
        yield "DESPOT, 0.1 s", laser_game, despot(0.1, regularisation=0.01)
    else:
        for simulations in (1000, 10_000):
            yield f"POMCP on bins, {simulations:,} simulations", dark_game(True), pomcp(simulations, 90.0, max_depth=20)
            yield f"POMCPOW, {simulations:,} simulations", dark_game(False), pomcpow(simulations, 90.0)


def run(game: Callable[[int], Any], planner_of: Callable[[Any], Any], games: int) -> tuple[float, float, float]:
    """(mean return, standard error, median milliseconds of a plan)."""
    returns, seconds = [], list[float]()
    for seed in range(games):
        model, world, start, belief, update = game(seed)
        planner = planner_of(model)
        latest: list[tuple[int, Any]] = []

        def choose(held: Any, rng: np.random.Generator) -> int:
            asks = isinstance(planner, Pomcp) and model.prior is not None and latest  # noqa: B023
            plan = planner.plan(held.sample, rng, **({"latest": latest[-1]} if asks else {}))  # noqa: B023
            seconds.append(plan.seconds)
            return int(plan.action)

        def follow(held: Any, action: int, observation: Any) -> Any:
            latest.append((action, observation))  # noqa: B023
            return update(held, action, observation)  # noqa: B023

        returns.append(play(world, start, belief, choose, follow, seed, max_steps=90).discounted(DISCOUNT))
    return float(np.mean(returns)), float(np.std(returns, ddof=1) / games**0.5), 1000 * float(np.median(seconds))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--games", type=int, default=100, help="games a row, >= 2")
    parser.add_argument("--problems", nargs="+", choices=list(PUBLISHED), default=list(PUBLISHED))
    arguments = parser.parse_args()
    if arguments.games < 2:
        parser.error("--games must be >= 2")
    for problem in arguments.problems:
        print(f"{problem:<44}{'return':>8}{'+- s.e.':>9}{'ms/move':>9}   ({arguments.games} games)")
        for name, planner in tiger_rows() if problem == "tiger" else ():
            mean, error, milliseconds = tiger_value(planner, arguments.games)
            print(f"  {name:<42}{mean:>8.2f}{error:>9.2f}{milliseconds:>9.2f}", flush=True)
        for name, game, planner_of in () if problem == "tiger" else rows(problem):
            mean, error, milliseconds = run(game, planner_of, arguments.games)
            print(f"  {name:<42}{mean:>8.2f}{error:>9.2f}{milliseconds:>9.2f}", flush=True)
        print(f"  published: {PUBLISHED[problem]}\n", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
