"""The rings against a deque of whole steps, and their draws against the uniform distribution."""

import collections
import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from mapg_jax.algorithms.base import Transition
from mapg_jax.training import replay

N = 3
LIMIT = 4
add = jax.jit(replay.add)
read = jax.jit(replay.read)
sample = jax.jit(replay.sample, static_argnums=2)


class Worlds:
    """N environments that observe a count that never comes twice, and end as a coin says."""

    def __init__(self, seed: int, ends: float = 0.2, broken: float = 0.0):
        self.rng, self.chances = np.random.default_rng(seed), (ends, broken)
        self.count, self.age = 0, np.zeros(N, int)
        self.present = self.fresh()

    def fresh(self) -> np.ndarray:
        """N observations that were not there before."""
        self.count += N
        count = np.arange(self.count - N, self.count, dtype=np.float32)
        return np.stack([count, -count], 1)

    def step(self):
        """What `replay.add` takes."""
        ends, breaks = (self.rng.random(N) < chance for chance in self.chances)
        self.age += 1
        terminal = ends & ~breaks
        ended = ends | breaks | (self.age >= LIMIT)
        before, after = self.present, self.fresh()
        self.present = np.where(ended[:, None], self.fresh(), after)
        self.age[ended] = 0
        reward, head = before[:, 0] / 2, (before[:, 0] % 200).astype(np.int32)
        steps = Transition(before, head, before[:, :1] / 3, reward, terminal, after)
        return steps, ended, self.present, ~breaks


def empty(slots: int) -> replay.ReplayState:
    rows = jnp.zeros((N, 2))
    steps = Transition(rows, jnp.zeros(N, jnp.uint8), rows[:, :1], rows[:, 0], rows[:, 0] > 0, rows)
    return replay.init(steps, slots, LIMIT)


def one_by_one(steps: Transition) -> list[tuple]:
    """Steps as what can be compared."""
    leaves = [np.asarray(x, np.float32) for x in steps]
    return [tuple(x[i].tobytes() for x in leaves) for i in range(len(steps.reward))]


def whole(steps: Transition, kept: np.ndarray) -> list[tuple]:
    """Those that are kept, as they should be held: a terminal one leads to its own observation."""
    own = np.where(steps.terminal[:, None], steps.observation, steps.next_observation)
    return one_by_one(jax.tree.map(lambda x: x[kept], steps._replace(next_observation=own)))


def held(state: replay.ReplayState) -> list[tuple]:
    """The steps of the rings, the oldest first."""
    size, slots = int(state.size), replay.capacity(state)
    return one_by_one(read(state, (int(state.position) - size + np.arange(size)) % slots))


@pytest.mark.parametrize("slots", [3, 7, 32])
@pytest.mark.parametrize("ends", [0.0, 0.3, 1.0])
def test_the_newest_steps_are_held_whole(slots, ends):
    """Also where every episode is cut off at the limit, and after the rows have gone round."""
    worlds, state, oracle = Worlds(slots, ends), empty(slots), collections.deque(maxlen=slots)
    for _ in range(60):
        steps = worlds.step()
        state = add(state, *steps)
        oracle.extend(whole(steps[0], steps[-1]))
        assert held(state) == list(oracle)


@pytest.mark.parametrize("broken", [0.1, 0.6])
def test_what_is_not_kept_takes_no_slot(broken):
    """Its row is another's gap: the oldest go earlier, and what is held is whole."""
    slots = 20
    worlds, state, oracle = Worlds(1, 0.1, broken), empty(slots), collections.deque(maxlen=slots)
    sizes = []
    for _ in range(100):
        steps = worlds.step()
        state = add(state, *steps)
        oracle.extend(whole(steps[0], steps[-1]))
        sizes.append(int(state.size))
        assert held(state) == list(oracle)[len(oracle) - sizes[-1] :]
        assert sizes[-1] >= min(len(oracle), steps[-1].sum())
    rows = len(state.data.observations)
    assert int(replay.added(state)) == slots
    assert min(sizes[50:]) >= (1 - broken) * rows / 4  # a row a step, and one more where it ends
    assert len({*sizes[50:]}) > 1  # some went


@pytest.mark.parametrize("ends", [0.0, 0.2])
@pytest.mark.parametrize("broken", [0.0, 0.1])
@pytest.mark.parametrize("anew", [0.1, 0.3, 1.0])
def test_environments_that_begin_anew_leave_the_steps_before(ends, broken, anew):
    """As where a run goes on and their states could not be saved."""
    worlds, state, oracle = Worlds(2, ends, broken), empty(20), collections.deque(maxlen=20)
    coins = np.random.default_rng(5)
    for _ in range(100):
        if coins.random() < anew:
            worlds.present, worlds.age = worlds.fresh(), np.zeros(N, int)
            state = replay.cut_off(state, N)
        steps = worlds.step()
        state = add(state, *steps)
        oracle.extend(whole(steps[0], steps[-1]))
        assert held(state) == list(oracle)[len(oracle) - int(state.size) :]
    assert int(replay.added(state)) == 20 >= int(state.size) > 20 / 3


