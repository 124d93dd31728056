"""Arguments of public functions and classes, held against their annotations where they enter.

    @checked(passes=between(0, 1000))
    def taubin(surface: Surface, passes: int, *, shrink: float = 0.5) -> Surface: ...

Text in the place of a number, None, objects, complex or masked arrays, tensors without numbers in them: what does not
fit its annotation is refused by the names of function and parameter, before anything is computed with it. A number must
be finite, unless its default is not or its rule says so. Scalars of numpy and torch become Python's, lists become
arrays where arrays go, and arrays that torch could not share (of foreign byte order, running backwards) are copied.
Annotations that say nothing to check, as a Protocol does, are let pass. A call costs some microseconds.

`geometry` and `regularize` stand alone, so each has this file; `tests/house/test_arguments.py` holds them equal.
"""

from __future__ import annotations

import math
import reprlib
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from inspect import Parameter, signature
from numbers import Integral, Real
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints, overload

import numpy as np
import torch
from numpy.typing import ArrayLike

from .errors import InvalidInput

Subject = TypeVar("Subject", bound=Callable[..., Any])
_UNFIT = object()  # what a conversion answers of a value that does not fit


@dataclass(frozen=True)
class Rule:
    """What a value must be beyond its type.

    Attributes:
        words: the rule, which ends "must be".
        fits: whether a value (never None) keeps it.
        endless: a number may be infinite.
    """

    words: str
    fits: Callable[[Any], bool]
    endless: bool = False


ANY = Rule("a number", lambda value: True, endless=True)
POSITIVE = Rule("positive", lambda value: value > 0)
NOT_NEGATIVE = Rule("0 or more", lambda value: value >= 0)
ENDLESS = Rule("positive; inf is allowed", lambda value: value > 0, endless=True)


def between(least: float, most: float) -> Rule:
    """A number from `least` to `most`."""
    return Rule(f"from {least:g} to {most:g}", lambda value: least <= value <= most)


def finite(*shape: int | None) -> Rule:
    """An array or tensor without NaN and inf; of a shape where one is given, None in it standing for any length."""

    def fits(value: Any) -> bool:
        if shape and not _has_shape(value.shape, shape):
            return False
        found = torch.isfinite(value) if isinstance(value, torch.Tensor) else np.isfinite(value)
        return bool(found.all())

    lengths = ", ".join("n" if length is None else str(length) for length in shape)
    return Rule("finite" + (f", of the shape ({lengths})" if shape else ""), fits)


def _has_shape(shape: Sequence[int], wanted: Sequence[int | None]) -> bool:
    return len(shape) == len(wanted) and all(w in (None, n) for w, n in zip(wanted, shape, strict=True))


# --- what annotations say --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Kind:
    """What an annotation lets in: in words, and the value as it is used, or `_UNFIT`."""

    words: str
    convert: Callable[[Any], Any]


def _kind(hint: Any) -> _Kind | None:
    """What an annotation lets in; None: everything."""
    if hint in _PLAIN:
        return _PLAIN[hint]
    origin, inner = get_origin(hint), get_args(hint)
    if hint is ArrayLike:
        return _PLAIN[np.ndarray]
    if origin in (Union, types.UnionType):
        return _one_of([_kind(part) for part in inner])
    if origin is Literal:
        return _Kind(" or ".join(map(repr, inner)), lambda value: value if _is_among(value, inner) else _UNFIT)
    if origin in (tuple, list, Sequence) and inner:
        return _several(origin, inner)
    if origin is Callable or hint is Callable:
        return _Kind("a function", lambda value: value if callable(value) else _UNFIT)
    kind = origin or hint
    if not isinstance(kind, type) or kind is object or getattr(kind, "_is_protocol", False):
        return None
    return _Kind(f"a {kind.__name__}", lambda value: value if isinstance(value, kind) else _UNFIT)


def _one_of(kinds: list[_Kind | None]) -> _Kind | None:
    known = [kind for kind in kinds if kind is not None]
    if len(known) < len(kinds):
        return None

    def convert(value: Any) -> Any:
        return next((found for kind in known if (found := kind.convert(value)) is not _UNFIT), _UNFIT)

    return _Kind(" or ".join(dict.fromkeys(kind.words for kind in known)), convert)


