"""Every public call with one argument that is wrong: which are refused clearly, and which do harm.

Sound calls of what `torchsph`, `geometry` and `regularize` export, each with one argument after the other put wrong:
other shapes, types and devices, empty, negative, huge, not finite, out of range. A child process makes each call, with
limits on time and memory; an abuse ends as

- clear: an exception that our own code raises,
- same: the result of the sound call,
- accepted: another result, all of it finite (what was given may well be meant),
- silent: another result, with values in it that are not finite,
- obscure: an exception out of the depths, raised by nobody on purpose,
- crash: the child died, hang: it was stopped.

    python examples/benchmarks/runs/abuses.py [--seconds 600] [--only WORD] [--part 0.2] [--out abuses.json]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import linecache
import math
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from limited_child import in_child, in_children

import geometry
import regularize as reg
import torchsph as ts

HANG = 30.0  # s
KINDS = ("clear", "same", "accepted", "silent", "obscure", "crash", "hang")
HARM = ("silent", "obscure", "crash", "hang")
OURS = tuple(str(Path(package.__file__).parent) for package in (ts, geometry, reg))
NUMBERS: dict[str, object] = {
    "NaN": math.nan,
    "inf": math.inf,
    "-inf": -math.inf,
    "0": 0,
    "-1": -1,
    "1.5": 1.5,
    "1e300": 1e300,
    "1e-300": 1e-300,
    "300": 300,
    "2**63": 2**63,
    "text": "text",
    "True": True,
    "list": [1.0, 2.0],
    "None": None,
}
OTHERS: dict[str, object] = {"None": None, "text": "nonsense", "number": 3.5, "empty": (), "object": object()}


# --- wrong values ----------------------------------------------------------------------------------------


def wrong(value: object) -> Iterator[tuple[str, object]]:
    """Values in the place of a sound one, each with what is wrong about it."""
    if isinstance(value, torch.Tensor):
        yield from ((f"{how} tensor", torch.from_numpy(array)) for how, array in arrays(value.numpy()) if plain(array))
        yield from (("meta", value.to("meta")), ("numpy", value.numpy()), ("list", value.tolist()), ("None", None))
        yield "sparse", value.to_sparse() if value.ndim else None
        yield from (
            ("one of it", value.reshape(-1)[:1].squeeze()),
            ("every other", value.reshape(*value.shape, 1).repeat_interleave(2, -1)[..., 0]),
        )
        if value.is_floating_point():
            yield "with gradient", value.clone().requires_grad_()
    elif isinstance(value, np.ndarray):
        yield from arrays(value)
        yield from (("list", value.tolist()), ("None", None), ("text", "text"))
        yield from (("backwards", value[::-1]), ("masked", np.ma.masked_array(value, mask=value == value.flat[0])))
        yield from (("bytes swapped", value.astype(value.dtype.newbyteorder())), ("tensor", torch.from_numpy(value)))
    elif isinstance(value, bool | int | float):
        yield from NUMBERS.items()
        yield from (("of numpy", np.asarray(value)[()]), ("array of none", np.asarray(value)), ("complex", value + 0j))
        yield from (("tensor of none", torch.tensor(value)), ("meta", torch.tensor(value, device="meta")))
        yield from (
            ("10**400", 10**400),
            ("fraction", Fraction(value)),
            ("bytes", b"1"),
            ("float32", np.float32(value)),
        )
    elif isinstance(value, tuple) and value and all(isinstance(one, int | float) for one in value):
        yield from (("empty", ()), ("shorter", value[:-1]), ("longer", (*value, value[-1])), ("None", None))
        yield from ((f"{how} first", (number, *value[1:])) for how, number in NUMBERS.items())
    elif isinstance(value, geometry.Recording):
        yield from recordings(value)
        yield from OTHERS.items()
    else:
        yield from OTHERS.items()


def plain(array: np.ndarray) -> bool:
    """Whether torch has its type, and takes its strides."""
    return array.dtype.kind in "biufc" and min((*array.strides, 0)) >= 0 and array.dtype.isnative


def arrays(value: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Wrong arrays in the place of a sound one."""
    if value.ndim:
        yield from (("empty", value[:0]), ("one row", value[:1]), ("twice", np.concatenate([value, value])))
        yield from (("an axis less", np.asarray(value[0])), ("transposed", value.T), ("a column less", value[..., :-1]))
        yield "strided", np.repeat(value, 2, axis=0)[::2]
    yield "an axis more", value[None]
    for kind in ("f2", "f4", "f8", "i4", "i8", "u1", "c8", "?"):
        yield kind, value.astype(kind)
    yield "objects", value.astype(object)
    if value.dtype.kind == "b":
        yield from (("nowhere", np.zeros_like(value)), ("everywhere", np.ones_like(value)))
        return
    numbers = (-1, 300, 2**31, 2**40) if value.dtype.kind in "iu" else (math.nan, math.inf, -1.0, 1e30)
    for number in numbers:
        for how, place in (("one", (0,) * value.ndim), ("all", ...)):
            other = value.copy()
            with np.errstate(all="ignore"):
                other[place] = np.asarray(number).astype(value.dtype)
            yield f"{how} {number:g}", other
    yield "all 0", np.zeros_like(value)


