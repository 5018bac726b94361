"""What `FieldProblem.size()` says before solving, against what solving takes: seconds, bytes, and what pruning leaves.

python benchmarks/field_estimates.py
"""

from __future__ import annotations

import statistics
import time
import tracemalloc

from rich.console import Console
from rich.table import Table

from tab_marl.field import FieldOptions, FieldProblem, solve
from tab_marl.world.scenario import Scenario
from tab_marl.world.solids import Cuboid
from tab_marl.world.volume import BallCheckpoint, Volume

LAB = Scenario.preset("lab")
TANK = Volume(
    "tank",
    (BallCheckpoint("Ball 1", 2, 8, 1, 0.6), BallCheckpoint("Ball 2", 8, 8, 4, 0.6)),
    Cuboid(1, 1, 1, 2, 2, 2),
)
M5 = (
    "Reach target [1.5, 0.4] after visiting any three different checkpoints, taking no more than 10s between "
    "checkpoints, while avoiding the center of the environment"
)
SPACE = "Reach Ball 1 then Ball 2 within 20 s while avoiding the central ball"
CASES = {
    "A within 20 s, default": ("Reach Checkpoint A within 20s", LAB, FieldOptions()),
    "A within 20 s, walk, double": ("Reach Checkpoint A within 20s", LAB, FieldOptions(reference="walk", precision="double")),
    "A then C, unicycle": (
        "Reach Checkpoint A then Checkpoint C within 40s", LAB, FieldOptions(reference="unicycle", cell_metres=0.1),
    ),
    "any of three, default": ("Visit any three different checkpoints within 40s", LAB, FieldOptions(cell_metres=0.1)),
    "M5, mission alone": (M5, LAB, FieldOptions(cell_metres=0.1, goal_marginals=0.0)),
    "M5, default": (M5, LAB, FieldOptions()),
    "3-D, walk, 0.25 m": (SPACE, TANK, FieldOptions(reference="walk", cell_metres=0.25)),
    "3-D, run-and-tumble, 0.5 m": (SPACE, TANK, FieldOptions(cell_metres=0.5)),
}  # fmt: skip


def main() -> None:
    table = Table(title="FieldProblem.size() against what solve() takes, and pruned()")
    for column in ("problem", "messages", "passes: said", "took", "s: said", "took", "ratio", "MB: said", "took", "ratio",
                   "automaton states", "pruned", "s pruned"):  # fmt: skip
        table.add_column(column, justify="left" if column == "problem" else "right")
    for name, (mission, world, options) in CASES.items():
        problem = FieldProblem.from_mission(mission, world, options)
        solve(problem)  # compiled code is taken to be compiled, and a reference derives its arrays once
        said = problem.size()
        seconds, field = _usual(problem)
        tracemalloc.start()
        solve(problem)
        # What the reference holds was there before.
        peak = tracemalloc.get_traced_memory()[1] + said.memory.reference
        tracemalloc.stop()
        smaller = problem.pruned()
        seconds_pruned, _ = _usual(smaller)
        table.add_row(
            name, f"{said.product_states:,}", str(said.passes), str(field.rounds), f"{said.seconds:.3f}", f"{seconds:.3f}",
            f"{said.seconds / seconds:.2f}", f"{said.memory.total / 1e6:.1f}", f"{peak / 1e6:.1f}",
            f"{said.memory.total / peak:.2f}", f"{said.automaton_states:,}", f"{smaller.automaton.states:,}",
            f"{seconds_pruned:.3f}",
        )  # fmt: skip
    Console(width=200).print(table)


def _usual(problem: FieldProblem) -> tuple[float, object]:
    taken, field = [], None
    while len(taken) < 3:
        start = time.thread_time()
        field = solve(problem)
        taken.append(time.thread_time() - start)
    return statistics.median(taken), field


if __name__ == "__main__":
    main()
