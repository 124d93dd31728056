"""A result as ParaView shows it: the plane through the openings with speed and arrows, the wall cut open behind it.

    python examples/view_result.py analysis.vtkhdf --time 0.15 --out view.png

Reads the sidecars that `torchsph assimilate` and `smooth` write (or `torchsph export --to vtkhdf`) through VTK's own
reader and draws without a window; needs `pip install "torchsph[formats]"`. What is printed and drawn is the file's:
times, arrays, the highest speed in the plane.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import vtkmodules.vtkRenderingFreeType
import vtkmodules.vtkRenderingOpenGL2  # noqa: F401  what draws, found by VTK when it is imported
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkLookupTable
from vtkmodules.vtkCommonDataModel import vtkPlane
from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
from vtkmodules.vtkFiltersCore import (
    vtkArrayCalculator,
    vtkClipPolyData,
    vtkCutter,
    vtkGlyph3D,
    vtkImplicitPolyDataDistance,
    vtkMaskPoints,
    vtkThreshold,
)
from vtkmodules.vtkFiltersGeometry import vtkGeometryFilter
from vtkmodules.vtkFiltersSources import vtkArrowSource
from vtkmodules.vtkIOHDF import vtkHDFReader
from vtkmodules.vtkIOImage import vtkPNGWriter
from vtkmodules.vtkRenderingAnnotation import vtkScalarBarActor
from vtkmodules.vtkRenderingCore import (
    vtkActor,
    vtkPolyDataMapper,
    vtkRenderer,
    vtkRenderWindow,
    vtkTextActor,
    vtkWindowToImageFilter,
)

LONGEST = 0.0065  # m, of an arrow of the highest speed
OPENINGS = {1: (0.20, 0.45, 0.85), 2: (0.85, 0.30, 0.25)}  # colours of inlet and outlet


def read(path: Path, time: float | None) -> tuple[Any, float]:
    """What a file holds at the time nearest to the one asked for, without one that of the fastest flow."""
    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    times = reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS()) or (0.0,)
    if time is None:
        time = max(times, key=lambda one: mean_speed(reader, one))
    nearest = min(times, key=lambda one: abs(one - time))
    reader.UpdateTimeStep(nearest)
    return reader.GetOutputDataObject(0), nearest


def mean_speed(reader: vtkHDFReader, time: float) -> float:
    """RMS speed of a time."""
    reader.UpdateTimeStep(time)
    velocity = vtk_to_numpy(reader.GetOutputDataObject(0).GetPointData().GetArray("velocity"))
    return float(np.sqrt(np.mean(velocity.astype(float) ** 2)))


def through_openings(wall: Any) -> tuple[np.ndarray, np.ndarray]:
    """A point of the plane through both openings and the farthest vertex from them, and its normal."""
    points = vtk_to_numpy(wall.GetPoints().GetData()).astype(float)
    corners = vtk_to_numpy(wall.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    region = vtk_to_numpy(wall.GetCellData().GetArray("region"))
    middles = [points[corners[region == label]].reshape(-1, 3).mean(0) for label in OPENINGS if (region == label).any()]
    base = np.mean(middles, axis=0) if middles else points.mean(0)
    apex = points[np.linalg.norm(points - base, axis=1).argmax()]
    across = middles[1] - middles[0] if len(middles) == 2 else np.array([1.0, 0.0, 0.0])
    normal = np.cross(apex - base, across)
    return base, normal / np.linalg.norm(normal)


def actor(source: Any, **look: Any) -> vtkActor:
    """An actor of a filter's output, plain or coloured by an array and a table."""
    mapper = vtkPolyDataMapper()
    mapper.SetInputConnection(source.GetOutputPort())
    found = vtkActor()
    found.SetMapper(mapper)
    if "table" in look:
        mapper.SetScalarModeToUsePointFieldData()
        mapper.SelectColorArray("speed")
        mapper.SetLookupTable(look["table"])
        mapper.UseLookupTableScalarRangeOn()
    else:
        mapper.ScalarVisibilityOff()
        found.GetProperty().SetColor(*look["colour"])
        found.GetProperty().SetOpacity(look.get("opacity", 1.0))
    return found


def flow_in(image: Any, wall: Any, plane: vtkPlane) -> tuple[Any, float]:
    """What lies in a plane inside the wall, its speeds and what its velocity is along the plane; the highest speed."""
    normal = ", ".join(f"{part:.9g}" for part in plane.GetNormal())
    speed = calculated("mag(velocity)", "speed")
    speed.SetInputData(image)
    along = calculated(f"velocity - dot(velocity, ({xyz(normal)})) * ({xyz(normal)})", "along")
    along.SetInputConnection(speed.GetOutputPort())
    cut = vtkCutter()
    cut.SetCutFunction(plane)
    cut.SetInputConnection(along.GetOutputPort())
    distance = vtkImplicitPolyDataDistance()
    distance.SetInput(wall)
    blood = vtkClipPolyData()
    blood.SetInputConnection(cut.GetOutputPort())
    blood.SetClipFunction(distance)
    blood.InsideOutOn()
    blood.Update()
    values = blood.GetOutput().GetPointData().GetArray("speed")
    return blood, float(vtk_to_numpy(values).max())


def xyz(numbers: str) -> str:
    """Three numbers as VTK's calculator writes a vector."""
    return " + ".join(f"{part} * {axis}Hat" for part, axis in zip(numbers.split(", "), "ijk", strict=True))


