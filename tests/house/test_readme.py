"""The README says what is so: its commands, its example and its links."""

from __future__ import annotations

import re
import tomllib

import pytest
from paths import ROOT

from torchsph.cli.arguments import OUT
from torchsph.cli.program import build_parser

README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    """The fenced code blocks of a language."""
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_it_opens_with_the_two_commands():
    first, second = blocks("sh")[:2]
    assert first.strip() == "python -m pip install . && torchsph assimilate"
    assert second.strip() == 'python -m pip install ".[test]" && python -m pytest'
    assert README.index(first) < README.index(second) < README.index("**torchsph**")


def test_ci_runs_the_test_command_of_the_readme_and_then_the_gates():
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    commands = [blocks("sh")[1].strip(), "ruff check", "ruff format --check", "mypy"]
    places = [script.index(command) for command in commands]
    assert places == sorted(places)
    assert all(script[place + 1] == "keep" for place in places)  # so that none fails unseen
    assert (ROOT / ".ci" / "run").stat().st_mode & 0o111


def test_the_project_file_defines_what_the_commands_need():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["scripts"]["torchsph"] == "torchsph.cli:main"
    extras = {
        name: {re.split(r"\W", need)[0] for need in needs} for name, needs in project["optional-dependencies"].items()
    }
    assert {"pytest", "hypothesis"} <= extras["test"]
    assert {"ruff", "mypy"} <= extras["dev"]


def test_commands_of_the_table_are_those_of_the_program():
    named = set(re.findall(r"^\| `torchsph (\w+)", README, re.MULTILINE))
    helped = build_parser().format_help()
    assert named == set(re.findall(r"^    (\w+)\b", helped, re.MULTILINE))
    assert f"`{OUT}/`" in README


def test_files_it_shows_exist():
    shown = re.findall(r"\]\(([^)#:]+)\)", README)
    assert shown and not [name for name in shown if not (ROOT / name).exists()]


def test_no_line_of_prose_runs_over():
    long = [line for line in README.splitlines() if len(line) > 120 and not line.startswith(("|", "!", "`"))]
    assert not long


def test_the_example_runs(tmp_path, monkeypatch):
    """As printed but for the number of frames, particles and members, so that it takes seconds."""
    (example,) = blocks("python")
    assert len([line for line in example.splitlines() if line.strip()]) <= 9
    for printed, quick in (
        (
            "read_recording(sample_measurement())",
            "read_recording(sample_measurement()).select(slice(11, 13))",
        ),
        ("spacing=1.5e-3", "spacing=3e-3"),
        ("members=12", "members=3"),
    ):
        assert printed in example
        example = example.replace(printed, quick)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(example, "README.md", "exec"), names)
    written = names["geometry"].read_recording(tmp_path / "analysis.h5")
    assert written.frames == 2
    assert written.velocity == pytest.approx(names["analysis"].recording.velocity)


def test_the_citation_is_of_this_version():
    from torchsph import __version__

    cited = dict(
        line.split(": ", 1)
        for line in (ROOT / "CITATION.cff").read_text(encoding="utf-8").splitlines()
        if re.match(r"[a-z-]+: ", line)
    )
    assert cited["cff-version"] == "1.2.0" and cited["version"] == __version__
    license_of = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["license"]
    assert cited["license"] == license_of
