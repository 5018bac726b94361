"""The code on the planning pages runs, as a reader would paste it: block after block, from each block of imports of numpy on."""

from __future__ import annotations

import linecache
import re
import warnings
from pathlib import Path

import pytest

from tab_marl.planning import PlainPythonWarning

FOLDER = Path(__file__).parent.parent.parent / "docs" / "planning"


def programs(page):
    """Blocks that begin with an import, each group of them up to the next ``import numpy``; what comes before is a fragment."""
    blocks = re.findall(r"```python\n(.*?)```", (FOLDER / page).read_text(), flags=re.DOTALL)
    grouped = []
    for block in blocks:
        if "import numpy" in block:
            grouped.append([])
        if grouped:
            grouped[-1].append(block)
    return ["\n".join(group) for group in grouped]


CASES = [(f"{page}-{i}", text) for page in ("engine.md", "beliefs.md") for i, text in enumerate(programs(page))]


def test_there_is_code():
    assert len(CASES) == 4


@pytest.mark.parametrize(("name", "text"), CASES, ids=[name for name, _ in CASES])
def test_code_on_the_page_runs(name, text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # compiled functions are kept beside their file, so the program needs one
    (tmp_path / "program.py").write_text(text)
    linecache.checkcache()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PlainPythonWarning)
        exec(compile(text, str(tmp_path / "program.py"), "exec"), {"__name__": "program"})  # noqa: S102, our own page
    assert capsys.readouterr().out
    assert name != "beliefs.md-0" or (tmp_path / "tree.svg").stat().st_size > 1000
