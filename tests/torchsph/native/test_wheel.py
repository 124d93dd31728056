"""The build backend's own work: libraries added to a wheel that setuptools made."""

from __future__ import annotations

import base64
import hashlib
import runpy
import zipfile

import pytest
from paths import ROOT

BACKEND = ROOT / ".build" / "backend.py"


@pytest.fixture(name="wheel")
def _wheel(tmp_path):
    path = tmp_path / "thing-1.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("thing/__init__.py", "x = 1\n")
        archive.writestr("thing-1.0.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr("thing-1.0.dist-info/RECORD", "")
    return path


def test_libraries_are_recorded_and_the_wheel_is_tagged(wheel, tmp_path):
    library = tmp_path / "fast.so"
    library.write_bytes(b"machine code")
    target = runpy.run_path(str(BACKEND))["_with_libraries"](wheel, {"thing/_native/fast.so": library})
    assert not wheel.exists()
    assert target.name.startswith("thing-1.0-py3-none-") and not target.name.endswith("any.whl")
    with zipfile.ZipFile(target) as archive:
        assert archive.read("thing/_native/fast.so") == b"machine code"
        tags = archive.read("thing-1.0.dist-info/WHEEL").decode()
        assert "Root-Is-Purelib: false" in tags and "py3-none-any" not in tags
        record = archive.read("thing-1.0.dist-info/RECORD").decode().splitlines()
        listed = {line.split(",")[0]: line.split(",")[1:] for line in record}
        assert set(listed) == set(archive.namelist())
        digest = base64.urlsafe_b64encode(hashlib.sha256(b"machine code").digest()).rstrip(b"=").decode()
        assert listed["thing/_native/fast.so"] == [f"sha256={digest}", "12"]


def test_without_a_compiler_nothing_is_added_and_it_is_said(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    compile_with = runpy.run_path(str(BACKEND))["_compile"]
    assert compile_with("torchsph/native/build.py", tmp_path / "out") == []
    assert "no C++ compiler found" in capsys.readouterr().err


def test_compiler_that_fails_does_not_stop_the_install(monkeypatch, tmp_path, capsys):
    for name in ("g++", "clang++"):
        (tmp_path / name).write_text("#!/bin/sh\necho no OpenMP here >&2\nexit 1\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    monkeypatch.delenv("CXX", raising=False)
    compile_with = runpy.run_path(str(BACKEND))["_compile"]
    assert compile_with("torchsph/native/build.py", tmp_path / "out") == []
    assert "no OpenMP here" in capsys.readouterr().err
