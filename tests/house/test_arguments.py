"""Arguments held against annotations: what is refused, and that `geometry` and `regularize` hold the same file."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pytest
import torch
from paths import ROOT
from torch import Tensor

from geometry.arguments import ENDLESS, POSITIVE, between, checked, finite


@dataclass(frozen=True)
class Part:
    """A part."""

    size: float
    name: str = "part"


@checked(size=POSITIVE)
@dataclass(frozen=True)
class Checked:
    """Fields."""

    size: float
    shape: tuple[int, ...] = ()
    part: Part | None = None


@checked(count=between(0, 10), reach=ENDLESS, array=finite(None, 3), tensor=finite())
def called(
    number: float = 1.0,
    *,
    count: int = 1,
    reach: float = 1.0,
    hollow: float = math.nan,
    on: bool = False,
    name: str = "",
    kind: Literal["a", "b"] = "a",
    array: np.ndarray | None = None,
    tensor: Tensor | None = None,
    pair: tuple[float, int] = (1.0, 1),
    several: Sequence[float] = (),
    work: Callable[[float], float] | None = None,
    part: Part | float | None = None,
    free: Any = None,
) -> dict[str, Any]:
    return dict(locals())


META, SPARSE = torch.ones(2, device="meta"), torch.eye(2).to_sparse()
REFUSED = {
    "number": (None, "1", 1j, [1.0], object(), True, np.ones(2), math.nan, math.inf, 10**400, META[0], np.bool_(1)),
    "count": (1.5, -1, 11, 2**63, math.nan, "1", None, np.ones(1), False),
    "reach": (math.nan, -math.inf, 0.0),
    "hollow": (math.inf, None),
    "on": (1, 0.0, "yes", None),
    "name": (b"bytes", 3, None),
    "kind": ("c", 1),
    "array": (
        ["a"],
        np.ones((2, 3), complex),
        np.ones((2, 3), object),
        np.ma.masked_less(np.ones((2, 3)), 2),
        META,
        np.ones(3),
        np.full((1, 3), math.nan),
        [[1.0], [2.0, 3.0]],
        np.ones((2, 3), "M8[s]"),
    ),
    "tensor": (np.ones(2), [1.0], META, SPARSE, torch.ones(2, dtype=torch.complex64), torch.tensor([math.inf])),
    "pair": ((1.0,), (1.0, 1, 1), (1.0, 1.5), "ab", 3.0, (math.nan, 1)),
    "several": ("abc", (1.0, "a"), (math.nan,), 1.0, META, {1.0}),
    "work": (3, "f"),
    "part": ("part", (), META),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_fit_is_refused_by_its_name(name: str) -> None:
    for value in REFUSED[name]:
        with pytest.raises((TypeError, ValueError), match=rf"^called: {name} must be .*, got "):
            called(**{name: value})


def test_what_fits_arrives_as_python_numpy_and_torch_have_it() -> None:
    found = called(np.float32(2.5), count=np.int8(3), several=np.arange(3), pair=torch.tensor([2.0, 3.0]))
    assert type(found["number"]) is float and type(found["count"]) is int and found["number"] == 2.5
    assert called(torch.tensor(2.0))["number"] == 2.0 and called(2)["number"] == 2
    assert found["several"] == [0, 1, 2] and found["pair"] == (2.0, 3)
    assert called(reach=math.inf)["reach"] == math.inf and math.isnan(called(hollow=math.nan)["hollow"])
    assert called(array=[[1, 2, 3]])["array"].shape == (1, 3) and called(array=None)["array"] is None
    swapped = np.ones((2, 3), ">f4")[::-1]
    torch.from_numpy(called(array=swapped)["array"])  # torch would not share it
    given = torch.ones(3, requires_grad=True)
    assert called(tensor=given)["tensor"] is given and called(part=Part(1.0))["part"] == Part(1.0)
    assert called(free=object)["free"] is object


def test_classes_are_checked_as_they_are_made() -> None:
    assert Checked(np.float64(1.0), [1, 2]).shape == (1, 2)
    for arguments, words in ((("x",), "Checked: size must be a number"), ((0.0,), "size must be positive, got 0.0")):
        with pytest.raises((TypeError, ValueError), match=words):
            Checked(*arguments)
    with pytest.raises(TypeError, match="part must be a Part or None, got 'part'"):
        Checked(1.0, part="part")  # type: ignore[arg-type]


def test_a_rule_of_no_parameter_is_a_slip() -> None:
    with pytest.raises(TypeError, match="has no parameter sice"):
        checked(sice=POSITIVE)(called)


def test_both_packages_hold_the_same_file() -> None:
    one, other = ((ROOT / name / "arguments.py").read_text(encoding="utf-8") for name in ("geometry", "regularize"))
    own = ("WrongType: type[Exception] = ", "WrongValue: type[Exception] = ", "from .errors import InvalidInput")

    def shared(text: str) -> list[str]:
        return [line for line in text.splitlines() if line and not line.startswith(own)]

    assert shared(one) == shared(other)
