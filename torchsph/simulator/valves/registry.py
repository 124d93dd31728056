"""Which valve model belongs to which options: a new one is a row here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..schemes.valve_models import PressureSource, Reservoir
from .model import ValveModel, ValveSetting
from .pressure_sources import PressureSources
from .reservoirs import Reservoirs

# options -> model; called with the options and the setting
_MODELS: dict[type, Callable[[Any, ValveSetting], ValveModel]] = {
    PressureSource: PressureSources,
    Reservoir: Reservoirs,
}


def make_valves(options: object | None, setting: ValveSetting) -> ValveModel:
    """The valve model of some options; valves that stay shut where there are none, or no valves.

    Raises:
        ValueError: no model is known for the options.
    """
    if options is None or not setting.scene.valves:
        return ValveModel()
    if type(options) not in _MODELS:
        known = ", ".join(sorted(kind.__name__ for kind in _MODELS))
        raise ValueError(f"no valve model is known for {options!r}; known options: {known}")
    return _MODELS[type(options)](options, setting)
