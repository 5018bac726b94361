"""The three folders are one distribution: nothing forgotten in the wheel, nothing claimed on the user's machine."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_package_on_disk_is_listed() -> None:
    mapped = {"tab_marl.envs": "envs", "tab_marl.agents": "agents"}
    found = {".".join(p.parent.relative_to(ROOT).parts) for p in (ROOT / "tab_marl").rglob("__init__.py")}
    for name, folder in mapped.items():
        for init in (ROOT / folder).rglob("__init__.py"):
            found.add(".".join([name, *init.parent.relative_to(ROOT / folder).parts]))
    assert found == set(PROJECT["tool"]["setuptools"]["packages"])


def test_package_data_patterns_match_files() -> None:
    for package, patterns in PROJECT["tool"]["setuptools"]["package-data"].items():
        name = (
            package.removeprefix("tab_marl.") if package.startswith(("tab_marl.agents", "tab_marl.envs")) else package
        )
        folder = ROOT / name.replace(".", "/")
        for pattern in patterns:
            assert list(folder.glob(pattern)), f"{package}: nothing matches {pattern}"


def test_import_from_elsewhere_and_plain_names_stay_free(tmp_path: Path) -> None:
    code = (
        "import importlib.util, tab_marl.envs, tab_marl.agents; "
        "assert importlib.util.find_spec('envs') is None; assert importlib.util.find_spec('agents') is None"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
