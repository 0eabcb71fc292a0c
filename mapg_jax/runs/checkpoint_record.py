"""What a checkpoint says of itself: what its arrays are to be when they are read, and its seal.

An array that has a row for each shard [S, ...] has a digest for each row, one after the other, so
that each of several hosts can make and check those of the rows that it holds.
"""

import hashlib
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from mapg_jax.runs import hosts

SIZE = 16  # bytes of a digest


class Record(NamedTuple):
    """What a checkpoint says of itself, as JSON."""

    env_steps: int
    config: str
    """The digest of the run's configuration."""
    host: dict[str, Any]
    """The host's own numbers."""
    leaves: dict[str, dict[str, dict[str, Any]]]
    """By part and name: shape, dtype and digest."""

    def seal(self) -> str:
        """The digest of all of it."""
        text = json.dumps(self._asdict(), sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=SIZE).hexdigest()


def digests_of(
    leaves: Mapping[str, Any], by_row: Collection[str] = ()
) -> dict[str, dict[str, Any]]:
    """What arrays are to be when they are read again; all hosts that hold them ask together.

    Args:
      leaves: arrays of NumPy, or of JAX on the devices of several hosts.
      by_row: names of those that have a digest for each row.

    Raises:
      ValueError: if the hosts have different numbers where they should have the same; on all.
    """
    found = [_digests(leaf, leaf.shape, name in by_row) for name, leaf in leaves.items()]
    if not found:
        return {}
    ours = np.concatenate(found)
    whole = hosts.largest(ours)
    unlike = hosts.largest(ours.any(axis=1) & (ours != whole).any(axis=1))
    if unlike.any():
        names = np.repeat(list(leaves), [len(rows) for rows in found])
        raise ValueError(
            f"the hosts differ in {names[unlike][0]}; they must be alike (processors, versions)"
        )
    ends = np.cumsum([len(rows) for rows in found])[:-1]
    return {
        name: {"shape": list(leaf.shape), "dtype": str(leaf.dtype), "digest": rows.tobytes().hex()}
        for (name, leaf), rows in zip(leaves.items(), np.split(whole, ends), strict=True)
    }


def holds(leaf: Any, written: Mapping[str, Any]) -> bool:
    """Whether an array is what was written, as far as this host has it.

    Args:
      leaf: the array, or one with more behind it along other axes than the first.
      written: of the array, as `digests_of` gives it.
    """
    wanted = digests_in(written)
    if str(leaf.dtype) != written["dtype"] or list(leaf.shape[:1]) != written["shape"][:1]:
        return False
    if len(wanted) not in (1, *leaf.shape[:1]):
        return False
    found = _digests(leaf, written["shape"], len(wanted) > 1)
    here = found.any(axis=1)
    return bool((found == wanted)[here].all())


def digests_in(written: Mapping[str, Any]) -> np.ndarray:
    """Those of an array's rows, or of all of it [1, SIZE]."""
    return np.frombuffer(bytes.fromhex(written["digest"]), np.uint8).reshape(-1, SIZE)


def _digests(leaf: Any, shape: Sequence[int], by_row: bool) -> np.ndarray:
    """Of the array, or of each of its rows [S, SIZE]; zeros of those on other hosts."""
    found = np.zeros((len(leaf) if by_row else 1, SIZE), np.uint8)
    for first, content in _here(leaf):
        inside = (slice(None), *map(slice, shape[1:]))[: content.ndim]
        for k, row in enumerate(content[inside] if by_row else [content[inside]], first):
            bits = np.ascontiguousarray(row).view(np.uint8).data
            found[k] = np.frombuffer(hashlib.blake2b(bits, digest_size=SIZE).digest(), np.uint8)
    return found


def _here(leaf: Any) -> Iterator[tuple[int, np.ndarray]]:
    """The blocks of rows that this host has, and where they begin."""
    if not isinstance(leaf, jax.Array) or leaf.is_fully_addressable or leaf.is_fully_replicated:
        yield 0, np.asarray(leaf)
        return
    for shard in leaf.addressable_shards:
        yield shard.index[0].start or 0, np.asarray(shard.data)
