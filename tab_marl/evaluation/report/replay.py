"""Replays: which episodes are shown, what is recorded of them, and how that travels inside one HTML file."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tab_marl.evaluation.rows import EpisodeRow, scored_completed, scored_steps
from tab_marl.evaluation.settings import FAMILIES, HEADLINE, MISSIONS, PAPER_PLANNERS
from tab_marl.evaluation.tables import order
from tab_marl.evaluation.units import Unit
from tab_marl.world.regions import Box, Disc, Region
from tab_marl.world.scenario import Scenario

BELIEF_CELL_METRES = 0.1
"""Beliefs are stored at this resolution."""
BELIEF_LEVELS = 15
"""Steps of opacity in a stored belief."""


@dataclass
class Trace:
    """What is recorded of one episode."""

    hertz: int
    poses: list[tuple[float, float, float, float, float, float, bool]] = field(default_factory=list)
    """Per control step from 0: x, y, theta of the ego, then of the adversary, and whether a camera sees the latter."""
    beliefs: list[tuple[int, NDArray[np.float64]]] = field(default_factory=list)
    """(control step, image ``[rows, columns]``, row 0 at the bottom) at each decision."""
    events: list[tuple[float, str]] = field(default_factory=list)
    """(seconds, what happened)."""


@dataclass(frozen=True)
class Choice:
    """An episode to be shown, and why this one."""

    unit: Unit
    why: str


def choose(rows: Sequence[EpisodeRow], count: int) -> list[Choice]:
    """Episodes by rules that do not look for flattering ones, and that say what they look for.

    First a typical one (outcomes closest to the averages) of the family where prediction matters most; then the one in
    which the paper's planners differ most; then one that TAB-POMCP lost and a rival won; then typical ones of the
    other families and missions.
    """
    chosen: list[Choice] = []

    def take(key: tuple[str, str, int] | None, why: str) -> None:
        if key is not None and len(chosen) < count and all(choice.unit != Unit(*key) for choice in chosen):
            chosen.append(Choice(Unit(*key), why))

    present = {r.family for r in rows}
    families = [f for f in ("ambiguous", *FAMILIES) if f in present]
    families = list(dict.fromkeys(families + order(present, FAMILIES)))
    missions = order([r.mission for r in rows], MISSIONS)
    pairs = sorted(
        ((f, m) for m in missions for f in families),
        key=lambda pair: (missions.index(pair[1]), families.index(pair[0])),
    )
    for number, (family, mission) in enumerate(pairs):
        part = [r for r in rows if r.family == family and r.mission == mission]
        take(_typical(part), f"the most typical episode of {mission}, {family}: closest to the averages of the table")
        if number == 0:
            take(_widest(rows), "the episode of all in which the paper’s four planners differ most; not a typical one")
            take(_upset(rows), "an episode that TAB-POMCP lost and a rival won")
    return chosen


def _units(rows: Sequence[EpisodeRow]) -> dict[tuple[str, str, int], dict[str, EpisodeRow]]:
    units: dict[tuple[str, str, int], dict[str, EpisodeRow]] = {}
    for row in rows:
        if row.error is None and row.planner in PAPER_PLANNERS:
            units.setdefault((row.mission, row.family, row.seed), {})[row.planner] = row
    most = max((len(u) for u in units.values()), default=0)
    return {key: u for key, u in units.items() if len(u) == most}


def _typical(rows: Sequence[EpisodeRow]) -> tuple[str, str, int] | None:
    units = _units(rows)
    if not units:
        return None
    planners = sorted(next(iter(units.values())))
    steps = np.array([[scored_steps(u[p]) / u[p].horizon_steps for p in planners] for u in units.values()])
    done = np.array([[scored_completed(u[p]) for p in planners] for u in units.values()], dtype=float)
    distance = ((steps - steps.mean(axis=0)) ** 2 + (done - done.mean(axis=0)) ** 2).sum(axis=1)
    return list(units)[int(np.argmin(distance))]


def _widest(rows: Sequence[EpisodeRow]) -> tuple[str, str, int] | None:
    units = _units(rows)
    if not units:
        return None

    def spread(unit: dict[str, EpisodeRow]) -> float:
        lost = [float(scored_completed(r)) for r in unit.values()]
        return float(np.ptp(lost) + np.std(lost) + np.std([scored_steps(r) / r.horizon_steps for r in unit.values()]))

    return max(sorted(units), key=lambda key: spread(units[key]))


def _upset(rows: Sequence[EpisodeRow]) -> tuple[str, str, int] | None:
    for key, unit in sorted(_units(rows).items(), key=lambda item: item[0][2]):
        if HEADLINE in unit and unit[HEADLINE].completed and any(not r.completed for r in unit.values()):
            return key
    return None


def encode_trace(trace: Trace) -> dict[str, Any]:
    """JSON of a trace: poses in millimetres and centiradians, beliefs run-length encoded."""
    poses = np.array([p[:6] for p in trace.poses], dtype=np.float64).reshape(-1, 6)
    scaled = np.rint(poses * np.array([1000, 1000, 100, 1000, 1000, 100])).astype(int)
    shape = trace.beliefs[0][1].shape if trace.beliefs else (0, 0)
    return {
        "hertz": trace.hertz,
        "poses": scaled.T.tolist(),
        "seen": "".join("1" if p[6] else "0" for p in trace.poses),
        "beliefRows": shape[0],
        "beliefColumns": shape[1],
        "beliefs": [[step, encode_image(image)] for step, image in trace.beliefs],
        "events": [[round(seconds, 2), text] for seconds, text in trace.events],
    }


def quantised(image: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Levels 0 to BELIEF_LEVELS, by the square root of the share of the largest value: thin mass stays visible."""
    values = np.nan_to_num(np.maximum(image, 0.0))
    top = float(values.max())
    if top <= 0:
        return np.zeros(values.shape, dtype=np.uint8)
    return np.rint(BELIEF_LEVELS * np.sqrt(values / top)).astype(np.uint8)