def calculated(formula: str, name: str) -> vtkArrayCalculator:
    """A filter that adds an array made of the velocity."""
    found = vtkArrayCalculator()
    found.AddVectorArrayName("velocity")
    found.SetFunction(formula)
    found.SetResultArrayName(name)
    return found


def arrows(cut: Any, scale: float) -> Any:
    """An arrow at every second point of a cut, along the part of its velocity that lies in the plane."""
    sparse = vtkMaskPoints()
    sparse.SetInputConnection(cut.GetOutputPort())
    sparse.SetOnRatio(2)
    sparse.Update()
    sparse.GetOutput().GetPointData().SetActiveVectors("along")
    shape = vtkArrowSource()
    shape.SetTipRadius(0.09)
    shape.SetShaftRadius(0.025)
    shape.SetTipLength(0.3)
    glyphs = vtkGlyph3D()
    glyphs.SetInputData(sparse.GetOutput())
    glyphs.SetSourceConnection(shape.GetOutputPort())
    glyphs.SetVectorModeToUseVector()
    glyphs.SetScaleModeToScaleByVector()
    glyphs.SetScaleFactor(scale)
    return glyphs


def drawn(image: Any, wall: Any, title: str) -> tuple[vtkRenderer, float]:
    """The scene, and the highest speed in its plane."""
    base, normal = through_openings(wall)
    plane = vtkPlane()
    plane.SetOrigin(*base)
    plane.SetNormal(*normal)
    cut, highest = flow_in(image, wall, plane)
    table = vtkLookupTable()
    table.SetHueRange(0.62, 0.08)
    table.SetSaturationRange(0.35, 0.9)
    table.SetRange(0.0, highest)
    table.Build()
    scene = vtkRenderer()
    scene.SetBackground(1, 1, 1)
    scene.AddActor(actor(cut, table=table))
    scene.AddActor(actor(arrows(cut, LONGEST / max(highest, 1e-9)), colour=(0.1, 0.1, 0.12)))
    behind = vtkClipPolyData()  # the half of the wall that lies beyond the plane
    behind.SetInputData(wall)
    behind.SetClipFunction(plane)
    scene.AddActor(actor(behind, colour=(0.86, 0.72, 0.70), opacity=0.45))
    rim = vtkCutter()
    rim.SetInputData(wall)
    rim.SetCutFunction(plane)
    line = actor(rim, colour=(0.45, 0.2, 0.2))
    line.GetProperty().SetLineWidth(4)
    scene.AddActor(line)
    for label, colour in OPENINGS.items():
        opening = vtkThreshold()
        opening.SetInputData(wall)
        opening.SetInputArrayToProcess(0, 0, 0, 1, "region")
        opening.SetThresholdFunction(vtkThreshold.THRESHOLD_BETWEEN)
        opening.SetLowerThreshold(label - 0.5)
        opening.SetUpperThreshold(label + 0.5)
        surface = vtkGeometryFilter()
        surface.SetInputConnection(opening.GetOutputPort())
        lid = actor(surface, colour=colour, opacity=0.5)
        lid.GetProperty().LightingOff()
        scene.AddActor(lid)
    bar, text = vtkScalarBarActor(), vtkTextActor()
    bar.SetLookupTable(table)
    bar.SetTitle("m/s")
    bar.SetMaximumWidthInPixels(70)
    for style in (bar.GetLabelTextProperty(), bar.GetTitleTextProperty(), text.GetTextProperty()):
        style.SetColor(0, 0, 0)
        style.ShadowOff()
    text.SetInput(title)
    text.GetTextProperty().SetFontSize(20)
    text.SetPosition(16, 16)
    scene.AddViewProp(bar)
    scene.AddViewProp(text)
    camera = scene.GetActiveCamera()
    camera.SetFocalPoint(*base)
    camera.SetPosition(*(base - 0.2 * normal))
    points = vtk_to_numpy(wall.GetPoints().GetData()).astype(float)
    camera.SetViewUp(*(base - points.mean(0)))
    camera.Azimuth(25)
    scene.ResetCamera()
    camera.Zoom(1.1)
    return scene, highest


def main() -> None:
    """Read both sidecars, draw, save."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("result", type=Path, help="NAME.vtkhdf; NAME_wall.vtkhdf lies beside it")
    parser.add_argument("--time", type=float, help="s")
    parser.add_argument("--out", type=Path, default=Path("view.png"))
    args = parser.parse_args()
    image, time = read(args.result, args.time)
    wall, _ = read(args.result.with_name(f"{args.result.stem}_wall.vtkhdf"), time)
    fields = image.GetPointData()
    print(f"{args.result.name} at {time:.4g} s: {image.GetDimensions()} nodes,", end=" ")
    print(", ".join(fields.GetArrayName(number) for number in range(fields.GetNumberOfArrays())))
    scene, highest = drawn(image, wall, f"{args.result.stem}, {1e3 * time:.0f} ms")
    print(f"highest speed in the plane {highest:.3g} m/s")
    window = vtkRenderWindow()
    window.SetOffScreenRendering(True)
    window.SetMultiSamples(8)
    window.SetSize(900, 900)
    window.AddRenderer(scene)
    window.Render()
    grabbed = vtkWindowToImageFilter()
    grabbed.SetInput(window)
    writer = vtkPNGWriter()
    writer.SetFileName(str(args.out))
    writer.SetInputConnection(grabbed.GetOutputPort())
    writer.Write()


if __name__ == "__main__":
    main()
