"""Plain values: what a text says, and what may be given to an option."""

import math
from typing import Literal

import pytest

from envs.values import fits, fitted, items, read


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("9.81", 9.81),
        ("aux_1", "aux_1"),
        ("(0.1, 2)", (0.1, 2)),
        ("[20,50]", [20, 50]),
        ("[town, eight]", ["town", "eight"]),
        ("[0.7,inf]", [0.7, math.inf]),
        ("[town,none]", ["town", None]),
        ("[a],[b]", "[a],[b]"),
        ("[]", []),
        ("none", None),
        ("null", None),
        ("None", None),
        ("true", True),
        ("'none'", "none"),
        ("{'a': [1, 2]}", {"a": [1, 2]}),
        ("[" * 100_000, "[" * 100_000),
    ],
)
def test_read(text, expected):
    assert read(text) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("64,64", ["64", "64"]),
        ("[64, 64]", ["64", "64"]),
        ("[64,64],[32,32]", ["[64,64]", "[32,32]"]),
        ("a=(1,2),b={'c': 1, 'd': 2}", ["a=(1,2)", "b={'c': 1, 'd': 2}"]),
        ("", []),
    ],
)
def test_items(text, expected):
    assert items(text) == expected


@pytest.mark.parametrize(
    ("value", "hint", "expected"),
    [
        (20, tuple[float, ...], (20,)),
        ([20, 50], tuple[float, ...], (20, 50)),
        ([1, 2], tuple[float, float] | None, (1, 2)),
        (None, tuple[float, float] | None, None),
        (1, tuple[float, float], 1),
        ("a", tuple[float, ...], "a"),
        (20, float, 20),
        ([1], object, [1]),
    ],
)
def test_fitted(value, hint, expected):
    assert fitted(value, hint) == expected


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
