"""Which valve model belongs to which options: a new model is registered here, and nowhere else."""

from __future__ import annotations

from functools import singledispatch

from ..schemes.valve_models import PressureSource, Reservoir
from .model import ValveModel, ValveSetting
from .pressure_sources import PressureSources
from .reservoirs import Reservoirs


@singledispatch
def valve_model(options: object, setting: ValveSetting) -> ValveModel:
    """What valves do to particles, by the options of their model.

    Raises:
        TypeError: ``options`` are of no type that is registered.
    """
    known = ", ".join(sorted(kind.__name__ for kind in valve_model.registry if kind is not object))
    raise TypeError(f"no model is registered for valves of type {type(options).__name__}; known: {known}")


@valve_model.register
def _(options: PressureSource, setting: ValveSetting) -> ValveModel:
    return PressureSources(options, setting)


@valve_model.register
def _(options: Reservoir, setting: ValveSetting) -> ValveModel:
    return Reservoirs(options, setting)


def registered_models() -> list[type]:
    """The types of options that valves can be made of."""
    return [kind for kind in valve_model.registry if kind is not object]
