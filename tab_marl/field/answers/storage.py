"""Fields on disk: one ``.npz`` of plain arrays and a JSON header, versioned and checked when read. Nothing in it is executed.

Kept are the problem and the fitted weights; the messages follow from them by one backward pass, which `load_field` makes.
So files stay small, and what is read is consistent by construction.
"""

from __future__ import annotations

import json
import math
import zipfile
from dataclasses import asdict, fields
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from tab_marl.field.constraints.events import Tracker
from tab_marl.field.constraints.report import ConstraintFit, FitReport
from tab_marl.field.constraints.tilt import Tilt
from tab_marl.field.constraints.tracking import TrackedAutomaton, Tracking
from tab_marl.field.infeasible import InfeasibleField
from tab_marl.field.problem import FieldOptions, FieldProblem
from tab_marl.field.reference import Reference
from tab_marl.field.tab_field import TabField
from tab_marl.mission.serialise import mission_from_json, mission_to_json
from tab_marl.mission.unroll import TickAutomaton
from tab_marl.world.grid import GridMap
from tab_marl.world.scenario import Scenario
from tab_marl.world.volume import Volume
from tab_marl.world.voxels import VoxelMap

FORMAT, VERSION = "tab_marl.field", 1
MOST_BYTES = 8_000_000_000
"""Of a file's arrays once unpacked: beyond it the file is refused before anything is allocated."""
MOST_BRANCHES = 10_000
GRIDS: dict[str, type[GridMap | VoxelMap]] = {"GridMap": GridMap, "VoxelMap": VoxelMap}
WORLDS: dict[str, type[Scenario | Volume]] = {"Scenario": Scenario, "Volume": Volume}
REFERENCE = ("indptr", "indices", "data", "mix", "headings", "jump", "redraw", "first")
AUTOMATON = ("delta", "masks", "rank", "location", "branch", "mission_ticks", "stage_ticks", "speed_limit", "clocks")


class FieldFormatError(ValueError):
    """A file that holds no field that this version can read: says which part and what it must be."""


def save_field(field: TabField, path: str | Path) -> None:
    """See `TabField.save`. Raises OSError."""
    problem, tilt = field.problem, field.tilt
    arrays: dict[str, NDArray[Any]] = {f"reference.{n}": getattr(problem.reference, n) for n in REFERENCE}
    arrays |= {f"automaton.{n}": getattr(problem.automaton, n) for n in AUTOMATON}
    for name in ("labels", "start", "reference_of", "earliest_tick", "stage", "status"):
        arrays[f"problem.{name}"] = np.asarray(getattr(problem, name))
    arrays["weights"] = tilt.log_weight()
    if field.fitted_transitions is not None:
        arrays["transitions"] = field.fitted_transitions
    grid = problem.grid
    if grid is not None:
        arrays |= {f"grid.{n}": getattr(grid, n) for n in _grid_arrays(type(grid))}
    trackers = []
    if problem.tracking is not None:
        for name in ("parent_state", "parent_symbol", "decided", "happens"):
            arrays[f"tracking.{name}"] = getattr(problem.tracking, name)
        for k, t in enumerate(problem.tracking.trackers):
            arrays |= {f"tracker{k}.labels": t.labels, f"tracker{k}.delta": t.delta}
            trackers.append({n: getattr(t, n) for n in ("name", "initial", "happened", "ruled_out", "with_mission")})
    header = {
        "format": FORMAT,
        "version": VERSION,
        "horizon": int(problem.horizon),
        "options": asdict(problem.options),
        "branch_places": list(problem.branch_places),
        "stage_names": list(problem.stage_names),
        "absorbing": [int(getattr(problem.automaton, n)) for n in ("initial", "accepting", "rejecting")],
        "sides": [int(side) for side in problem.automaton.sides],
        "grid": None if grid is None else {"kind": type(grid).__name__, "cell_metres": grid.cell_metres},
        "world": None if problem.scenario is None else type(problem.scenario).__name__,
        "scenario": None if problem.scenario is None else _plain(problem.scenario),
        "mission": None if problem.mission is None else json.loads(mission_to_json(problem.mission)),
        "trackers": trackers,
        "log_failure": tilt.log_failure if math.isfinite(tilt.log_failure) else None,
        "marginal_error": float(field.marginal_error),
        "rounds": int(field.rounds),
        "report": None if field.report is None else asdict(field.report),
    }
    text = json.dumps(header, allow_nan=False).encode()
    with Path(path).open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, header=np.frombuffer(text, dtype=np.uint8), **arrays)


