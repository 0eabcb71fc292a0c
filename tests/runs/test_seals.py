"""Digests of arrays, whole and by row."""

import hashlib

import numpy as np
import pytest

from mapg_jax.runs import seals

LEAVES = {
    "rows": np.arange(24, dtype=np.float32).reshape(4, 3, 2),
    "whole": np.arange(6).reshape(2, 3),
    "number": np.array(3.5, np.float32),
    "flags": np.array([True, False, True, True]),
}
BY_ROW = ("rows", "flags")


def digest(content: np.ndarray) -> str:
    return hashlib.blake2b(content.tobytes(), digest_size=seals.SIZE).hexdigest()


def test_the_digest_by_row_is_those_of_the_rows():
    made = seals.of(LEAVES, BY_ROW)
    assert made["whole"] == {"shape": [2, 3], "dtype": "int64", "digest": digest(LEAVES["whole"])}
    assert made["number"]["digest"] == digest(LEAVES["number"])
    for name in BY_ROW:
        assert made[name]["digest"] == "".join(map(digest, LEAVES[name]))


@pytest.mark.parametrize("name", LEAVES)
def test_every_bit_counts(name):
    seal = seals.of(LEAVES, BY_ROW)[name]
    assert seals.holds(LEAVES[name], seal)
    for byte in range(LEAVES[name].nbytes):
        other = np.array(LEAVES[name])
        other.reshape(-1).view(np.uint8)[byte] ^= 1
        assert not seals.holds(other, seal)
    assert not seals.holds(LEAVES[name].astype(np.float16), seal)


def test_what_lies_behind_the_array_does_not_count():
    """As of a replay that was not full, in its full size."""
    seal = seals.of(LEAVES, BY_ROW)["rows"]
    larger = np.pad(LEAVES["rows"], ((0, 0), (0, 5), (0, 0)))
    assert seals.holds(larger, seal)
    larger[2, 1, 1] += 1
    assert not seals.holds(larger, seal)


def test_rows_that_change_places_do_not_pass():
    seal = seals.of(LEAVES, BY_ROW)["rows"]
    assert not seals.holds(LEAVES["rows"][::-1].copy(), seal)
    assert not seals.holds(LEAVES["rows"][:3], seal)


def test_a_seal_with_another_number_of_digests_does_not_hold():
    seal = seals.of(LEAVES, BY_ROW)["rows"]
    assert not seals.holds(LEAVES["rows"], {**seal, "digest": seal["digest"][: 2 * seals.SIZE * 3]})


def test_no_leaves_have_no_seals():
    assert seals.of({}) == {}
