"""The package's public names: there when they are asked for, and not loaded before."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import torchsph


def test_the_package_is_imported_without_torch_and_in_no_time(tmp_path):
    program = "import time, sys; import torchsph, torchsph.cli; "
    program += "print(sorted({'torch', 'numpy', 'scipy', 'matplotlib'} & set(sys.modules)), time.process_time() < 1.5)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert done.stdout == "[] True\n"


def test_every_public_name_is_there_and_comes_from_where_type_checkers_look():
    tree = ast.parse(Path(torchsph.__file__).read_text(encoding="utf-8"))
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.level == 1]
    seen = {node.module: tuple(alias.name for alias in node.names) for node in imports}
    assert seen == torchsph._HOMES
    for name in torchsph.__all__:
        assert getattr(torchsph, name) is not None
    assert set(torchsph.__all__) <= set(dir(torchsph))


def test_rooms_are_there_and_nothing_else():
    rooms = {path.parent.name for path in Path(torchsph.__file__).parent.glob("*/__init__.py")}
    assert rooms == set(torchsph._ROOMS)
    assert torchsph.pairs.interface and torchsph.data.sample_truth().is_file()
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        torchsph.nonsense  # noqa: B018
