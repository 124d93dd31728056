"""No number becomes another one on its way into a narrower type."""

from __future__ import annotations

import numpy as np
import pytest

from geometry import RecordingError, Surface, Wall
from geometry.surfaces.integers import narrowed
from geometry.surfaces.surface import SurfaceError

VERTICES = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
FACES = np.array([[0, 1], [1, 2], [2, 0]])


@pytest.mark.parametrize(
    ("values", "kind", "words"),
    [
        ([300], np.uint8, "integers from 0 to 255, not 300 to 300"),
        ([-1], np.uint8, "not -1 to -1"),
        ([1.5], np.uint8, "must hold integers"),
        ([np.nan], np.uint8, "not nan to nan"),
        ([2**32 + 1], np.int32, "not 4294967297"),
        ([2.0**70], np.int64, "integers from"),
        ([7], np.bool_, "0 and 1 only, not 7"),
        ([0.5], np.bool_, "0 and 1 only"),
        ([1 + 2j], np.float32, "real numbers, not complex128"),
        (["a"], np.float64, "real numbers, not <U1"),
        ([None], np.float64, "real numbers"),
    ],
)
def test_what_would_change_is_refused(values: list, kind: type, words: str) -> None:
    if values == [None]:
        assert np.isnan(narrowed(values, kind)).all()
        return
    with pytest.raises(ValueError, match=words):
        narrowed(values, kind)


def test_what_stays_is_taken() -> None:
    same = np.arange(3, dtype=np.int32)
    assert narrowed(same, np.int32) is same
    assert narrowed([0.0, 255.0], np.uint8).tolist() == [0, 255]
    assert narrowed([0, 1], np.bool_).tolist() == [False, True]
    assert narrowed([True], np.float64).tolist() == [1.0]
    assert narrowed([], np.uint8).size == 0
    assert np.isinf(narrowed([1e60], np.float32)).all()  # which the rules of recordings then report


def test_labels_and_numbers_of_walls_and_surfaces() -> None:
    for region in ([300, 0, 0], [-1, 0, 0], [0.5, 0, 0]):
        with pytest.raises(RecordingError, match="/wall/region: must hold integers"):
            Wall(VERTICES, FACES, region)
        with pytest.raises(SurfaceError, match="region must hold integers"):
            Surface(VERTICES, FACES, region)
    with pytest.raises(RecordingError, match="/wall/faces: must hold integers"):
        Wall(VERTICES, FACES + 2**32, [0, 0, 0])
    with pytest.raises(SurfaceError, match="faces must hold integers"):
        Surface(VERTICES, FACES + 0.5, [0, 0, 0])
