"""C++ headers that Python's tables write, so that a number stands in one place; ``build`` calls ``write`` first.

This file uses only the standard library and is also run by path, from the PEP 517 backend, where there is no torch; the
tables are read by their paths for the same reason.
"""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).resolve().parents[1]
CSRC = PACKAGE / "native" / "csrc"
STRUCTURES = PACKAGE / "native" / "structures.py"
TABLE = PACKAGE / "pairs" / "terms.py"
KERNELS = PACKAGE / "pairs" / "smoothing_kernels.py"


def write(folder: Path = CSRC) -> list[Path]:
    """Write the headers whose content is not yet in ``folder``; returns those that changed."""
    changed = []
    for name, content in headers().items():
        path = folder / name
        if not path.is_file() or path.read_text(encoding="utf-8") != content:
            path.write_text(content, encoding="utf-8")
            changed.append(path)
    return changed


def headers() -> dict[str, str]:
    """Names of the headers, with their content."""
    return {
        "terms.hpp": _terms(runpy.run_path(str(TABLE)), runpy.run_path(str(KERNELS))["NUMBERS"]),
        "layouts.hpp": _layouts(runpy.run_path(str(STRUCTURES))["MIRRORS"]),
    }


def _terms(table: dict[str, Any], kernels: dict[str, int]) -> str:
    """Enums of what is chosen by number, and what is said of fields and sums as lists for the preprocessor."""
    return "\n".join(
        [
            "// Pair terms and smoothing kernels. Written by native/headers.py from torchsph/pairs/terms.py and",
            "// smoothing_kernels.py: change those, then build.",
            "#pragma once",
            "#include <cstdint>",
            "",
            "namespace sph {",
            "",
            _enum("Term", "std::uint32_t", table["FLAGS"]),
            _enum("Weight", "std::int32_t", table["WEIGHTS"]),
            _enum("PressureForm", "std::int32_t", {form: i for i, form in enumerate(table["PRESSURE_FORMS"])}),
            _enum("Kernel", "std::int32_t", kernels),
            "// Terms of which all combinations are compiled, and further passes.",
            f"constexpr std::uint32_t rate_terms = {table['of_kind']('rate')};",
            f"constexpr std::uint32_t acceleration_terms = {table['of_kind']('acceleration')};",
            f"constexpr std::uint32_t special_passes[] = {{{', '.join(map(str, table['special_passes']()))}}};",
            "",
            "// FIELD(name, rank, terms that read it)",
            _list("SPH_FIELDS", "FIELD", [_field(table, name, rank) for name, rank in table["FIELDS"].items()]),
            "",
            "// OUTPUT(name, terms that fill it, rank, power of 1 / h beyond the dimension, times, by the own factor)",
            _list("SPH_OUTPUTS", "OUTPUT", [_output(output) for output in table["OUTPUTS"]]),
            "",
            "}  // namespace sph",
            "",
        ]
    )


def _layouts(mirrors: dict[str, Any]) -> str:
    """Offsets and sizes as the C++ compiler sees them, of all fields that Python knows."""
    rows = []
    for name, mirror in mirrors.items():
        rows.append(f'    {{"{name}", "", 0, sizeof({name})}},')
        for field, *_ in mirror._fields_:
            rows.append(f'    {{"{name}", "{field}", offsetof({name}, {field}), sizeof({name}::{field})}},')
    return "\n".join(
        [
            "// Places of all fields that Python fills. Written by native/headers.py from native/structures.py.",
            "#pragma once",
            "#include <cstddef>",
            "",
            '#include "interface.h"',
            "",
            "constexpr sph_layout layouts[] = {",
            *rows,
            "};",
            "",
        ]
    )


def _field(table: dict[str, Any], name: str, rank: int) -> str:
    readers = " | ".join(term.name for term in table["TERMS"] if name in term.reads)
    return f"{name}, {rank}, {readers}"


def _output(output: Any) -> str:
    own = str(output.own).lower()
    return f"{output.name}, {' | '.join(output.terms)}, {output.rank}, {output.power}, {output.times}, {own}"


def _enum(name: str, underlying: str, members: dict[str, int]) -> str:
    lines = [f"  {member} = {value}," for member, value in members.items()]
    return "\n".join([f"enum {name} : {underlying} {{", *lines, "};", ""])


def _list(name: str, entry: str, entries: list[str]) -> str:
    return " \\\n".join([f"#define {name}({entry})", *(f"  {entry}({values})" for values in entries)])
