"""Adversary tasks packed into flat arrays, so that one compiled loop can serve many robots with different missions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tab_marl.envs import adversary_kernels as k
from tab_marl.envs.lidar import Lidar
from tab_marl.envs.styles import Latents
from tab_marl.mission.automaton import COMPLETED, FAILED, MissionAutomaton
from tab_marl.mission.fences import zones
from tab_marl.mission.route import RouteField
from tab_marl.world.regions import Disc, Region
from tab_marl.world.scenario import Scenario

CAMERA_SHY_SCALE = 6.0
"""What the camera cost is divided by before it is observed."""
LATENT_MAX = 2.0
"""Observed latents stop here."""


class Tables(NamedTuple):
    """Flat arrays of K tasks; `number`, `field` and `real` hold each task's offsets and figures (columns: kernels)."""

    number: NDArray[np.int64]
    """``[K, NUMBERS]``."""
    field: NDArray[np.int64]
    """``[K, 2, FIELD_NUMBERS]``: the plain and the styled route."""
    real: NDArray[np.float64]
    """``[K, REALS]``."""
    cell_at: NDArray[np.int32]
    nearest: NDArray[np.int32]
    centres: NDArray[np.float64]
    symbol: NDArray[np.int32]
    route_table: NDArray[np.int32]
    cost: NDArray[np.float32]
    distance: NDArray[np.float32]
    length: NDArray[np.float32]
    to_visit: NDArray[np.float32]
    next_cell: NDArray[np.int32]
    next_location: NDArray[np.int32]
    forbidden_until: NDArray[np.int32]
    progress: NDArray[np.bool_]
    resets: NDArray[np.bool_]
    patient: NDArray[np.bool_]
    earliest: NDArray[np.int32]
    latest: NDArray[np.int32]
    speed_limit: NDArray[np.float64]
    window: NDArray[np.int32]
    forbids: NDArray[np.bool_]
    disc: NDArray[np.float64]
    region_first: NDArray[np.int64]
    halfplanes: NDArray[np.float64]
    corners: NDArray[np.float64]
    region_centre: NDArray[np.float64]
    region_reach: NDArray[np.float64]
    """No point of the region is farther than this from its centre, metres."""
    ray_discs: NDArray[np.float64]
    ray_edges: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Parts:
    """What one task puts into the tables."""

    scenario: Scenario
    automaton: MissionAutomaton
    plain: RouteField
    styled: RouteField
    """The same object as `plain` in the direct style."""
    via: NDArray[np.float64]
    """``[0..2, 2]`` metres."""
    via_home: int
    latents: Latents
    strength: float
    windows: NDArray[np.int32]
    """``[U, 2]`` `later_windows`."""


def later_windows(automaton: MissionAutomaton, horizon_ticks: int) -> NDArray[np.int32]:
    """``[U, 2]``: earliest and latest mission clock at which what comes *after* the current location must be done.

    The loosest over the ways the mission can go on; 0 and the horizon where nothing bounds it.
    """
    u = automaton.locations
    follows = np.zeros((u, u + 1), dtype=bool)
    for v in range(u):
        following = np.unique(automaton.next_location[v])
        following = following[(following != v) & (following != FAILED)]
        follows[v, np.where(following == COMPLETED, u, following)] = True
    early = np.full(u + 1, k.UNBOUNDED, dtype=np.int64)
    late = np.full(u + 1, -1, dtype=np.int64)
    early[u], late[u] = 0, horizon_ticks
    own_early, own_late = automaton.earliest[:, 0].astype(np.int64), automaton.latest[:, 0].astype(np.int64)
    own_early = np.where(automaton.patient, 0, own_early)
    after_early, after_late = early[:u].copy(), late[:u].copy()
    for _ in range(u + 1):
        before = (early.copy(), late.copy())
        after_early = np.where(follows, early, k.UNBOUNDED).min(axis=1)
        after_late = np.where(follows, late, -1).max(axis=1)
        early[:u], late[:u] = np.maximum(own_early, after_early), np.minimum(own_late, after_late)
        if np.array_equal(before[0], early) and np.array_equal(before[1], late):
            break
    after_late = np.where(after_late < 0, horizon_ticks, after_late)
    after_early = np.where(after_early >= k.UNBOUNDED, 0, after_early)
    return np.stack([after_early, after_late], axis=1).astype(np.int32)


