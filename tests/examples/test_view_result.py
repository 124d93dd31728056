"""The script that draws a result: it reads sidecars through VTK and fills a picture with the flow."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from geometry import Ventricle, write_recording
from geometry.formats import write_sidecar

ROOT = Path(__file__).parents[2]


def test_a_result_is_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("vtkmodules", reason="the extra `formats` is not installed")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOImage import vtkPNGReader

    beat = Ventricle().recording(np.linspace(0, 0.2, 3), grid_spacing=4e-3, wall_spacing=4e-3)
    write_recording(tmp_path / "beat.h5", beat)
    write_sidecar(tmp_path / "beat.h5")
    out = tmp_path / "view.png"
    monkeypatch.setattr(sys, "argv", ["view_result.py", str(tmp_path / "beat.vtkhdf"), "--out", str(out)])
    runpy.run_path(str(ROOT / "examples" / "view_result.py"), run_name="__main__")
    said = capsys.readouterr().out
    assert "beat.vtkhdf at " in said and "velocity" in said and "highest speed in the plane" in said
    reader = vtkPNGReader()
    reader.SetFileName(str(out))
    reader.Update()
    pixels = vtk_to_numpy(reader.GetOutput().GetPointData().GetScalars()).astype(int)
    coloured = np.ptp(pixels, axis=1) > 40
    assert 0.1 < coloured.mean() < 0.9  # the plane of the flow, between white margins
