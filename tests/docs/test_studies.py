"""The planner study's page: its rows are what the script prints from the committed episodes, and its code runs."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
STUDIES = ROOT / "docs" / "studies"
PAGE = (STUDIES / "planner.md").read_text()
ROW = re.compile(r"^  \S.*\d+ +[\d.]+ \[.*\]")
"""A line of the script: variant, episodes, share, interval."""


def test_the_rows_on_the_page_are_those_of_the_episodes() -> None:
    printed: set[str] = set()
    for rows, reference in (("planner.csv", "tree 20 ms"), ("planner-final.csv", "tree 50 ms")):
        command = [sys.executable, "scripts/study_planner_report.py", str(STUDIES / rows), "--reference", reference]
        output = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
        printed.update(line.rstrip() for line in output.splitlines())
    section = PAGE.split("## The rows")[1].split("\n## ")[0]
    shown = [line.rstrip() for line in section.splitlines() if ROW.match(line)]
    assert len(shown) > 50
    assert not set(shown) - printed


def test_code_on_the_page_runs() -> None:
    (block,) = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(block, "planner.md", "exec"), names)  # noqa: S102, our own page
    assert getattr(names["planner"], "name", None) == "TAB-POMCP+precedents"
