"""`torchsph convert`: a recording from a lab's own files."""

from __future__ import annotations

import argparse
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import geometry
from geometry.formats import FORMATS, FieldMap, MotionOptions, WallOptions, read_field_map
from geometry.formats import convert as convert_files

from ..command import Command
from ..findings import tell_findings
from ..printing import say
from ..running.provenance import provenance

STRINGS = {
    "mask": "array that is above a half in the blood",
    "weight": "array of confidences from 0 to 1",
    "axes": "meaning of the axes in array order: zyx, tczyx, ...; auto: the order of least divergence",
    "components": "what the stored components are: x,y,z or -y,x,z",
    "length-unit": "mm, cm, ... or a number of metres",
    "time-unit": "ms, s, ... or a number of seconds",
    "velocity-unit": "cm/s, mm/s, ... or a number of m/s",
    "columns": "of scattered tracks: id,x,y,z,u,v,w,-,t",
}
NUMBERS = {
    "mask-threshold": "of the mask",
    "mask-label": "value of a label image that is blood",
    "interval": "s between frames",
    "period": "s of a beat; frames without times are spread over it",
    "grid-spacing": "m, of the grid for tracks or for walls alone",
    "nyquist": "m/s, at which the velocities wrap (VENC, Doppler)",
}


def _arguments(parser: argparse.ArgumentParser) -> None:
    names = ", ".join(one.name for one in FORMATS)
    parser.add_argument("inputs", nargs="+", metavar="INPUT", help="velocity in one or several files, or surfaces")
    parser.add_argument("--out", required=True, metavar="M.h5", help="the recording")
    parser.add_argument("--format", default="", metavar="NAME", help=f"{names} (by the file's name)")
    said = parser.add_argument_group("what is what (or in a TOML file: --map)")
    said.add_argument("--map", metavar="MAP.toml", help="a field map; options go before it")
    for name in ("velocity", "sigma"):
        said.add_argument(f"--{name}", metavar="NAME[,NAME]", help=f"arrays of {name}, one or one per component")
    for name, what in STRINGS.items():
        said.add_argument(f"--{name}", metavar="TEXT", help=what)
    for name in ("spacing", "origin", "time"):
        said.add_argument(f"--{name}", metavar="X[,Y,Z]", help="numbers, or the array that holds them")
    for name, what in NUMBERS.items():
        said.add_argument(f"--{name}", type=float, metavar="N", help=what)
    said.add_argument("--bin", type=int, metavar="N", help="frames of tracks per volume (all)")
    said.add_argument(
        "--image-components", action="store_true", default=None, help="components run along the image's own axes"
    )
    said.add_argument("--cut", action="store_true", default=None, help="a plane cut out of a flow in space")
    walls = parser.add_argument_group("wall (else around the mask, open where the grid cuts it)")
    walls.add_argument("--wall", nargs="+", default=[], metavar="FILE", help="a surface, or one for each frame")
    walls.add_argument("--wall-unit", default="", metavar="UNIT", help="of its lengths (that of the fields)")
    walls.add_argument("--openings", type=int, default=0, metavar="N", help="its N longest holes are orifices")
    walls.add_argument("--unite", action="store_true", help="bodies that overlap become one")
    walls.add_argument(
        "--sheet",
        default="",
        choices=["inner", "all"],
        help="of a wall of finite thickness: the blood's surface, or all",
    )
    walls.add_argument(
        "--motion", nargs="+", default=[], metavar="FILE", help="displacements that move the one surface"
    )
    walls.add_argument("--motion-map", metavar="MAP.toml", help="their field map; `velocity` names the displacements")
    walls.add_argument("--motion-arrays", metavar="NAME[,NAME]", help="the displacements among the arrays of the files")
    walls.add_argument("--motion-unit", default="", metavar="UNIT", help="of the displacements (that of their lengths)")
    walls.add_argument("--smoothing", type=int, default=0, metavar="N", help="passes over a wall from a mask")
    parser.add_argument("--rho", type=float, default=1060.0, metavar="D", help="kg/m3 (%(default)s)")
    parser.add_argument("--mu", type=float, default=0.004, metavar="V", help="Pa s (%(default)s)")
    parser.add_argument("--description", default="", metavar="TEXT", help="of the recording")
    parser.add_argument("--strict", action="store_true", help="refuse whatever is odd about the result")


def convert(args: argparse.Namespace) -> None:
    """Run `torchsph convert`."""
    said = read_field_map(args.map) if args.map else FieldMap()
    said = replace(said, **_given(args))
    wall = WallOptions(
        tuple(args.wall),
        args.wall_unit,
        openings=args.openings,
        unite=args.unite,
        smoothing=args.smoothing,
        motion=_motion(args),
        sheet=args.sheet,
    )
    result = convert_files(
        args.inputs, said, format=args.format, wall=wall, rho=args.rho, mu=args.mu, description=args.description
    )
    inputs = {
        "inputs": [name for name in args.inputs if Path(name).is_file()],
        "wall": args.wall,
        "map": args.map,
        "motion": args.motion,
    }
    account = provenance(args, inputs)
    geometry.write_recording(args.out, result.recording, strict=args.strict, provenance=account)
    for note in result.notes:
        say(f"note: {note}")
    tell_findings(result.recording, args.out)
    say(f"wrote {result.recording.frames} frames to {args.out}")


def _motion(args: argparse.Namespace) -> MotionOptions:
    """What moves the wall."""
    said = read_field_map(args.motion_map) if args.motion_map else FieldMap()
    if args.motion_arrays:
        said = replace(said, velocity=tuple(part.strip() for part in args.motion_arrays.split(",")))
    return MotionOptions(tuple(args.motion), said, args.motion_unit)


def _given(args: argparse.Namespace) -> dict[str, Any]:
    """The options of the field map that were given, in its types."""
    found: dict[str, Any] = {}
    for item in fields(FieldMap):
        value = getattr(args, item.name)
        if value is None:
            continue
        if item.name in ("velocity", "sigma"):
            value = tuple(part.strip() for part in value.split(","))
        elif item.name in ("spacing", "origin", "time"):
            value = _numbers(value)
        found[item.name] = value
    return found


def _numbers(text: str) -> str | tuple[float, ...]:
    """Numbers parted by commas, or the name of an array."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        return text


COMMAND = Command(
    "convert",
    """Make a recording from a lab's own files.

    What the files say is taken from them: axes, directions, units, times. What they do not say is asked for
    in one line that names the option.""",
    _arguments,
    convert,
)
