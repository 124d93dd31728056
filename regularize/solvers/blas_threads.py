"""One thread for the routines of SciPy's BLAS, whose sums otherwise depend on how many threads it was started with."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import scipy

_SET, _GET = "scipy_openblas_set_num_threads", "scipy_openblas_get_num_threads"


@contextmanager
def one_thread() -> Iterator[None]:
    """SciPy's own OpenBLAS works with one thread inside; another BLAS, which has no such switch, is left alone."""
    found = _openblas()
    if found is None:
        yield
        return
    before = int(getattr(found, _GET)())
    getattr(found, _SET)(1)
    try:
        yield
    finally:
        getattr(found, _SET)(before)


@lru_cache(maxsize=1)
def _openblas() -> ctypes.CDLL | None:
    """The library that a wheel of SciPy brings along, which is loaded already."""
    package = Path(scipy.__file__).parent
    for folder in (package.parent / "scipy.libs", package / ".dylibs"):
        for path in sorted(folder.glob("libscipy_openblas*")):
            library = ctypes.CDLL(str(path))
            if hasattr(library, _SET) and hasattr(library, _GET):
                return library
    return None
