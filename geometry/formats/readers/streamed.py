"""Arrays that lie one value after the other in a file, plain or packed, read a block at a time."""

from __future__ import annotations

import io
import math
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO

import numpy as np

from geometry.formats.source import FormatError
from geometry.recordings.odd_files import PACKED

STEP = 1 << 16  # bytes unpacked at a time


class Streamed:
    """An array in a stream of bytes; blocks that follow one another are read without going back.

    Args:
        path: of the file, for messages.
        opened: opens the stream.
        start: bytes before the first value.
        shape: sizes of its axes.
        dtype: of its values, with their byte order.
        order: "C" where the last axis runs fastest, "F" where the first one does.
        stored: bytes of the file that the values lie in.
        packed: whether they are packed there.

    Raises:
        FormatError: so many values cannot lie in so many bytes.
    """

    def __init__(
        self,
        path: Path,
        opened: Callable[[], IO[bytes]],
        start: int,
        shape: tuple[int, ...],
        dtype: np.dtype,
        *,
        order: str,
        stored: int,
        packed: bool,
    ) -> None:
        needed = math.prod(shape) * dtype.itemsize
        if needed > (PACKED * stored if packed else stored):
            raise FormatError(
                f"{path}: claims {shape} values, {needed:.3g} bytes, but holds {stored}; write the file again"
            )
        self._path, self._opened, self._start = path, opened, start
        self.shape, self.dtype, self.order = shape, dtype, order
        self._packed, self._at = packed, 0
        self._stream: IO[bytes] | None = None

    def close(self) -> None:
        """Close the stream; the next block opens it again."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def __getitem__(self, index: tuple) -> np.ndarray:
        span = self._span(index)
        if span is None:
            return self._values(0, self.shape)[index]
        first, shape = span
        return self._values(first, shape)

    def _span(self, index: tuple) -> tuple[int, tuple[int, ...]] | None:
        """The first value and the shape of a block whose values follow one another; None for any other index."""
        if len(index) != len(self.shape) or not all(isinstance(part, slice) for part in index):
            return None
        bounds = [part.indices(size) for part, size in zip(index, self.shape, strict=True)]
        if any(step != 1 for _, _, step in bounds):
            return None
        slow_first = range(len(bounds)) if self.order == "C" else range(len(bounds))[::-1]
        cut = False
        first, stride = 0, math.prod(self.shape)
        for axis in slow_first:
            begin, end, _ = bounds[axis]
            if cut and (begin, end) != (0, self.shape[axis]):
                return None
            cut = cut or end - begin > 1
            stride //= max(self.shape[axis], 1)
            first += begin * stride
        return first, tuple(max(end - begin, 0) for begin, end, _ in bounds)

    def _values(self, first: int, shape: tuple[int, ...]) -> np.ndarray:
        begin = self._start + first * self.dtype.itemsize
        if self._packed and begin < self._at:
            self.close()  # a packed stream goes back by starting over, which gzip does from the file's first byte
        if self._stream is None:
            self._stream = self._opened()
        values = np.empty(shape, self.dtype, self.order)  # type: ignore[call-overload]
        flat = memoryview(values.reshape(-1, order=self.order).view(np.uint8))
        try:
            self._stream.seek(begin)
            done = 0
            while done < len(flat):
                count = self._stream.readinto(flat[done:])  # type: ignore[attr-defined]
                if not count:
                    raise EOFError
                done += count
        except (EOFError, zlib.error, OSError) as fault:
            text = f"{self._path}: ends before its {self.shape} values do, or is damaged; copy or write the file again"
            raise FormatError(text) from fault
        self._at = begin + len(flat)
        return values


class Inflated(io.RawIOBase):
    """The bytes that a zlib stream in a file unpacks to; going back starts over.

    Args:
        file: opened, of its own.
        start: where the stream begins in it.
    """

    def __init__(self, file: IO[bytes], start: int) -> None:
        super().__init__()
        self._file, self._start = file, start
        self._rewind()

    def _rewind(self) -> None:
        self._file.seek(self._start)
        self._unpack, self._at = zlib.decompressobj(), 0

    def readable(self) -> bool:
        """It is."""
        return True

    def seekable(self) -> bool:
        """It is, backwards at the price of unpacking from the start."""
        return True

    def readinto(self, target: memoryview) -> int:  # type: ignore[override]
        """Fill a buffer as far as one step of unpacking does; 0 at the end."""
        while not self._unpack.eof:
            packed = self._unpack.unconsumed_tail or self._file.read(STEP)
            values = self._unpack.decompress(packed, len(target))
            if values:
                target[: len(values)] = values
                self._at += len(values)
                return len(values)
            if not packed:
                break
        return 0

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place from the start."""
        if whence != io.SEEK_SET:
            raise io.UnsupportedOperation("only from the start")
        if offset < self._at:
            self._rewind()
        scratch = memoryview(bytearray(min(STEP, max(offset - self._at, 1))))
        while self._at < offset:
            if not self.readinto(scratch[: offset - self._at]):
                raise EOFError
        return self._at

    def close(self) -> None:
        """Close the file below."""
        self._file.close()
        super().close()