class _Pool:
    """Arrays laid end to end. What belongs to the same owner (an automaton, a grid, a route) is stored once."""

    def __init__(self) -> None:
        self._chunks: list[NDArray[np.generic]] = []
        self._at: dict[int, int] = {}
        self._owners: list[object] = []
        self._rows = 0

    def add(self, array: NDArray[np.generic], rows: int, owner: object) -> int:
        """The offset of the array, in rows."""
        known = self._at.get(id(owner))
        if known is not None:
            return known
        at = self._rows
        self._at[id(owner)] = at
        self._owners.append(owner)  # keeps the id from being given to another object
        self._chunks.append(array)
        self._rows += rows
        return at

    def join(self, dtype: type, tail: tuple[int, ...]) -> NDArray[np.generic]:
        flat: list[NDArray[Any]] = [np.asarray(chunk, dtype=dtype).reshape(-1, *tail) for chunk in self._chunks]
        # One unused row keeps the offsets of empty parts valid.
        flat.append(np.zeros((1, *tail), dtype=dtype))
        return np.ascontiguousarray(np.concatenate(flat))


# Element type and shape of a row of each pool; int32 scalars where nothing else is said.
_ROWS: dict[str, tuple[type, tuple[int, ...]]] = {
    "centres": (np.float64, (2,)), "cost": (np.float32, (16,)), "resets": (np.bool_, (3,)),
    "earliest": (np.int32, (3,)), "latest": (np.int32, (3,)), "window": (np.int32, (2,)),
    "disc": (np.float64, (4,)), "halfplanes": (np.float64, (3,)), "corners": (np.float64, (4,)),
    "region_centre": (np.float64, (2,)), "region_reach": (np.float64, ()), "ray_discs": (np.float64, (3,)), "ray_edges": (np.float64, (4,)),
    "distance": (np.float32, ()), "length": (np.float32, ()), "to_visit": (np.float32, ()),
    "progress": (np.bool_, ()), "patient": (np.bool_, ()), "forbids": (np.bool_, ()),
    "speed_limit": (np.float64, ()),
}  # fmt: skip


def pack(parts: Sequence[Parts]) -> Tables:
    """The tables of these tasks, in order."""
    pools = {name: _Pool() for name in Tables._fields if name not in ("number", "field", "real", "region_first")}
    first: list[int] = [0]
    number = np.zeros((len(parts), k.NUMBERS), dtype=np.int64)
    field = np.zeros((len(parts), 2, k.FIELD_NUMBERS), dtype=np.int64)
    real = np.zeros((len(parts), k.REALS))
    for i, part in enumerate(parts):
        _pack_automaton(part, pools, number[i])
        _pack_map(part, pools, number[i], first)
        _pack_route(part.plain, pools, field[i, k.PLAIN])
        _pack_route(part.styled, pools, field[i, k.STYLED])
        number[i, [k.VIAS, k.VIA_HOME]] = len(part.via), part.via_home
        _fill_real(part, real[i])
    joined = {name: pool.join(*_ROWS.get(name, (np.int32, ()))) for name, pool in pools.items()}
    return Tables(number=number, field=field, real=real, region_first=np.array(first, dtype=np.int64), **joined)  # type: ignore[arg-type]


def _pack_automaton(part: Parts, pools: dict[str, _Pool], number: NDArray[np.int64]) -> None:
    automaton = part.automaton
    u, labels = automaton.next_location.shape
    regions = len(automaton.regions)
    horizon = round(part.scenario.horizon_seconds / automaton.tick_seconds)
    number[[k.LOCATIONS, k.LABELS, k.PROPOSITIONS]] = u, labels, regions
    number[[k.HORIZON_TICKS, k.INITIAL]] = horizon, automaton.initial
    for name in ("next_location", "forbidden_until", "progress", "resets"):
        number[k.TABLE_AT] = pools[name].add(getattr(automaton, name), u * labels, automaton)
    for name in ("patient", "earliest", "latest", "speed_limit"):
        number[k.LOCATION_AT] = pools[name].add(getattr(automaton, name), u, automaton)
    pools["window"].add(part.windows, u, automaton)
    number[k.FORBIDS_AT] = pools["forbids"].add(zones(automaton), u * regions, automaton)


