"""Large tables of which little is used."""

from __future__ import annotations

import mmap

import numpy as np
from numpy.typing import DTypeLike

from tab_marl.field.chain import Table

LAZY_BYTES = 2**26
"""From this size on a table takes memory page by page, as it is written."""


def zeros(shape: tuple[int, int], dtype: DTypeLike) -> Table:
    """A table of zeros; a large one takes memory only where it is written, in pages as small as the system has."""
    size = shape[0] * shape[1] * np.dtype(dtype).itemsize
    if size < LAZY_BYTES or not hasattr(mmap, "MAP_PRIVATE"):
        return np.zeros(shape, dtype=dtype)
    # NumPy asks for huge pages, which a few written cells would fill.
    pages = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    if hasattr(mmap, "MADV_NOHUGEPAGE"):
        pages.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(pages, dtype=dtype).reshape(shape)
