"""The sample recordings that ship with the package (made by `examples/make_sample.py`)."""

from pathlib import Path

__all__ = ["sample_measurement", "sample_truth"]

_HERE = Path(__file__).resolve().parent


def sample_measurement() -> Path:
    """The measured recording of the sample: 10 ms frames from late ejection to the filling jet."""
    return _HERE / "sample_measured.h5"


def sample_truth() -> Path:
    """The true recording of the sample: the same grid and stretch as the measurement, 5 ms frames."""
    return _HERE / "sample_true.h5"
