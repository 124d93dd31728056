"""What goes wrong inside compiled code, raised as an exception of Python's (csrc/guard.hpp)."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

MEMORY = 1
_ROOM = 200


class CompiledFault(RuntimeError):
    """Compiled code has stopped with an exception of its own; its results are void."""


def raise_faults(handle: ctypes.CDLL, read: str, functions: dict[str, str]) -> None:
    """Let functions of a library raise what went wrong in them.

    Args:
        handle: the library.
        read: name of its function that tells the calling thread's last fault.
        functions: their names, with what the caller may do where memory runs out.

    Raises:
        AttributeError: the library is older than faults, or lacks one of the functions.
    """
    last = getattr(handle, read)
    last.restype, last.argtypes = ctypes.c_int32, [ctypes.c_char_p, ctypes.c_int64]
    for name, cure in functions.items():
        getattr(handle, name).errcheck = _raising(last, name, cure)


def _raising(last: Any, name: str, cure: str) -> Callable[[Any, Any, Any], Any]:
    def check(result: Any, function: Any, arguments: Any) -> Any:
        if last(None, 0):
            text = ctypes.create_string_buffer(_ROOM)
            if last(text, _ROOM) == MEMORY:
                raise MemoryError(f"out of memory in {name}; {cure}")
            raise CompiledFault(f"{name}: {text.value.decode('utf-8', 'replace')}")
        return result

    return check
