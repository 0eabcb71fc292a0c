"""Digests of arrays, whole and by row."""

import hashlib

import numpy as np
import pytest

from mapg_jax.runs import checkpoint_record, hosts

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


def gathered(monkeypatch, *theirs):
    """Each time that numbers are gathered, those of another host are there."""
    left = iter(theirs)
    monkeypatch.setattr(hosts, "largest", lambda ours: np.maximum(ours, next(left)))


def test_rows_on_another_host_are_sealed_with_its_digests(monkeypatch):
    """Zeros stand for the rows that a host has not."""
    whole = checkpoint_record.digests_of({"rows": LEAVES["rows"]}, BY_ROW)
    theirs = checkpoint_record.digests_in(whole["rows"]).copy()
    ours = np.where(np.arange(4)[:, None] < 2, theirs, 0)
    theirs[:2] = 0
    monkeypatch.setattr(checkpoint_record, "_digests", lambda *_: ours.astype(np.uint8))
    gathered(monkeypatch, theirs, np.zeros(4, bool))
    assert checkpoint_record.digests_of({"rows": LEAVES["rows"]}, BY_ROW) == whole


@pytest.mark.parametrize("larger", [0, 1])
def test_hosts_that_differ_in_a_bit_seal_nothing(larger, monkeypatch):
    """Both are told so, whichever has the larger digest."""
    other = dict(LEAVES, number=np.nextafter(LEAVES["number"], np.float32(4)))
    digests = [
        np.concatenate([checkpoint_record.digests_in(x) for x in made.values()])
        for made in map(checkpoint_record.digests_of, (LEAVES, other))
    ]
    first, second = sorted(range(2), key=lambda k: digests[k].tolist())
    ours, theirs = (first, second) if larger else (second, first)
    unlike = (digests[theirs] != np.maximum(*digests)).any(axis=1)
    gathered(monkeypatch, digests[theirs], unlike)
    with pytest.raises(ValueError, match="the hosts differ in number; they must be alike"):
        checkpoint_record.digests_of((LEAVES, other)[ours])


def test_no_leaves_have_no_digests():
    assert checkpoint_record.digests_of({}) == {}
