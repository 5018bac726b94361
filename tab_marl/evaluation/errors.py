"""What a user did that cannot work, in one line that says what to do instead."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager


class UserError(Exception):
    """Shown on one line without a traceback; the command ends with a status other than 0."""


class Interrupted(Exception):
    """The run was asked to stop; what was finished is stored."""


@contextmanager
def user_input() -> Iterator[None]:
    """Inside, a ValueError speaks of what the user gave."""
    try:
        yield
    except ValueError as error:
        raise UserError(" ".join(str(error).split())) from error


def require_known(kind: str, names: Sequence[str], known: Iterable[str]) -> tuple[str, ...]:
    """The names in their own spelling, case and order as given. Raises UserError with the nearest known name."""
    table = {name.casefold(): name for name in known}
    found = []
    for name in names:
        match = table.get(name.casefold())
        if match is None:
            close = difflib.get_close_matches(name.casefold(), table, n=1, cutoff=0.4)
            hint = f"did you mean {table[close[0]]!r}?" if close else f"known: {', '.join(table.values())}"
            raise UserError(f"no {kind} named {name!r}: {hint}")
        found.append(match)
    repeated = sorted({name for name in found if found.count(name) > 1})
    if repeated:
        raise UserError(f"{kind} {', '.join(repeated)} is named twice")
    return tuple(found)


def user_message(error: Exception) -> str | None:
    """One line for an error that the user can mend; None for one that is ours."""
    import sqlite3

    if any(kind.__module__.startswith("tab_marl.") for kind in type(error).__mro__):
        return _one_line(str(error))  # every exception that the package defines is written for its users
    if hasattr(error, "format_message"):  # the command line parser's own errors
        return " ".join(str(error.format_message()).split())
    if isinstance(error, OSError):
        name = f"{error.filename}: " if error.filename else ""
        return f"{name}{error.strerror or error}"
    if isinstance(error, sqlite3.OperationalError):
        return f"the store cannot be used: {error}"
    if isinstance(error, MemoryError):
        return "out of memory: use fewer --workers"
    return None


def _one_line(text: str) -> str:
    """The text on one line, without carets that point at a line above."""
    lines = [" ".join(line.split()) for line in text.splitlines() if line.strip(" ^")]
    return "; ".join(lines).replace(":; ", ": ")
