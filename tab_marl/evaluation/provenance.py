"""What made a run's rows: versions, machine, settings, zoo, commit. No host or user name, no path of the machine."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from tab_marl.evaluation.claims import StoredRun
from tab_marl.evaluation.settings import EvaluationSettings

# Every library that a row's content or an episode's time can depend on.
LIBRARIES = (
    "tab-marl", "numpy", "scipy", "numba", "llvmlite", "pymunk", "gymnasium", "pettingzoo", "safetensors", "pydantic",
    "lark", "torch", "stable-baselines3", "sb3-contrib", "ray",
)  # fmt: skip
DECISIVE = ("numpy", "scipy", "numba", "llvmlite", "pymunk", "safetensors")
"""Libraries whose versions must agree between machines that play one store's rows: they compute them."""


def run_record(
    settings: EvaluationSettings, code: str, zoo: Mapping[str, str], engine: Mapping[str, Any]
) -> dict[str, Any]:
    """The record of a run that begins now.

    Args:
        settings: what was asked for.
        code: `settings.code_fingerprint`.
        zoo: policy name -> SHA-256 of its weights.
        engine: what plays: name, workers, nodes.
    """
    return {
        "code": code,
        "commit": commit(),
        "engine": dict(engine),
        "machine": machine(),
        "python": platform.python_version(),
        "settings": portable(settings),
        "versions": versions(),
        "zoo": dict(zoo),
    }


def portable(settings: EvaluationSettings) -> dict[str, Any]:
    """The settings as JSON values; folders of policies by their last part alone."""
    import dataclasses

    values = dataclasses.asdict(settings)
    return values | {"adversaries": [last_part(name) for name in settings.adversaries]}


def last_part(name: str) -> str:
    """A policy's name, or the last part of its folder's path."""
    return Path(name).name if os.sep in name else name


def versions(names: Sequence[str] = LIBRARIES) -> dict[str, str]:
    """Installed version of each library; those not installed are left out."""
    found = {}
    for name in names:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def machine() -> dict[str, Any]:
    """Processor model, cores that may be used, memory, operating system."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "processor": _processor(),
        "cores": cores,
        "memory_gib": _memory_gib(),
        "system": f"{platform.system()} {platform.release().split('-')[0]}",
        "architecture": platform.machine(),
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return " ".join(line.partition(":")[2].split())
    except OSError:
        pass
    return platform.processor() or "unknown"


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (AttributeError, OSError, ValueError):  # Windows has no sysconf
        return None


def commit() -> str | None:
    """Commit of the checkout that the package runs from, "+changes" if files differ from it; None if it is installed."""
    here = Path(__file__).resolve().parent

    def git(*arguments: str) -> str | None:
        try:
            done = subprocess.run(
                ["git", "-C", str(here), *arguments], capture_output=True, text=True, timeout=20, check=False
            )
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    # The checkout of some other project that this package is installed inside of does not count.
    if git("ls-files", "--error-unmatch", Path(__file__).name) is None:
        return None
    found = git("rev-parse", "HEAD")
    if found is None:
        return None
    return found + ("+changes" if git("status", "--porcelain", "--untracked-files=no") else "")


def describe_runs(runs: Sequence[StoredRun]) -> list[dict[str, str]]:
    """Each run in words, for a page: started, ended, played, machine, engine, commit, versions, zoo."""
    return [_describe(run) for run in runs]


def _describe(run: StoredRun) -> dict[str, str]:
    record = run.record
    box = record.get("machine", {})
    memory = "" if box.get("memory_gib") is None else f", {box['memory_gib']:g} GiB"
    engine = record.get("engine", {})
    played_on = ", ".join(f"{key} {value}" for key, value in engine.items() if key != "name")
    zoo = record.get("zoo", {})
    return {
        "run": str(run.run),
        "started": run.started,
        "ended": run.ended or "was killed, or still plays",
        "outcome": run.outcome or "",
        "episodes": str(run.played),
        "engine": f"{engine.get('name', '')} ({played_on})" if played_on else str(engine.get("name", "")),
        "machine": f"{box.get('processor')}, {box.get('cores')} cores{memory}, {box.get('system')} {box.get('architecture')}",
        "commit": record.get("commit") or "installed, no checkout",
        "code": record.get("code", ""),
        "versions": ", ".join(
            [f"Python {record.get('python')}", *(f"{name} {v}" for name, v in record.get("versions", {}).items())]
        ),
        "zoo": ", ".join(f"{name} {digest[:12]}" for name, digest in zoo.items()),
    }


def identity(code: str) -> dict[str, str]:
    """What must be equal on every machine that plays rows of one store."""
    major, minor, _ = platform.python_version_tuple()
    return {"code": code, "Python": f"{major}.{minor}", **versions(DECISIVE)}


def differences(ours: Mapping[str, str], theirs: Mapping[str, str]) -> str:
    """In words, what differs; empty if nothing does."""
    return ", ".join(
        f"{name} {theirs.get(name, 'missing')} instead of {ours[name]}"
        for name in ours
        if theirs.get(name) != ours[name]
    )