def test_emptied_rings_fill_again():
    worlds, state, oracle = Worlds(3), empty(20), collections.deque(maxlen=20)
    for t in range(30):
        if t == 15:
            state = jax.tree.map(jnp.zeros_like, replay.emptied(state))  # as it is saved
            oracle.clear()
        steps = worlds.step()
        state = add(state, *steps)
        oracle.extend(whole(steps[0], steps[-1]))
        assert held(state) == list(oracle)


def test_steps_take_the_types_of_their_slots():
    state = add(empty(4), *Worlds(0).step())
    assert state.data.steps.extra.dtype == jnp.uint8
    assert state.data.steps.terminal.dtype == bool


def test_more_steps_than_slots_are_refused():
    with pytest.raises(ValueError, match="3 steps do not fit 2 slots"):
        add(empty(2), *Worlds(0).step())


@functools.cache
def filled(turns: int, broken: float) -> replay.ReplayState:
    worlds, state = Worlds(4, 0.2, broken), empty(20)
    for _ in range(turns):
        state = add(state, *worlds.step())
    return state


CASES = pytest.mark.parametrize(("turns", "broken"), [(2, 0.0), (7, 0.0), (40, 0.0), (41, 0.5)])
"""Partly filled, full, gone round, and with fewer steps than slots then."""


@CASES
def test_samples_are_uniform_over_what_is_held(turns, broken):
    """Chi-square below its mean plus 6 standard deviations, and the key is fixed."""
    state, n = filled(turns, broken), 20_000
    assert (int(state.size) < 20) == (turns in (2, 41))
    sampled = sample(state, jax.random.key(0), n)
    counts = collections.Counter(one_by_one(sampled))
    assert set(counts) == set(held(state))
    expected = n / int(state.size)
    statistic = sum((count - expected) ** 2 / expected for count in counts.values())
    assert statistic < oracles.chi_square_limit(int(state.size))


@CASES
def test_trim_keeps_what_is_filled(turns, broken):
    state = filled(turns, broken)
    trimmed = replay.trim(state)
    slots, rows = len(trimmed.data.steps.reward), len(trimmed.data.observations)
    assert (slots, rows) == (min(turns * N, 20), int(state.rows))
    assert (rows == len(state.data.observations)) == (turns >= 40)
    for part, of_all in zip(
        jax.tree.leaves(trimmed.data), jax.tree.leaves(state.data), strict=True
    ):
        assert isinstance(part, np.ndarray)
        np.testing.assert_array_equal(part, of_all[: len(part)])
        assert not np.any(of_all[len(part) :])


def test_shards_side_by_side_are_as_one_by_one():
    """[S, ...] in front of every leaf, here of two that are filled to different lengths."""
    parts = filled(2, 0.0), filled(7, 0.0)
    state = jax.tree.map(lambda *x: jnp.stack(x), *parts)
    trimmed = replay.trim(state)
    assert trimmed.data.steps.reward.shape == (2, 20)
    assert trimmed.data.observations.shape == (2, int(parts[1].rows), 2)
    for k, part in enumerate(parts):
        of_one = jax.tree.map(lambda x, k=k: x[k], trimmed.data)
        rows = int(parts[1].rows)
        expected = part.data._replace(observations=part.data.observations[:rows])
        oracles.assert_equal(of_one, expected)
        one = jax.tree.map(lambda x, k=k: x[k], replay.cut_off(state, N))
        oracles.assert_equal(one, replay.cut_off(part, N))
    assert replay.capacity(state) == 40
    assert replay.bytes_of_a_step(state) == replay.bytes_of_a_step(parts[0])


def test_an_observation_is_held_once():
    """R = C + 2N + (C + N) / limit, and two rows of four bytes a step."""
    state = empty(1000)
    rows = 1000 + 2 * N + -(-(1000 + N) // LIMIT)
    assert state.data.observations.shape == (rows, 2)
    of_a_step = 1 + 4 + 4 + 1  # head, action, reward, terminal
    assert sum(x.nbytes for x in jax.tree.leaves(state.data.steps)) == 1000 * (of_a_step + 8)
    assert replay.bytes_of_a_step(state) == of_a_step + 2 * 8