def load_field(path: str | Path) -> TabField:
    """See `TabField.load`. Raises FieldFormatError, OSError."""
    from tab_marl.field.solve import message

    try:
        header, arrays = _read(Path(path))
        problem = _problem(header, arrays)
        weight = _array(arrays, "weights", "f", problem.automaton.delta.shape)
        if np.isnan(weight).any() or (weight == np.inf).any():
            raise FieldFormatError("weights: must be numbers or -inf")
        failure = header["log_failure"]
        tilt = Tilt.given(problem, weight, -math.inf if failure is None else float(failure))
        transitions = None
        if "transitions" in arrays:
            transitions = _array(arrays, "transitions", "f", weight.shape)
        report = header["report"]
        if report is not None:
            rows = tuple(ConstraintFit(**row) for row in report.pop("constraints"))
            report = FitReport(rows, **report)
        chain = message(problem, tilt)
        return TabField(
            problem, chain, tilt, transitions, float(header["marginal_error"]), int(header["rounds"]), report
        )
    except FieldFormatError as error:
        raise FieldFormatError(f"{path}: {error}") from None
    except KeyError as error:
        raise FieldFormatError(
            f"{path}: the part {error} is missing: the file is damaged, save the field again"
        ) from None
    except (InfeasibleField, ValidationError, ValueError, TypeError, IndexError, AttributeError) as error:
        raise FieldFormatError(f"{path}: not a valid field: {' '.join(str(error).split())[:300]}") from None


def _plain(world: Scenario | Volume) -> Any:
    return TypeAdapter(type(world)).dump_python(world, mode="json")


def _read(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    try:
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            total = sum(member.file_size for member in archive.infolist())
            if total > MOST_BYTES:
                raise FieldFormatError(f"holds {total:.2e} bytes unpacked, more than the {MOST_BYTES:.0e} allowed")
            arrays = {}
            for member in archive.infolist():
                with archive.open(member) as part:
                    arrays[member.filename.removesuffix(".npy")] = _plain_array(part, member)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError) as error:
        raise FieldFormatError(f"not a field file (.npz written by TabField.save): {error}") from None
    try:
        header = json.loads(arrays.pop("header").tobytes())
    except (KeyError, UnicodeDecodeError, json.JSONDecodeError):
        raise FieldFormatError("has no readable header: not a field file written by TabField.save") from None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise FieldFormatError(f"is not a field file: its format is not {FORMAT!r}")
    if header.get("version") != VERSION:
        raise FieldFormatError(
            f"has version {header.get('version')!r}, this program reads version {VERSION}: save it again with this version"
        )
    return header, arrays


def _plain_array(part: IO[bytes], member: zipfile.ZipInfo) -> NDArray[Any]:
    """An array of numbers; the header is compared with the bytes there are before anything is allocated."""
    try:
        version = np.lib.format.read_magic(part)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(part)
    except (ValueError, SyntaxError, TypeError) as error:
        raise FieldFormatError(f"{member.filename}: not a NumPy array: {error}") from None
    if dtype.kind not in "biuf" or dtype.hasobject:
        raise FieldFormatError(f"{member.filename}: has elements of type {dtype}, only numbers are read")
    needed = math.prod(shape) * dtype.itemsize
    if needed > member.file_size:
        raise FieldFormatError(f"{member.filename}: claims {needed} bytes, holds {member.file_size}")
    content = part.read(needed)
    if len(content) != needed:
        raise FieldFormatError(f"{member.filename}: ends after {len(content)} of {needed} bytes")
    flat = np.frombuffer(content, dtype=dtype)
    return flat.reshape(shape[::-1]).T if fortran else flat.reshape(shape)


