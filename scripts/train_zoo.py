"""Train, measure and write the policies that ship in agents/zoo: ``python scripts/train_zoo.py``.

Each style is trained as `TrainingSettings.for_style` says, and beside them two direct policies with other seeds, the
controls against which a style's own figure must move. An interrupted run continues when started again.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tab_marl.agents.release import release
from tab_marl.agents.training import Progress
from tab_marl.agents.zoo import SHIPPED
from tab_marl.envs.styles import STYLES


def show(name: str, stand: Progress) -> None:
    """One line per tenth of a run."""
    if stand.done * 10 // stand.total != getattr(show, "last", None):
        show.last = stand.done * 10 // stand.total  # type: ignore[attr-defined]
        print(f"{name}: {stand.phase} {stand.done} of {stand.total}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("styles", nargs="*", help="styles to train; default: all")
    parser.add_argument("--runs", type=Path, default=Path("runs/zoo"), help="folder of the training runs")
    parser.add_argument("--zoo", type=Path, default=SHIPPED, help="folder that the policies are written to")
    parser.add_argument("--tasks", type=int, default=300, help="held-out tasks that the policies are measured on")
    parser.add_argument("--steps", type=int, help="control steps per policy; default: the settings'")
    arguments = parser.parse_args()
    for line in release(
        arguments.styles or list(STYLES), arguments.runs, arguments.zoo, arguments.tasks, arguments.steps, show
    ):
        print(line, flush=True)
