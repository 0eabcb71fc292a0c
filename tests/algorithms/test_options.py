"""Numbers that a user sets: their types, their bounds and what is said of them."""

import dataclasses
import math

import pytest

from mapg_jax.algorithms.options import Options, option


@dataclasses.dataclass(frozen=True, kw_only=True)
class Some(Options):
    """One option of each kind of bounds."""

    least: float = option(1.0, "At least 1.", at_least=1)
    above: float = option(1.0, "Above 0.", above=0)
    most: int = option(1, "Between 0 and 3.", at_least=0, at_most=3)
    share: float = option(0.5, "In [0, 1).", at_least=0, below=1)
    off: float | None = option(None, "Above 0, or off.", above=0)
    names: tuple[str, ...] = option((), "Some names.")


@pytest.mark.parametrize(
    ("name", "allowed", "refused", "bound"),
    [
        ("least", [1, 1.0, 9.5], [0.99, -1, -math.inf], "at least 1"),
        ("above", [1e-9, 3], [0, 0.0, -1e-9], "above 0"),
        ("most", [0, 3], [4], "at most 3"),
        ("most", [1], [-1], "at least 0"),
        ("share", [0, 0.999], [1, 1.0, -1e-9], r"in \[0, 1\)"),
        ("off", [None, 0.1], [0.0], "above 0"),
    ],
)
def test_values_at_their_bounds(name, allowed, refused, bound):
    for value in allowed:
        assert getattr(Some(**{name: value}), name) == value
    for value in refused:
        expected = bound if math.isfinite(value) else "finite"
        with pytest.raises(ValueError, match=f"^{name} must be {expected}, got {value}$"):
            Some(**{name: value})


def test_what_is_no_number_is_refused():
    for name in ("least", "above", "share", "off"):
        with pytest.raises(ValueError, match=f"^{name} must be finite, got nan$"):
            Some(**{name: math.nan})


def test_whole_numbers_are_floats_and_nothing_else_is_taken_for_another_type():
    assert Some(least=3).least == 3
    for name, value in {"least": "3", "most": 1.0, "off": "none", "names": "ab"}.items():
        with pytest.raises(ValueError, match=f"^{name} must be .*, got "):
            Some(**{name: value})
    with pytest.raises(ValueError, match=r"^least must be float, got True$"):
        Some(least=True)


def test_lists_become_tuples():
    assert Some(names=["a", "b"], hidden=[4, 4]) == Some(names=("a", "b"), hidden=(4, 4))
    assert hash(Some(names=["a"])) == hash(Some(names=("a",)))


def test_an_option_knows_what_the_command_line_and_the_reports_ask():
    known = {field.name: field.metadata for field in dataclasses.fields(Some)}
    assert known["share"]["help"] == "In [0, 1)."
    assert known["share"]["bounds"] == {"at least": 0, "below": 1}
    assert known["names"]["bounds"] == {}
    assert not known["share"]["of_heads"]
    assert not known["share"]["host"]