def _array(arrays: dict[str, NDArray[Any]], name: str, kinds: str, shape: tuple[int | None, ...]) -> NDArray[Any]:
    """A contiguous copy; raises FieldFormatError unless kind and shape fit (None: any length)."""
    found = arrays[name]
    fits = len(found.shape) == len(shape) and all(n is None or n == m for n, m in zip(shape, found.shape, strict=True))
    if not fits or found.dtype.kind not in kinds:
        wanted = "[" + ", ".join("?" if n is None else str(n) for n in shape) + "]"
        raise FieldFormatError(f"{name}: is {found.dtype} {list(found.shape)}, must be {wanted} of kind {kinds}")
    return np.array(found, order="C")


def _within(name: str, array: NDArray[Any], low: int, high: int) -> NDArray[Any]:
    if array.size and (array.min() < low or array.max() > high):
        raise FieldFormatError(f"{name}: has entries in {array.min()}..{array.max()}, must lie in {low}..{high}")
    return array


def _problem(header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> FieldProblem:
    motion = _reference(arrays)
    automaton = _automaton(header, arrays, tracked="tracking.decided" in arrays)
    count, symbols = automaton.delta.shape
    cells = motion.states // motion.modes
    world = None
    if header["world"] is not None:
        world = TypeAdapter(WORLDS[header["world"]]).validate_python(header["scenario"])
    earliest = arrays["problem.earliest_tick"]
    return FieldProblem(
        motion,
        _within("problem.labels", _array(arrays, "problem.labels", "i", (cells,)), 0, symbols - 1),
        automaton,
        _array(arrays, "problem.start", "f", (cells,)),
        int(header["horizon"]),
        FieldOptions(**header["options"]),
        _array(arrays, "problem.reference_of", "i", (count,)),
        _grid(header, arrays, cells),
        world,
        tuple(str(name) for name in header["branch_places"]),
        earliest_tick=int(earliest) if earliest.ndim == 0 else _array(arrays, "problem.earliest_tick", "i", (cells,)),
        stage=_array(arrays, "problem.stage", "i", (count,)),
        stage_names=tuple(str(name) for name in header["stage_names"]),
        status=_within("problem.status", _array(arrays, "problem.status", "i", (count,)), 0, 2),
        mission=None if header["mission"] is None else mission_from_json(json.dumps(header["mission"])),
        tracking=_tracking(header, arrays, automaton, cells),
    )


def _reference(arrays: dict[str, NDArray[Any]]) -> Reference:
    mix = _array(arrays, "reference.mix", "f", (None, None, None))
    count, modes = mix.shape[:2]
    indptr = _array(arrays, "reference.indptr", "i", (None,))
    indices = _array(arrays, "reference.indices", "i", (None,))
    data = _array(arrays, "reference.data", "f", (len(indices),))
    rows = len(indptr) - 1
    if rows < 1 or count < 1 or modes < 1 or mix.shape[2] != modes or rows % (count * modes):
        raise FieldFormatError(f"reference: {rows} rows do not fit {count} references of {modes} modes")
    if indptr[0] != 0 or indptr[-1] != len(indices) or (np.diff(indptr) < 0).any():
        raise FieldFormatError("reference.indptr: must rise from 0 to the number of entries")
    _within("reference.indices", indices, 0, rows // count - 1)
    for name, array in (("data", data), ("mix", mix)):
        if not (np.isfinite(array) & (array >= 0)).all():
            raise FieldFormatError(f"reference.{name}: must be finite and >= 0")
    sums = np.add.reduceat(np.append(data, 0.0), indptr[:-1]) * (np.diff(indptr) > 0)
    if sums.max(initial=0.0) > 1 + 1e-9 or np.abs(mix.sum(axis=2) - 1).max() > 1e-9:
        raise FieldFormatError("reference: a row of probabilities does not sum to 1 or less")
    jump = _array(arrays, "reference.jump", "f", (count, modes))
    redraw = _array(arrays, "reference.redraw", "f", (count, modes))
    if not (np.isfinite(jump).all() and np.isfinite(redraw).all()):
        raise FieldFormatError("reference.jump and reference.redraw: must be finite")
    return Reference(
        indptr.astype(np.int64), indices.astype(np.int32), data, mix,
        _array(arrays, "reference.headings", "f", (modes,)), jump, redraw, _array(arrays, "reference.first", "b", (modes,)),
    )  # fmt: skip


def _automaton(header: dict[str, Any], arrays: dict[str, NDArray[Any]], tracked: bool) -> TickAutomaton:
    delta = _array(arrays, "automaton.delta", "i", (None, None))
    count, symbols = delta.shape
    _within("automaton.delta", delta, 0, count - 1)
    initial, accepting, rejecting = (int(q) for q in header["absorbing"])
    for q in (initial, accepting, rejecting):
        if not 0 <= q < count:
            raise FieldFormatError(f"absorbing: {q} is no state, must lie in 0..{count - 1}")
    for q in (accepting, rejecting):
        if (delta[q] != q).any():
            raise FieldFormatError(f"automaton.delta: the absorbing state {q} must lead to itself")
    shapes: dict[str, tuple[int | None, ...]] = {
        "masks": (symbols,), "branch": (count, symbols), "clocks": (count, 3), "delta": (count, symbols),
    }  # fmt: skip
    parts = {
        name: _array(arrays, f"automaton.{name}", "f" if name == "speed_limit" else "i", shapes.get(name, (count,)))
        for name in AUTOMATON
    }
    _within("automaton.branch", parts["branch"], -1, len(header["branch_places"] or range(MOST_BRANCHES)) - 1)
    return (TrackedAutomaton if tracked else TickAutomaton)(
        initial=initial, accepting=accepting, rejecting=rejecting, sides=tuple(header["sides"]), **parts
    )


def _grid_arrays(kind: type) -> list[str]:
    return [f.name for f in fields(kind) if f.name != "cell_metres"]


def _grid(header: dict[str, Any], arrays: dict[str, NDArray[Any]], cells: int) -> GridMap | VoxelMap | None:
    if header["grid"] is None:
        return None
    kind = GRIDS[header["grid"]["kind"]]
    size = float(header["grid"]["cell_metres"])
    if not (math.isfinite(size) and size > 0):
        raise FieldFormatError(f"grid.cell_metres: is {size}, must be > 0")
    parts = {name: np.array(arrays[f"grid.{name}"], order="C") for name in _grid_arrays(kind)}
    for name, part in parts.items():
        if name != "cell_at" and len(part) != cells:
            raise FieldFormatError(f"grid.{name}: has {len(part)} rows, must have {cells}, one per cell")
    _within("grid.cell_at", parts["cell_at"], -1, cells - 1)
    for name, low in (("row", 0), ("column", 0), ("index", 0)):
        if name in parts:
            _within(f"grid.{name}", parts[name], low, max(parts["cell_at"].shape) - 1)
    if not np.isfinite(parts["centres"]).all():
        raise FieldFormatError("grid.centres: must be finite")
    return kind(cell_metres=size, **parts)


def _tracking(
    header: dict[str, Any], arrays: dict[str, NDArray[Any]], automaton: TickAutomaton, cells: int
) -> Tracking | None:
    if "tracking.decided" not in arrays:
        return None
    count, symbols = automaton.delta.shape
    trackers = tuple(
        Tracker(
            labels=_array(arrays, f"tracker{k}.labels", "i", (cells,)),
            delta=_array(arrays, f"tracker{k}.delta", "i", (None, None)),
            **given,
        )
        for k, given in enumerate(header["trackers"])
    )
    k = len(trackers)
    return Tracking(
        trackers,
        _array(arrays, "tracking.parent_state", "i", (count,)),
        _array(arrays, "tracking.parent_symbol", "i", (symbols,)),
        _array(arrays, "tracking.decided", "i", (k, count)),
        _array(arrays, "tracking.happens", "b", (k, count, symbols)),
    )