def _several(origin: Any, inner: tuple[Any, ...]) -> _Kind | None:
    """Several values: of one kind, or of as many as a tuple's annotation counts up."""
    fixed = origin is tuple and inner[-1] is not Ellipsis
    kinds = [_kind(part) for part in (inner if fixed else inner[:1])]
    words = [kind.words if kind else "anything" for kind in kinds]

    def convert(value: Any) -> Any:
        if isinstance(value, torch.Tensor | np.ndarray):
            value = value.tolist() if value.ndim and getattr(value, "device", "cpu") != torch.device("meta") else None
        if not isinstance(value, Sequence) or isinstance(value, str | bytes) or (fixed and len(value) != len(kinds)):
            return _UNFIT
        each = kinds if fixed else kinds * len(value)
        found = [kind.convert(part) if kind else part for kind, part in zip(each, value, strict=True)]
        if any(part is _UNFIT for part in found):
            return _UNFIT
        return value if origin is not tuple and not isinstance(value, tuple) else tuple(found)

    said = f"({', '.join(words)})" if fixed else f"a sequence, each {words[0]}"
    return _Kind(said, convert)


def _real(value: Any) -> Any:
    if isinstance(value, np.ndarray | torch.Tensor) and value.ndim == 0 and _is_plain(value):
        value = value.item()
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        return _UNFIT
    if isinstance(value, int):
        return value if abs(value) < 2**1023 else _UNFIT
    return value if isinstance(value, float) else float(value)


def _whole(value: Any) -> Any:
    value = _real(value)
    if value is _UNFIT or isinstance(value, int):
        return value
    return int(value) if math.isfinite(value) and value == int(value) else _UNFIT


