"""Plain values against annotations: what may be given to an option."""

from typing import Literal

import pytest

from envs.values import fits


@pytest.mark.parametrize(
    ("value", "hint", "expected"),
    [
        (1, int, True),
        (1.5, int, False),
        (True, int, False),
        (1, float, True),
        ("1", float, False),
        (True, float, False),
        (True, bool, True),
        (1, bool, False),
        ("a", str, True),
        (7, str, False),
        (None, float | None, True),
        (2.0, float | None, True),
        ("a", float | None, False),
        ((1, 2.5), tuple[float, float], True),
        ((1,), tuple[float, float], False),
        ((1, "a"), tuple[float, ...], False),
        (3, tuple[float, ...], False),
        ("a", Literal["a", "b"], True),
        ("c", Literal["a", "b"], False),
        (object(), object, True),
    ],
)
def test_fits(value, hint, expected):
    assert fits(value, hint) is expected
