"""What a file may do to its reader: damage that HDF5 reports in many ways, and sizes that it does not hold."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import h5py

from .errors import RecordingError

# deflate packs at most 1032 bytes into one (zlib's documentation, "Maximum Compression Factor"); lzf far fewer
PACKED = 1100
# bytes that may be declared without being on the disk: datasets that hold their fill value alone
UNWRITTEN = 1 << 26
SHOWN = 200


@contextmanager
def reading(source: str, dataset: str, rule: str = "cannot be read") -> Iterator[None]:
    """Name whatever goes wrong in the block: HDF5 and h5py know OSError, RuntimeError, KeyError, TypeError and more.

    Args:
        source: the file.
        dataset: what is being read of it.
        rule: what is to be said of it, before the cause.

    Raises:
        RecordingError: anything but a lack of memory went wrong.
    """
    try:
        yield
    except (RecordingError, MemoryError):
        raise
    except Exception as fault:
        cause = brief(str(fault) if isinstance(fault, OSError) else f"{type(fault).__name__}: {fault}", quoted=False)
        text = f"{rule} ({cause}): it is damaged or not of this format; copy or write the file again"
        raise RecordingError(source, dataset, text) from fault


def brief(value: object, *, quoted: bool = True) -> str:
    """A value in a message: no longer than a line or two, whatever the file holds."""
    text = " ".join((repr(value) if quoted else str(value)).split())
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def refuse_oversized(nodes: Mapping[str, h5py.Dataset], size: int, source: str) -> None:
    """Refuse a file that declares more than it can hold, before anything is read.

    Args:
        nodes: the datasets, by name.
        size: bytes of the file.
        source: its name.

    Raises:
        RecordingError: reading would take more memory than the compressions allowed can have packed.
    """
    declared = {dataset: _bytes(node) for dataset, node in nodes.items()}
    if sum(declared.values()) > UNWRITTEN + PACKED * size:
        dataset = max(declared, key=lambda name: declared[name])
        rule = (
            f"declares {declared[dataset]:.3g} bytes in the shape {nodes[dataset].shape}, but the whole file has {size}"
        )
        raise RecordingError(source, dataset, f"{rule}; write the values, or leave the dataset out")


def _bytes(node: h5py.Dataset) -> int:
    """Memory that reading takes: whole chunks are unpacked, of which the last ones may stick out of the dataset."""
    extents = node.shape
    if node.chunks is not None:
        extents = [max(extent, chunk) for extent, chunk in zip(node.shape, node.chunks, strict=True)]
    return math.prod(extents) * node.dtype.itemsize