def encode_image(image: NDArray[np.float64]) -> str:
    """Base64 of bytes (level << 4 | run length - 1), row by row from the bottom."""
    levels = quantised(image).ravel()
    starts = np.flatnonzero(np.diff(levels, prepend=np.uint8(255)))
    lengths = np.diff(starts, append=len(levels))
    out = bytearray()
    for start, length in zip(starts, lengths, strict=True):
        level = int(levels[start]) << 4
        full, rest = divmod(int(length), 16)
        out += bytes([level | 15]) * full
        if rest:
            out.append(level | (rest - 1))
    return base64.b64encode(bytes(out)).decode()


def decode_image(text: str, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """What the page's script does, for tests: levels ``[rows, columns]``."""
    raw = np.frombuffer(base64.b64decode(text), dtype=np.uint8)
    return np.repeat(raw >> 4, (raw & 15) + 1).reshape(shape)


def shrink(image: NDArray[np.float64], width_metres: float, height_metres: float) -> NDArray[np.float64]:
    """Sum the image's cells into cells of BELIEF_CELL_METRES (an image that is coarser already is left alone)."""
    rows, columns = image.shape
    wanted = round(height_metres / BELIEF_CELL_METRES), round(width_metres / BELIEF_CELL_METRES)
    if rows <= wanted[0] and columns <= wanted[1]:
        return np.nan_to_num(image)
    out = np.zeros(wanted)
    row = np.minimum((np.arange(rows) + 0.5) * wanted[0] / rows, wanted[0] - 1).astype(int)
    column = np.minimum((np.arange(columns) + 0.5) * wanted[1] / columns, wanted[1] - 1).astype(int)
    np.add.at(out, (row[:, None], column[None, :]), np.nan_to_num(image))
    return out


def encode_region(region: Region) -> list[Any]:
    """A region as the page draws it."""
    if isinstance(region, Disc):
        return ["disc", region.x, region.y, region.radius]
    if isinstance(region, Box):
        return ["box", region.x_min, region.y_min, region.x_max, region.y_max]
    return ["polygon", region.vertices().tolist()]


def encode_map(scenario: Scenario, goals: Sequence[Region] = (), forbidden: Sequence[Region] = ()) -> dict[str, Any]:
    """The map of a replay: arena, obstacles, checkpoints with cameras, the mission's goals and forbidden zones."""
    return {
        "width": scenario.width_metres,
        "height": scenario.height_metres,
        "obstacles": [encode_region(o) for o in scenario.obstacles],
        "checkpoints": [
            {
                "label": c.name.removeprefix("Checkpoint "),
                "x": c.x,
                "y": c.y,
                "r": c.radius_metres,
                "camera": c.camera_metres,
            }
            for c in scenario.checkpoints
        ],
        "goals": [encode_region(g) for g in goals],
        "forbidden": [encode_region(f) for f in forbidden],
        "radii": [scenario.ego.radius_metres, scenario.adversary.radius_metres],
        "meet": scenario.interception_metres,
    }