def recordings(sound: geometry.Recording) -> Iterator[tuple[str, geometry.Recording]]:
    """Odd recordings in the place of a sound one."""
    broken = sound.velocity.copy()
    broken[0, :, sound.mask[0]] = np.nan
    yield "NaN in a frame", replace(sound, velocity=broken)
    yield from ((f"velocity {size:g}", replace(sound, velocity=size * sound.velocity)) for size in (0.0, 1e3, 1e20))
    yield from (("no node", replace(sound, mask=0 * sound.mask)), ("no wall", replace(sound, wall=None)))
    yield "one frame", sound.select([0])
    yield "time backwards", replace(sound, time=sound.time[::-1].copy())


# --- calls, and what becomes of them ---------------------------------------------------------------------


def told(result: object, depth: int = 0) -> tuple[str, bool]:
    """A fingerprint of a result, and whether all numbers in it are finite."""
    if isinstance(result, torch.Tensor):
        result = result.detach().cpu().numpy() if result.device.type != "meta" else np.empty(0)
    if isinstance(result, np.ndarray):
        finite = result.dtype.kind not in "fc" or bool(np.isfinite(result).all())
        return f"{result.shape}{hash(np.ascontiguousarray(result).tobytes())}", finite
    if isinstance(result, float):
        return repr(result), math.isfinite(result)
    if depth > 4 or result is None or isinstance(result, str | bytes | int):
        return repr(result) if not callable(result) else "callable", True
    parts: list[object]
    if isinstance(result, Mapping):
        parts = list(result.values())
    elif isinstance(result, list | tuple):
        parts = list(result)
    elif is_dataclass(result):
        parts = [getattr(result, part.name) for part in fields(result) if not part.name.startswith("_")]
    else:
        parts = [one for name, one in sorted(getattr(result, "__dict__", {}).items()) if not name.startswith("_")]
    found = [told(part, depth + 1) for part in parts]
    return f"{type(result).__name__}({','.join(text for text, _ in found)})", all(finite for _, finite in found)


def outcome(call: Callable[[], object]) -> tuple[str, str]:
    """How a call ends: "read" with its fingerprint, "silent", "clear" or "obscure" with the message."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            text, finite = told(call())
    except Exception as fault:
        last = traceback.extract_tb(fault.__traceback__)[-1]
        line = (linecache.getline(last.filename, last.lineno or 0)).strip()
        meant = last.filename.startswith(OURS) and (line.startswith(("raise", "yield")) or "raise " in line)
        meant &= not isinstance(fault, KeyError | IndexError | AttributeError | AssertionError)
        told_at = f" [{Path(last.filename).name}:{last.lineno}]"
        return "clear" if meant else "obscure", f"{type(fault).__name__}: {str(fault)[:300]}{told_at}"
    return "read" if finite else "silent", text


Call = tuple[Callable[..., object], dict[str, Any]]


def main() -> None:
    """Make the calls until all are made or the time is up."""
    from abused import calls

    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--seconds", type=float, default=1200.0, help="time budget")
    parser.add_argument("--only", default="", metavar="WORD,...", help="calls with one of these in their name")
    parser.add_argument("--part", type=float, default=1.0, help="part of the abuses that is made, drawn at random")
    parser.add_argument("--seed", type=int, default=0, help="of that draw")
    parser.add_argument("--out", type=Path, help="every abuse with its outcome, JSON")
    args = parser.parse_args()
    rows: list[dict[str, str]] = []
    began, draw = time.perf_counter(), np.random.default_rng(args.seed)
    out = args.out and args.out.resolve()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):  # text in the place of a path is one
        for name, (function, sound) in calls(Path(folder)).items():
            if not any(word in name for word in args.only.split(",")):
                continue
            if time.perf_counter() - began > args.seconds:
                break
            kind, same = in_child(partial(outcome, partial(function, **sound)), HANG)
            assert kind == "read", (name, kind, same)
            given = [
                (argument, how, sound | {argument: other})
                for argument, value in sound.items()
                for how, other in wrong(value)
                if draw.random() <= args.part
            ]
            answers = in_children([partial(outcome, partial(function, **one)) for _, _, one in given], HANG)
            for (argument, how, _), (kind, text) in zip(given, answers, strict=True):
                if kind == "read":
                    kind = "same" if text == same else "accepted"
                rows.append({"call": name, "argument": argument, "wrong": how, "ended": kind, "said": text[:400]})
                if kind in HARM:
                    print(name, argument, how, kind, text[:240], sep=" | ", flush=True)
    if out:
        out.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    print(f"{len(rows)} abuses in {time.perf_counter() - began:.0f} s")
    print(f"{'':28s}" + "".join(f"{kind:>10s}" for kind in KINDS))
    for name in dict.fromkeys(row["call"] for row in rows):
        counts = Counter(row["ended"] for row in rows if row["call"] == name)
        print(f"{name:28s}" + "".join(f"{counts[kind]:10d}" for kind in KINDS))
    counts = Counter(row["ended"] for row in rows)
    print(f"{'all':28s}" + "".join(f"{counts[kind]:10d}" for kind in KINDS))


if __name__ == "__main__":
    main()