def _array(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return value.detach().cpu().numpy() if _is_plain(value) else _UNFIT
    if isinstance(value, np.ma.MaskedArray):
        return _UNFIT
    try:
        found = np.asarray(value)
    except (ValueError, TypeError, OverflowError, RuntimeError):
        return _UNFIT
    if found.dtype.kind not in "biuf":
        return _UNFIT
    shared = found.dtype.isnative and min(found.strides, default=0) >= 0
    return found if shared else np.array(found, dtype=found.dtype.newbyteorder("="), order="C")


def _is_plain(value: np.ndarray | torch.Tensor) -> bool:
    """Whether an array or tensor is dense and holds real numbers."""
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biuf"
    strided = value.layout == torch.strided and value.device.type != "meta" and not value.is_quantized
    return strided and not value.is_complex()


def _holds_nan(value: Any) -> bool:
    """Whether there is a NaN among numbers in tuples and lists."""
    if isinstance(value, tuple | list):
        return any(map(_holds_nan, value))
    return isinstance(value, float) and math.isnan(value)


def _is_among(value: Any, allowed: tuple[Any, ...]) -> bool:
    return any(type(value) is type(one) and value == one for one in allowed)


_PLAIN: dict[Any, _Kind | None] = {
    Any: None,
    type(None): _Kind("None", lambda value: value if value is None else _UNFIT),
    bool: _Kind("True or False", lambda value: bool(value) if isinstance(value, bool | np.bool_) else _UNFIT),
    int: _Kind("a whole number", _whole),
    float: _Kind("a number", _real),
    str: _Kind("text", lambda value: value if isinstance(value, str) else _UNFIT),
    np.ndarray: _Kind("an array of real numbers", _array),
    torch.Tensor: _Kind(
        "a dense tensor of real numbers",
        lambda value: value if isinstance(value, torch.Tensor) and _is_plain(value) else _UNFIT,
    ),
    Integral: _Kind("a whole number", _whole),
}


# --- the check -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Check:
    """One parameter of one function: what it must be."""

    function: str
    name: str
    default: Any
    kind: _Kind | None
    rule: Rule | None

    def __call__(self, value: Any) -> Any:
        if value is self.default or (self.kind is None and self.rule is None):
            return value
        found = self.kind.convert(value) if self.kind else value
        if found is _UNFIT:
            words = self.kind.words if self.kind else ""
            number = isinstance(value, int | float) and not isinstance(value, bool) and "number" in words
            raise (WrongValue if number else WrongType)(self._words(words, value))
        if isinstance(found, float) and not math.isfinite(found):
            endless = self.rule is not None and self.rule.endless and not math.isnan(found)
            if not endless and not (isinstance(self.default, float) and str(self.default) == str(found)):
                raise WrongValue(self._words("finite", value))
        if isinstance(found, tuple | list) and _holds_nan(found):
            raise WrongValue(self._words("without NaN", value))
        if self.rule is not None and found is not None and not self.rule.fits(found):
            raise WrongValue(self._words(self.rule.words, found))
        return found

    def _words(self, wanted: str, value: Any) -> str:
        return f"{self.function}: {self.name} must be {wanted}, got {shown(value)}"


def shown(value: Any) -> str:
    """A value in a few words."""
    if isinstance(value, torch.Tensor):
        layout = "" if value.layout == torch.strided else f", {str(value.layout).removeprefix('torch.')}"
        kind = f"a tensor of {str(value.dtype).removeprefix('torch.')} on {value.device}{layout}"
    elif isinstance(value, np.ndarray):
        kind = f"an array ({type(value).__name__}) of {value.dtype}"
    else:
        known = isinstance(value, int | float | complex | str | bytes | tuple | list | None)
        vast = isinstance(value, int) and abs(value) >= 2**1023  # more digits than Python may print
        if vast:
            return f"one of {value.bit_length()} bits"
        return reprlib.repr(value) if known else type(value).__name__
    broken = "" if not _is_plain(value) or _all_finite(value) else ", not all finite"
    return f"{kind}, of the shape {tuple(value.shape)}{broken}"


def _all_finite(value: np.ndarray | torch.Tensor) -> bool:
    return bool((torch.isfinite(value) if isinstance(value, torch.Tensor) else np.isfinite(value)).all())


@overload
def checked(subject: Subject, /) -> Subject:
    """Without rules."""


@overload
def checked(**rules: Rule) -> Callable[[Subject], Subject]:
    """With rules."""


def checked(subject: Subject | None = None, /, **rules: Rule) -> Subject | Callable[[Subject], Subject]:
    """Hold the arguments of a function, or those that make a class, against their annotations and rules.

    Args:
        subject: a function or a class; of a class, its `__init__` is wrapped.
        **rules: by parameter, what a value must be beyond its type.
    """
    if subject is None:
        return lambda given: checked_by(given, rules)
    return checked_by(subject, rules)


def checked_by(subject: Subject, rules: Mapping[str, Rule]) -> Subject:
    """`checked`, with the rules in a mapping."""
    if isinstance(subject, type):
        made = vars(subject)["__init__"]
        type.__setattr__(subject, "__init__", _wrapped(made, subject.__name__, rules))
        return subject
    return _wrapped(subject, subject.__qualname__.removesuffix(".__init__"), rules)  # type: ignore[return-value]


def _wrapped(function: Callable[..., Any], name: str, rules: Mapping[str, Rule]) -> Callable[..., Any]:
    unknown = set(rules) - set(signature(function).parameters)
    if unknown:
        raise TypeError(f"{name} has no parameter {', '.join(sorted(unknown))}")
    found: dict[str, _Check] = {}  # filled by the first call: annotations may name what is defined further down
    positional: list[_Check] = []

    @wraps(function)
    def wrapper(*args: Any, **named: Any) -> Any:
        if not found:
            found.update(_checks(function, name, rules))
            positional.extend(found.values())
        sound = [check(value) for check, value in zip(positional, args, strict=False)]
        for key, value in named.items():
            if key in found:
                named[key] = found[key](value)
        return function(*sound, *args[len(sound) :], **named)

    return wrapper


def _checks(function: Callable[..., Any], name: str, rules: Mapping[str, Rule]) -> dict[str, _Check]:
    """The checks of a function by parameter, in order."""
    names = getattr(function, "__globals__", {})
    checks = {}
    for key, parameter in signature(function).parameters.items():
        if parameter.kind in (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD):
            continue
        kind = None
        if parameter.annotation is not Parameter.empty:
            holder = types.SimpleNamespace(__annotations__={key: parameter.annotation})
            try:
                kind = _kind(get_type_hints(holder, globalns=names)[key])
            except NameError:  # imported for type checkers alone
                kind = None
        checks[key] = _Check(name, key, parameter.default, kind, rules.get(key))
    return checks


WrongType: type[Exception] = InvalidInput
WrongValue: type[Exception] = InvalidInput
