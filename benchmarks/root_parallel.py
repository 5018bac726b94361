"""Several cores against one: simulations per second of wall-clock time on Tag.

    python benchmarks/root_parallel.py                # 1 and 2 workers on Tag
    python benchmarks/root_parallel.py --workers 4

Each worker grows a tree of its own and the trees are laid over each other; the speed-up
counts simulations, merging included. The quickest of `--repeats` identical plans counts.
"""

from __future__ import annotations

import argparse
import os
import time

import numpy as np

from tab_marl.planning import Pomcp, PomcpOptions
from tab_marl.planning.textbook import TagBelief, tag


def seconds_of(planner: Pomcp, belief: object, repeats: int) -> float:
    planner.plan(belief, 0)  # compiles, or loads
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        planner.plan(belief, 0)
        times.append(time.perf_counter() - started)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args()
    if arguments.workers < 2 or arguments.repeats < 1:
        parser.error("--workers must be >= 2 and --repeats >= 1")
    belief = TagBelief(4).sample(2000, np.random.default_rng(0))
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; Tag, history-aware rollout")
    print(
        f"{'simulations':>12}{'k sims/s, 1':>14}{f'k sims/s, {arguments.workers}':>14}{'speed-up':>10}{'same tree again':>17}"
    )
    for simulations in (1_000, 10_000, 100_000, 400_000):
        one, several = (
            Pomcp(tag(), PomcpOptions(simulations=simulations, exploration=10.0, workers=workers))
            for workers in (1, arguments.workers)
        )
        slow, fast = (seconds_of(planner, belief, arguments.repeats) for planner in (one, several))
        first, second = several.plan(belief, 1).tree, several.plan(belief, 1).tree
        same = first.nodes.tobytes() == second.nodes.tobytes() and first.edges.tobytes() == second.edges.tobytes()
        print(
            f"{simulations:>12,}{simulations / slow / 1e3:>14,.0f}{simulations / fast / 1e3:>14,.0f}"
            f"{slow / fast:>10.2f}{'yes' if same else 'NO':>17}",
            flush=True,
        )


if __name__ == "__main__":
    main()
