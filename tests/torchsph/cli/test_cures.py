"""A fault in the middle of a run names the file and what the command's own options can do about it."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import geometry
from torchsph.cli.command import Command
from torchsph.cli.cures import late_fault
from torchsph.cli.exit_codes import ExitCode, exit_code
from torchsph.cli.main import main
from torchsph.methods.memory import NotEnoughMemory
from torchsph.simulator.failures import NumericalFailure

FULL = argparse.Namespace(measurement="m.h5", members=None, spacing=None, preset="default")


def torch_s_own() -> BaseException:
    """What torch raises where there is not enough memory, and where a size overflows."""
    with pytest.raises(RuntimeError) as caught:
        torch.empty(2**62, dtype=torch.float64)
    return caught.value


def test_memory_and_numbers() -> None:
    memory = "m.h5: out of memory; try fewer --members or a larger --spacing"
    for fault in (MemoryError(), MemoryError("out of memory in sph_list_f32; use less"), torch_s_own()):
        assert exit_code(fault) is ExitCode.MEMORY
        assert late_fault(fault, ExitCode.MEMORY, FULL) == memory
    alone = argparse.Namespace(file="a.h5")
    assert late_fault(MemoryError(), ExitCode.MEMORY, alone) == (
        "a.h5: out of memory; close other programs, or use a larger machine"
    )
    foretold = NotEnoughMemory("needs about 34 GB of memory (tables 30 GB); try a larger --spacing")
    assert late_fault(foretold, exit_code(foretold), FULL) == f"m.h5: {foretold}"
    failed = NumericalFailure("all 3 members have failed at about 0.3 s")
    assert late_fault(failed, exit_code(failed), FULL) == (
        "m.h5: all 3 members have failed at about 0.3 s; try another --spacing or another --preset"
    )
    sample = argparse.Namespace(measurement=None, spacing=None)
    assert str(late_fault(failed, ExitCode.NUMERICAL, sample)).startswith("the sample: all 3")
    assert late_fault(MemoryError(), ExitCode.MEMORY, None) == "out of memory; " + (
        "close other programs, or use a larger machine"
    )


def test_a_fault_of_the_input_names_it() -> None:
    assert late_fault(ValueError("a flow in a plane"), ExitCode.INPUT, FULL) == "m.h5: a flow in a plane"
    for named in ("m.h5: /time: is missing", "--spacing: is too large", "also.h5: is a folder"):
        args = argparse.Namespace(**vars(FULL), also=["also.h5"])
        assert late_fault(ValueError(named), ExitCode.INPUT, args) is None
    assert late_fault(ValueError("no such option"), ExitCode.INPUT, None) == "no such option"


def test_a_second_input_is_told_by_its_own_name(
    box_recording: Callable[..., geometry.Recording], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def flow(points: np.ndarray, time: float) -> np.ndarray:
        return 0.1 * np.cos(100 * points + time)

    first, other = (box_recording(flow, nodes=5, times=times) for times in ((0.0, 0.01), (0.0, 0.02)))
    for name, recording in (("a.h5", first), ("late.h5", other), ("bare.h5", replace(first, wall=None))):
        geometry.write_recording(tmp_path / name, recording)
    for name, told in (("late.h5", "has no frame at 0.01 s"), ("bare.h5", "/wall: is not in this recording")):
        for call in (
            ["quantify", "--out", str(tmp_path / "q"), "--truth"],
            ["report", "--out", str(tmp_path / "r.html"), "--measurement"],
            ["assimilate", "--method", "spline", "--out", str(tmp_path / "o"), "--truth"],
        ):
            if name == "bare.h5" and call[0] != "quantify":
                continue  # they need no wall of it
            assert main([*call, str(tmp_path / name), str(tmp_path / "a.h5")]) == 2
            said = capsys.readouterr().err.splitlines()[-1]
            assert said.startswith(f"torchsph {call[0]}: error: {tmp_path / name}: ") and told in said


@pytest.mark.parametrize(("fault", "code"), [(MemoryError(), 3), (NumericalFailure("all failed"), 4)])
def test_the_command_line_says_it_in_one_line(
    fault: BaseException, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchsph.cli import program

    def failing(args: argparse.Namespace) -> None:
        raise fault

    info = next(command for command in program.COMMANDS if command.name == "info")
    broken = Command("info", info.help, info.arguments, failing)
    monkeypatch.setattr(program.parsed, "__defaults__", ((broken,),))
    assert main(["info", "some.h5"]) == code
    said = capsys.readouterr().err
    assert said.startswith("torchsph info: error: some.h5: ") and said.count("\n") == 1
