"""Processes that are started from here."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

# One process per core already: libraries that start threads of their own only get in each other's way.
SINGLE_THREADED = {
    name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
}


@contextmanager
def environment(values: dict[str, str]) -> Iterator[None]:
    """These environment variables inside, and what was there before afterwards."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
