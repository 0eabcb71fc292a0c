"""Digests of arrays, whole and by row."""

import hashlib

import numpy as np
import pytest

from mapg_jax.runs import checkpoint_record

LEAVES = {
    "rows": np.arange(24, dtype=np.float32).reshape(4, 3, 2),
    "whole": np.arange(6).reshape(2, 3),
    "number": np.array(3.5, np.float32),
    "flags": np.array([True, False, True, True]),
}
BY_ROW = ("rows", "flags")


def digest(content: np.ndarray) -> str:
    return hashlib.blake2b(content.tobytes(), digest_size=checkpoint_record.SIZE).hexdigest()


def test_the_digest_by_row_is_those_of_the_rows():
    made = checkpoint_record.digests_of(LEAVES, BY_ROW)
    assert made["whole"] == {"shape": [2, 3], "dtype": "int64", "digest": digest(LEAVES["whole"])}
    assert made["number"]["digest"] == digest(LEAVES["number"])
    for name in BY_ROW:
        assert made[name]["digest"] == "".join(map(digest, LEAVES[name]))


@pytest.mark.parametrize("name", LEAVES)
def test_every_bit_counts(name):
    seal = checkpoint_record.digests_of(LEAVES, BY_ROW)[name]
    assert checkpoint_record.holds(LEAVES[name], seal)
    for byte in range(LEAVES[name].nbytes):
        other = np.array(LEAVES[name])
        other.reshape(-1).view(np.uint8)[byte] ^= 1
        assert not checkpoint_record.holds(other, seal)
    assert not checkpoint_record.holds(LEAVES[name].astype(np.float16), seal)


def test_what_lies_behind_the_array_does_not_count():
    """As of a replay that was not full, in its full size."""
    seal = checkpoint_record.digests_of(LEAVES, BY_ROW)["rows"]
    larger = np.pad(LEAVES["rows"], ((0, 0), (0, 5), (0, 0)))
    assert checkpoint_record.holds(larger, seal)
    larger[2, 1, 1] += 1
    assert not checkpoint_record.holds(larger, seal)


def test_rows_that_change_places_do_not_pass():
    seal = checkpoint_record.digests_of(LEAVES, BY_ROW)["rows"]
    assert not checkpoint_record.holds(LEAVES["rows"][::-1].copy(), seal)
    assert not checkpoint_record.holds(LEAVES["rows"][:3], seal)


def test_a_record_with_another_number_of_digests_does_not_hold():
    seal = checkpoint_record.digests_of(LEAVES, BY_ROW)["rows"]
    assert not checkpoint_record.holds(
        LEAVES["rows"], {**seal, "digest": seal["digest"][: 2 * checkpoint_record.SIZE * 3]}
    )


def test_no_leaves_have_no_digests():
    assert checkpoint_record.digests_of({}) == {}
