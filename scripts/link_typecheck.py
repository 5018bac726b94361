"""Lay out the package as it is imported, in build/typecheck, so that mypy, pyright and import-linter can follow it.

`envs/` and `agents/` import as `tab_marl.envs` and `tab_marl.agents` through setuptools' package-dir, which static
tools do not execute. This script links the three folders together the way the installed package looks.
"""

from __future__ import annotations

import shutil
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def link() -> Path:
    """Empty and refill build/typecheck/tab_marl; returns build/typecheck."""
    folder = ROOT / "build" / "typecheck"
    package = folder / "tab_marl"
    if package.exists():
        shutil.rmtree(package)
    package.mkdir(parents=True)
    for entry in (ROOT / "tab_marl").iterdir():
        if entry.name != "__pycache__":
            (package / entry.name).symlink_to(entry)
    for name in ("envs", "agents"):
        (package / name).symlink_to(ROOT / name)
    return folder


if __name__ == "__main__":
    print(link())
