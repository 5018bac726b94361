"""Time and memory of solving TAB-Fields, beside the same recursion written plainly with SciPy's sparse products.

    python benchmarks/field_speed.py              # the table
    python benchmarks/field_speed.py --scaling    # cost over cells, automaton states and ticks, and its plot

Each row is measured in processes of its own, one thread, compiled code loaded before the clock starts. Seconds are CPU
seconds, the quickest of `--repeats`; memory is the process's peak, everything included (Python with its libraries is
about 0.2 GB of it). Both sides solve the same `FieldProblem`; their log-partitions are compared.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import sparse

from tab_marl.field import FieldOptions, FieldProblem, TabField, solve
from tab_marl.mission import MISSIONS
from tab_marl.world.scenario import Scenario
from tab_marl.world.solids import Cuboid
from tab_marl.world.volume import BallCheckpoint, Volume

LAB = replace(Scenario.preset("lab"), horizon_seconds=30.0, step_seconds=0.5)
M5 = MISSIONS["M5"].replace("[x,y]", "[1.5, 0.5]")
TANK = Volume(
    name="tank",
    width_metres=10.4,
    depth_metres=10.4,
    height_metres=8.4,
    checkpoints=tuple(
        BallCheckpoint(f"Ball {i}", x, y, z, radius_metres=0.6)
        for i, (x, y, z) in enumerate([(2, 8, 2), (8, 8, 6), (8, 2, 2), (2, 5, 6)], start=1)
    ),
    adversary_start=Cuboid(1, 1, 1, 2, 2, 2),
    step_seconds=0.5,
    horizon_seconds=100.0,
)
PICTURE = Path(__file__).parents[1] / "docs" / "images" / "field-scaling.svg"


def m5(reference: str, **options: object) -> FieldProblem:
    settings = {
        "cell_metres": 0.05,
        "reference": reference,
        "goal_marginals": 0.0,
        "memory_gigabytes": 16.0,
    } | options
    return FieldProblem.from_mission(M5, LAB, FieldOptions(**settings))  # type: ignore[arg-type]


def tank() -> FieldProblem:
    options = FieldOptions(cell_metres=0.2, reference="walk", goal_marginals=0.0)
    return FieldProblem.from_mission("Reach Ball 1 then Ball 2 then Ball 3 then Ball 4 within 100 s", TANK, options)


CASES: dict[str, Callable[[], FieldProblem]] = {
    "M5, 5 cm, walk": lambda: m5("walk"),
    "M5, 5 cm, run-and-tumble": lambda: m5("run_and_tumble"),
    "M5, 5 cm, run-and-tumble, everywhere": lambda: m5("run_and_tumble", only_reachable=False),
    "M5, 5 cm, run-and-tumble, equal goals": lambda: m5("run_and_tumble", goal_marginals=1.0),
    "3-D, 4 stages, 200 ticks, walk": tank,
}
WITHOUT_SCIPY = ("M5, 5 cm, run-and-tumble, everywhere", "M5, 5 cm, run-and-tumble, equal goals")
"""Other ways to solve problems that have a row of their own, or several passes."""


def scipy_backward(problem: FieldProblem) -> float:
    """log Z of the start by backward messages in double precision: all automaton states of one rank at a time."""
    automaton, reference = problem.automaton, problem.reference
    labels, modes = np.repeat(np.asarray(problem.labels), reference.modes), reference.modes
    states, cells = reference.states, reference.states // reference.modes
    at = reference.indptr
    moves = [
        sparse.csr_array(
            (reference.data[at[r * states] : at[(r + 1) * states]], reference.indices[at[r * states] : at[(r + 1) * states]],
             at[r * states : (r + 1) * states + 1] - at[r * states]),
            shape=(states, states),
        )
        for r in range(reference.count)
    ]  # fmt: skip
    for matrix in moves:
        matrix.eliminate_zeros()
    h = np.zeros((len(automaton.delta), states))
    h[automaton.accepting] = 1.0
    which = np.asarray(problem.reference_of)
    every = np.arange(states)
    transient = np.setdiff1d(np.arange(len(h)), [automaton.initial, automaton.accepting, automaton.rejecting])
    for rank in np.unique(automaton.rank[transient])[::-1]:
        for r in range(reference.count):
            group = transient[(automaton.rank[transient] == rank) & (which[transient] == r)]
            if len(group):
                ahead = h[automaton.delta[group][:, labels], every]
                moved = moves[r] @ np.ascontiguousarray(ahead.T)
                if modes > 1:
                    moved = reference.mix[r] @ moved.reshape(cells, modes, len(group))
                h[group] = moved.reshape(states, len(group)).T
    used = np.flatnonzero(np.asarray(problem.start) > 0)
    first = automaton.delta[automaton.initial, np.asarray(problem.labels)[used]]
    shares = reference.mode_shares()
    mass = h.reshape(len(h), cells, modes)[first, used] @ shares
    return float(np.asarray(problem.start)[used] @ np.log(mass))


def timed(work: Callable[[], object]) -> tuple[float, object]:
    began = time.process_time()
    found = work()
    return time.process_time() - began, found


def measure(name: str, side: str, repeats: int) -> dict[str, float]:
    """In this process: build, solve, and what they took."""
    build = CASES[name]
    warm = FieldOptions(cell_metres=0.25, goal_marginals=float("equal" in name), reference=build().options.reference)
    solve(FieldProblem.from_mission("Reach any two different checkpoints within 20s", LAB, warm))
    seconds, building = [], []
    field: TabField | float
    for _ in range(repeats):
        took, problem = timed(build)
        assert isinstance(problem, FieldProblem)
        building.append(took)
        field = 0.0  # the last one's memory is free again
        took, found = timed((lambda p=problem: solve(p)) if side == "ours" else (lambda p=problem: scipy_backward(p)))
        seconds.append(took)
        assert isinstance(found, (TabField, float))
        field = found
        del found
    log_partition = field.log_partition if isinstance(field, TabField) else field
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return {
        "seconds": min(seconds),
        "building": min(building),
        "gigabytes": peak / 1e9,
        "messages": len(problem.automaton.delta) * problem.reference.states,
        "cells": problem.reference.states // problem.reference.modes,
        "automaton": len(problem.automaton.delta),
        "log_partition": log_partition,
        "passes": field.rounds if isinstance(field, TabField) else 1,
    }


def in_its_own_process(name: str, side: str, repeats: int) -> dict[str, float]:
    environment = os.environ | {key: "1" for key in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    command = [sys.executable, __file__, "--case", name, "--side", side, "--repeats", str(repeats)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{name} ({side}) failed:\n{done.stderr}")
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def table(repeats: int) -> None:
    import numba
    import scipy
    from rich.console import Console
    from rich.table import Table

    rows = Table(title="Solving a TAB-Field: CPU seconds on one core, peak memory of the process")
    for heading in ("problem", "messages", "s", "GB", "SciPy s", "SciPy GB", "times faster", "log Z differs by"):
        rows.add_column(heading, justify="left" if heading == "problem" else "right")
    for name in CASES:
        ours = in_its_own_process(name, "ours", repeats)
        row = [
            f"{name} ({ours['automaton']:,.0f} x {ours['cells']:,.0f})", f"{ours['messages'] / 1e6:,.1f} M",
            f"{ours['seconds']:.2f}", f"{ours['gigabytes']:.2f}",
        ]  # fmt: skip
        if name in WITHOUT_SCIPY:
            row += ["", "", "", f"{ours['passes']:.0f} passes" if ours["passes"] > 1 else ""]
        else:
            peer = in_its_own_process(name, "scipy", 1)
            row += [
                f"{peer['seconds']:.2f}", f"{peer['gigabytes']:.2f}", f"{peer['seconds'] / ours['seconds']:.1f}",
                f"{abs(ours['log_partition'] - peer['log_partition']):.1g}",
            ]  # fmt: skip
        rows.add_row(*row)
    about = Path("/proc/cpuinfo")
    lines = about.read_text().splitlines() if about.exists() else []
    cpu = next((line.split(":")[1].strip() for line in lines if "model name" in line), platform.processor())
    console = Console(width=150)
    console.print(rows)
    console.print(
        f"{cpu}, {os.cpu_count()} cores (one used), load {os.getloadavg()[0]:.1f}; Python {platform.python_version()}, "
        f"NumPy {np.__version__}, SciPy {scipy.__version__}, numba {numba.__version__}"
    )


PLACES = ("Checkpoint A", "Checkpoint B", "Checkpoint C", "Checkpoint D", "Checkpoint E")


def sized(cell_metres: float, stages: int, ticks: int) -> FieldProblem:
    words = "Reach " + ", then ".join(PLACES[:stages]) + f" within {ticks * 0.5} s"
    scenario = replace(LAB, obstacles=(), horizon_seconds=ticks * 0.5)
    options = FieldOptions(cell_metres=cell_metres, reference="walk", goal_marginals=0.0, only_reachable=False)
    return FieldProblem.from_mission(words, scenario, options)


def scaling(repeats: int) -> None:
    """Time against each of the three sizes alone; prints the slopes on logarithmic axes and draws them."""
    import matplotlib

    matplotlib.use("svg")
    from matplotlib import pyplot

    families: dict[str, list[FieldProblem]] = {
        "cells": [sized(metres, 2, 100) for metres in (0.042, 0.03, 0.021, 0.015, 0.0105)],
        "automaton states": [sized(0.03, stages, 400) for stages in (1, 2, 3, 4, 5)],
        "ticks": [sized(0.03, 2, ticks) for ticks in (120, 240, 480, 960)],
    }
    solve(families["cells"][0])
    figure, panels = pyplot.subplots(1, 3, figsize=(9, 3), layout="constrained", sharey=True)
    for panel, (name, problems) in zip(panels, families.items(), strict=True):
        sizes, seconds = [], []
        for problem in problems:
            automaton = problem.automaton
            size = {
                "cells": problem.cells,
                "automaton states": len(automaton.delta),
                "ticks": int(automaton.rank.max()) - 1,
            }
            sizes.append(size[name])
            seconds.append(min(timed(lambda p=problem: solve(replace(p)))[0] for _ in range(repeats)))
        slope, height = np.polyfit(np.log(sizes), np.log(seconds), 1)
        print(
            f"{name:18} slope {slope:.2f}   "
            + "   ".join(f"{n:,}: {t:.3f} s" for n, t in zip(sizes, seconds, strict=True))
        )
        panel.loglog(sizes, seconds, "o", color="tab:blue")
        panel.loglog(
            sizes,
            np.exp(height) * np.array(sizes, dtype=float) ** slope,
            "-",
            color="tab:blue",
            lw=1,
            label=f"slope {slope:.2f}",
        )
        middle = np.exp(np.mean(np.log(seconds) - np.log(sizes)))
        panel.loglog(sizes, middle * np.array(sizes, dtype=float), "--", color="0.6", lw=1, label="linear")
        panel.set_yticks([0.03, 0.1, 0.3], labels=["0.03", "0.1", "0.3"])
        panel.set_xticks(sizes[::2], labels=[f"{size:,}" for size in sizes[::2]])
        panel.minorticks_off()
        panel.set_xlabel(name)
        panel.legend(frameon=False)
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("CPU seconds")
    figure.savefig(PICTURE)
    print(f"wrote {PICTURE}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--scaling", action="store_true")
    parser.add_argument("--case", choices=CASES, help="one measurement in this process, as JSON")
    parser.add_argument("--side", choices=("ours", "scipy"), default="ours")
    given = parser.parse_args()
    if given.case:
        print(json.dumps(measure(given.case, given.side, given.repeats)))
    elif given.scaling:
        scaling(given.repeats)
    else:
        table(given.repeats)


if __name__ == "__main__":
    main()
