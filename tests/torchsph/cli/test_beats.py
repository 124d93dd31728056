"""`torchsph assimilate --beats`: several beats in one file become one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import geometry
from torchsph.cli.main import main


def test_a_file_of_two_beats_is_analysed_as_one(tmp_path, capsys, box_recording):
    def swirl(points, time):
        x, y = (points - 0.005).T
        return (30 + 10 * np.sin(2 * np.pi * time / 0.03)) * np.stack([-y, x], 1)

    whole = box_recording(swirl, dimension=2, nodes=12, times=tuple(0.01 * k for k in range(6)))
    draw = np.random.default_rng(0)
    noisy = whole.velocity + 0.02 * draw.standard_normal(whole.velocity.shape)
    weight = np.asarray(whole.mask, np.float32)
    measured = replace(whole, velocity=noisy * whole.mask[:, None], weight=weight, period=0.03)
    geometry.write_recording(tmp_path / "two.h5", measured)
    line = ["assimilate", str(tmp_path / "two.h5"), "--method", "spline", "--no-page", "--no-quantities"]
    assert main([*line, "--beats", "--out", str(tmp_path / "out")]) == 0
    analysis = geometry.read_recording(tmp_path / "out" / "analysis.h5")
    np.testing.assert_allclose(analysis.time, [0.0, 0.01, 0.02])
    assert "do not repeat" not in capsys.readouterr().err
    geometry.write_recording(tmp_path / "none.h5", replace(measured, period=0.0))
    line[1] = str(tmp_path / "none.h5")
    assert main([*line, "--beats", "--out", str(tmp_path / "none")]) == 2
    assert "has no period" in capsys.readouterr().err