def _pack_route(route: RouteField, pools: dict[str, _Pool], row: NDArray[np.int64]) -> None:
    cells = len(route.symbol)
    u, labels = route.table.shape
    row[[k.FIELD_LOCATIONS, k.FIELD_LABELS]] = u, labels
    row[k.SYMBOL_AT] = pools["symbol"].add(route.symbol, cells, route)
    row[k.FIELD_TABLE_AT] = pools["route_table"].add(route.table, u * labels, route)
    row[k.COST_AT] = pools["cost"].add(route.cost, cells, route)
    for name in ("distance", "length", "to_visit", "next_cell"):
        row[k.DISTANCE_AT] = pools[name].add(getattr(route, name), u * cells, route)


def _pack_map(part: Parts, pools: dict[str, _Pool], number: NDArray[np.int64], first: list[int]) -> None:
    grid, scenario = part.plain.grid, part.scenario
    rows, columns = grid.cell_at.shape
    number[[k.CELLS, k.ROWS, k.COLUMNS]] = grid.cells, rows, columns
    number[k.GRID_AT] = pools["cell_at"].add(grid.cell_at, rows * columns, grid)
    pools["nearest"].add(part.plain.nearest, rows * columns, grid)
    number[k.CENTRES_AT] = pools["centres"].add(grid.centres, grid.cells, grid)
    regions: list[Region] = [*part.automaton.regions, *scenario.obstacles]
    number[k.REGION_AT] = len(first) - 1
    number[k.OBSTACLES] = len(scenario.obstacles)
    number[k.SUBSTEPS] = scenario.physics_hertz // scenario.control_hertz
    for region in regions:
        disc, planes, corners = outline(region)
        pools["disc"].add(disc, 1, disc)
        pools["region_centre"].add(np.array(region.centre), 1, disc)
        pools["region_reach"].add(np.array([_reach(region)]), 1, disc)
        pools["halfplanes"].add(planes, len(planes), disc)
        pools["corners"].add(corners, len(corners), disc)
        first.append(first[-1] + len(planes))
    lidar = Lidar.of(scenario)
    number[[k.DISCS, k.EDGES]] = len(lidar.discs), len(lidar.edges)
    number[k.DISC_AT] = pools["ray_discs"].add(lidar.discs, len(lidar.discs), lidar)
    number[k.EDGE_AT] = pools["ray_edges"].add(lidar.edges, len(lidar.edges), lidar)


def _fill_real(part: Parts, real: NDArray[np.float64]) -> None:
    scenario, robot, latents = part.scenario, part.scenario.adversary, part.latents
    real[: k.VIA_X] = (
        part.plain.grid.cell_metres, scenario.width_metres, scenario.height_metres, robot.radius_metres,
        robot.max_speed, robot.max_turn_rate, part.automaton.tick_seconds,
    )  # fmt: skip
    real[k.VIA_X : k.VIA_X + len(part.via)] = part.via[:, 0]
    real[k.VIA_Y : k.VIA_Y + len(part.via)] = part.via[:, 1]
    real[k.SIDE] = latents.side * part.strength
    real[k.CAMERA_SHY] = min(part.strength * latents.camera_shy / CAMERA_SHY_SCALE, LATENT_MAX)
    real[k.EDGE_NOISE] = min(part.strength * latents.edge_noise, LATENT_MAX)
    real[k.ARRIVAL_FRACTION] = latents.arrival_fraction


def outline(region: Region) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """A region as a disc row (is disc, x, y, radius), or as sides: outward half-planes ``[V, 3]`` and ends ``[V, 4]``."""
    if isinstance(region, Disc):
        return np.array([1.0, region.x, region.y, region.radius]), np.zeros((0, 3)), np.zeros((0, 4))
    a = region.vertices()
    b = np.roll(a, -1, axis=0)
    edge = b - a
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.hypot(edge[:, 0], edge[:, 1])[:, None]
    return np.zeros(4), np.column_stack([normal, (normal * a).sum(axis=1)]), np.hstack([a, b])


def _reach(region: Region) -> float:
    if isinstance(region, Disc):
        return region.radius
    return float(np.hypot(*(region.vertices() - region.centre).T).max())
