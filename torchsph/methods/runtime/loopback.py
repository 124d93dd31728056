"""Gloo over the machine's own loopback: no name has to be resolved, and nothing is open to the network."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

# by which gloo is told the network interface
_INTERFACE = "GLOO_SOCKET_IFNAME"


@contextmanager
def over_loopback(wanted: bool = True) -> Iterator[None]:
    """Groups that are made meanwhile speak over the loopback, where it is wanted and there is one."""
    name = next((name for _, name in socket.if_nameindex() if name in ("lo", "lo0")), None) if wanted else None
    if name is None:
        yield
        return
    before = os.environ.get(_INTERFACE)
    os.environ[_INTERFACE] = name
    try:
        yield
    finally:
        if before is None:
            del os.environ[_INTERFACE]
        else:
            os.environ[_INTERFACE] = before
