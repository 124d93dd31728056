"""Recording files that are damaged or odd, read one after the other: which are refused clearly, and which do harm.

Mutants of a sound recording, made with a fixed seed: flipped bits and bytes, files cut or lengthened, bytes of
another place, datasets and attributes of other kinds, shapes, types and values. A child process reads each as
`torchsph info` does, with limits on time and memory; a mutant ends as

- clear refusal: a ValueError or OSError that names the file,
- same result: everything that is read is as before,
- another result: it is read, but not the same (bits of the values themselves; nothing can tell them),
- obscure: any other exception, or a message without the file's name,
- crash: the child died, hang: it was stopped.

    python examples/benchmarks/mutants.py --mutants 2000 --seconds 600 --out mutants.json

Without a file, a small recording with every dataset of the format is mutated.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import h5py
import numpy as np
from runs.limited_child import in_child

import geometry
from geometry.recordings.checks import findings
from geometry.recordings.recording import LAYOUT

HANG = 20.0  # s
HARM = ("obscure", "crash", "hang")
DATASETS = tuple(dataset for _, dataset, _ in LAYOUT)
ATTRIBUTES = ("format", "format_version", "dimension", "rho", "mu", "period", "description")
NUMBERS = (0.0, -1.0, np.nan, np.inf, -np.inf, 1e-300, 1e300, 1e-12, 1e12, 2.0**31, 2.0**63, 300, 0.5)
Mutation = Callable[[Path, np.random.Generator], str]


def whole_recording(path: Path) -> None:
    """A small ellipsoid with every dataset that a recording may have."""
    body = geometry.ellipsoid((6e-3, 6e-3, 8e-3), 2.5e-3)
    region = np.where(body.centroids[:, 2] > 6e-3, 1, np.where(body.centroids[:, 2] < -6e-3, 2, 0)).astype(np.uint8)
    grid = geometry.Grid.covering((-7e-3, -7e-3, -9e-3), (7e-3, 7e-3, 9e-3), 2.5e-3)
    points = grid.nodes().numpy()
    mask = (geometry.winding_number(body.vertices, body.faces, points) > 0.5).reshape(grid.shape)
    times, draw = np.arange(3) * 0.01, np.random.default_rng(0)
    shape = (3, *grid.shape)
    velocity = np.stack([0.1 * np.cos(200 * points + t).T.reshape(3, *grid.shape) * mask for t in times])
    vertices = np.stack([body.vertices * (1 + 0.1 * t) for t in times])
    recording = geometry.Recording(
        time=times,
        grid=grid,
        velocity=velocity,
        mask=mask,
        wall=geometry.Wall(vertices, body.faces, region, np.stack([0.1 * body.vertices] * 3)),
        rho=1060.0,
        mu=0.004,
        period=0.05,
        description="whole",
        weight=draw.uniform(0.1, 1.0, shape),
        sigma=draw.uniform(0.01, 0.1, (3, 3, *grid.shape)),
        uncovered=np.zeros(3, int),
        pressure=draw.normal(size=shape),
        valve_intervals=np.array([[1, 0.0, 0.01], [2, 0.01, 0.03]]),
        volume=np.full(3, body.volume),
        flux_mitral=np.zeros(3),
        flux_aortic=np.zeros(3),
    )
    geometry.write_recording(path, replace(recording, valve_open=np.array([[1, 0], [0, 1], [0, 1]], np.uint8)))


# --- mutations: each changes the file and says how ---------------------------------------------------


def flipped_bits(path: Path, draw: np.random.Generator) -> str:
    """One to eight bits."""
    data = bytearray(path.read_bytes())
    places = draw.integers(0, 8 * len(data), int(draw.choice([1, 1, 1, 2, 8])))
    for place in places:
        data[place // 8] ^= 1 << (place % 8)
    path.write_bytes(data)
    return f"bits {places.tolist()}"


def flipped_early(path: Path, draw: np.random.Generator) -> str:
    """A bit of the first 4 KiB, where HDF5 keeps its own."""
    data = bytearray(path.read_bytes())
    place = int(draw.integers(0, 8 * min(4096, len(data))))
    data[place // 8] ^= 1 << (place % 8)
    path.write_bytes(data)
    return f"early bit {place}"


def other_bytes(path: Path, draw: np.random.Generator) -> str:
    """A run of zeros, ones, noise, or of bytes from elsewhere in the file."""
    data = bytearray(path.read_bytes())
    length = int(draw.choice([1, 4, 8, 64, 512]))
    place, other = (int(at) for at in draw.integers(0, len(data) - length, 2))
    kind = str(draw.choice(["zeros", "ones", "noise", "copy"]))
    made = {"zeros": bytes(length), "ones": b"\xff" * length, "noise": draw.bytes(length)}
    data[place : place + length] = made.get(kind, bytes(data[other : other + length]))
    path.write_bytes(data)
    return f"{length} {kind} at {place}"


def cut(path: Path, draw: np.random.Generator) -> str:
    """Shorter or longer than it was."""
    data = path.read_bytes()
    at = int(draw.integers(0, len(data)))
    longer = draw.random() < 0.2
    path.write_bytes(data + draw.bytes(at % 5000) if longer else data[:at])
    return f"{'lengthened' if longer else 'cut'} at {at}"


def odd_attribute(path: Path, draw: np.random.Generator) -> str:
    """An attribute of another value or kind, or none."""
    values = [
        *NUMBERS,
        b"\xff\xfe",
        "x" * 60000,
        "\x1b[2J",
        [1.0, 2.0],
        np.zeros(5000),
        h5py.Empty("f8"),
        1 + 2j,
        True,
        "3",
    ]
    with h5py.File(path, "r+") as file:
        name = str(draw.choice([*ATTRIBUTES, "origin", "spacing", "units", "scale_factor", "_FillValue"]))
        node = file["grid"] if name in ("origin", "spacing") else file
        if name in ("units", "scale_factor", "_FillValue"):
            node = file[str(draw.choice([one for one in DATASETS if one in file]))]
        value = values[int(draw.integers(len(values)))]
        if name in ("origin", "spacing") and isinstance(value, float):
            value = [value] * 3
        if draw.random() < 0.1 and name in node.attrs:
            del node.attrs[name]
            return f"no attribute {name}"
        node.attrs[name] = value
        return f"attribute {node.name}.{name} = {str(value)[:40]!r}"


def odd_object(path: Path, draw: np.random.Generator) -> str:
    """Something else in the place of a dataset, or nothing."""
    with h5py.File(path, "r+") as file:
        name = str(draw.choice([one for one in DATASETS if one in file]))
        shape = file[name].shape
        del file[name]
        kind = int(draw.integers(10))
        if kind == 0:
            file[name] = h5py.SoftLink(str(draw.choice([".", "/", name, "/velocity", "/nowhere"])))
        elif kind == 1:
            file[name] = h5py.ExternalLink("/etc/hostname", "/x")
        elif kind == 2:
            file.create_group(name)
        elif kind == 3:
            file[name] = h5py.Empty("f8")
        elif kind == 4:
            file[name] = np.dtype("f8")
        elif kind == 5:
            file.create_dataset(name, (3,), dtype=h5py.vlen_dtype("f8"))
        elif kind == 6:
            file.create_dataset(name, data=["a"] * 3, dtype=h5py.string_dtype())
        elif kind == 7:
            count = int(draw.choice([0, 1, 10**6, 10**9, 10**12, 2**62]))
            grown = (count, *shape[1:])
            file.create_dataset(name, grown, "f4", chunks=tuple(min(n, 256) for n in grown) if count else None)
        elif kind == 8:
            file.create_dataset(name, shape, [("x", "f8"), ("y", "i4")])
    return f"{name} of kind {kind}"


def odd_values(path: Path, draw: np.random.Generator) -> str:
    """Some values that cannot be meant, another type, order or sign."""
    with h5py.File(path, "r+") as file:
        name = str(draw.choice([one for one in DATASETS if one in file]))
        values = np.asarray(file[name][()])
        kind = int(draw.integers(5))
        if kind == 0 and values.size:
            values = values.astype(np.float64)
            some = draw.random(values.shape) < float(draw.choice([0.001, 0.1, 1.0]))
            values[some] = draw.choice(NUMBERS)
        elif kind == 1:
            values = values * float(draw.choice([-1.0, 1e3, 1e6, 1e-3, 1e-9, 0.0]))
        elif kind == 2:
            values = values[::-1]
        elif kind == 3:
            values = np.swapaxes(values, 0, -1) if values.ndim > 1 else values[: len(values) // 2]
        else:
            values = values.astype(str(draw.choice(["f2", "i1", "u2", "i8", "c8", "f8", ">f4"])))
        del file[name]
        file.create_dataset(name, data=values)
    return f"{name} with values of kind {kind}"


MUTATIONS: tuple[Mutation, ...] = (flipped_bits, flipped_early, other_bytes, cut, odd_attribute, odd_object, odd_values)


# --- reading, in a child ---------------------------------------------------------------------------------


def said(path: Path) -> tuple[str, str]:
    """What reading a file comes to: a fingerprint of all that is read, or a refusal."""
    try:
        recording = geometry.read_recording(path)
        told = [str(one) for one in findings(recording)]
    except (ValueError, OSError) as fault:
        return ("clear refusal" if str(path) in str(fault) else "obscure"), f"{type(fault).__name__}: {fault}"
    except Exception as fault:
        return "obscure", f"{type(fault).__name__}: {fault}"
    parts = [recording.grid, recording.rho, recording.mu, recording.period, recording.description, told]
    parts += [array.tobytes() for _, array in sorted(recording.arrays().items())]
    return "read", str(hash(tuple(map(repr, parts))))


def main() -> None:
    """Read mutants until their number or the time is up."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("file", nargs="?", type=Path, help="the recording that is mutated")
    parser.add_argument("--mutants", type=int, default=2000)
    parser.add_argument("--seconds", type=float, default=600.0, help="time budget")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="every mutant with its outcome, JSON")
    args = parser.parse_args()
    rows: list[dict[str, str]] = []
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mutant.h5"
        if args.file is None:
            whole_recording(path)
        else:
            path.write_bytes(args.file.read_bytes())
        sound = path.read_bytes()
        kind, same = in_child(partial(said, path), HANG)
        assert kind == "read", same
        while len(rows) < args.mutants and time.perf_counter() - began < args.seconds:
            number = len(rows)
            draw = np.random.default_rng((args.seed, number))
            mutate = MUTATIONS[number % len(MUTATIONS)]
            path.write_bytes(sound)
            how = mutate(path, draw)
            kind, text = in_child(partial(said, path), HANG)
            if kind == "read":
                kind = "same result" if text == same else "another result"
            rows.append({"mutation": mutate.__name__, "how": how, "ended": kind, "said": text[:500]})
            if kind in HARM:
                print(number, mutate.__name__, how, kind, text[:200], flush=True)
    if args.out:
        args.out.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    print(f"{len(rows)} mutants in {time.perf_counter() - began:.0f} s")
    names = ("clear refusal", "same result", "another result", *HARM)
    print(f"{'':16s}" + "".join(f"{name:>16s}" for name in names))
    for mutate in MUTATIONS:
        counts = Counter(row["ended"] for row in rows if row["mutation"] == mutate.__name__)
        print(f"{mutate.__name__:16s}" + "".join(f"{counts[name]:16d}" for name in names))


if __name__ == "__main__":
    main()
