"""What cannot be registered is named, and leaves nothing behind."""

import pytest

from mapg_jax.algorithms import registry
from mapg_jax.algorithms.td3 import Td3


class Scored(Td3):
    """By none of the ways that every run is scored by."""

    selects = ("first",)


class Unnamed(Td3):
    """Its results would pass for TD3's."""


class Named(Td3):
    """As it should be."""

    @staticmethod
    def slug(heads):
        return "named"


@pytest.mark.parametrize(
    ("name", "algorithm", "message"),
    [
        ("Mine", Named, "an algorithm's name is of a-z, 0-9, _ and -, got 'Mine'"),
        ("td3", Named, "there is another algorithm 'td3'"),
        ("mine", object, "the algorithm 'mine' lacks .*Metrics"),
        ("mine", Scored, "the algorithm 'mine' needs uniform among its selects"),
        ("mine", Unnamed, "the algorithm 'mine' has the slug 'td3' of 'td3'"),
    ],
)
def test_what_cannot_be_registered_is_named(name, algorithm, message):
    before = registry.names()
    with pytest.raises(ValueError, match=message):
        registry.register(name, algorithm)
    assert registry.names() == before


def test_what_is_registered_is_found(monkeypatch):
    monkeypatch.setattr(registry, "_ALGORITHMS", dict(registry._ALGORITHMS))
    registry.register("mine", Named)
    assert registry.find("mine") is Named and registry.of_slug("named", 3) is Named
