"""Pair sums over neighbouring particles behind one interface, with interchangeable backends."""

from .backends.reference import ReferenceBackend
from .interface import Backend, Moments, MomentumTerms, PairState, Rates, RateTerms, Support
from .registry import available_backends, choose_backend

backend = choose_backend  # its name in earlier versions

__all__ = [
    "Backend",
    "Moments",
    "MomentumTerms",
    "PairState",
    "RateTerms",
    "Rates",
    "ReferenceBackend",
    "Support",
    "available_backends",
    "backend",
    "choose_backend",
]
