"""Draw, take, average, spread, gap and choice, against NumPy; padding changes none of them."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from mapg_jax.algorithms import heads

M, PADDED, B, A = 3, 8, 50, 2


def random_proposals(size=M):
    rng = np.random.default_rng(0)
    proposals = rng.uniform(-1, 1, (B, size, A)).astype(np.float32)
    values = rng.normal(size=(B, size)).astype(np.float32)
    return jnp.asarray(proposals), jnp.asarray(values)


@pytest.mark.parametrize("m", [2, 7])
def test_heads_are_drawn_uniformly(m):
    """Chi-square below its mean plus 6 standard deviations, and the key is fixed."""
    n = 70_000
    drawn = heads.draw(jax.random.key(0), jnp.int32(m), (n,))
    counts = np.bincount(drawn, minlength=m)
    assert len(counts) == m
    assert ((counts - n / m) ** 2 / (n / m)).sum() < oracles.chi_square_limit(m)


def test_take_is_indexing():
    proposals, _ = random_proposals()
    head = np.random.default_rng(1).integers(0, M, B)
    for dtype in (np.int32, np.uint8):  # the replay keeps heads in a byte
        taken = heads.take(proposals, jnp.asarray(head, dtype))
        np.testing.assert_array_equal(taken, np.asarray(proposals)[np.arange(B), head])


def test_gradient_reaches_the_taken_head_alone():
    proposals, _ = random_proposals()
    head = np.random.default_rng(1).integers(0, M, B)
    gradient = jax.grad(lambda x: (heads.take(x, jnp.asarray(head)) ** 2).sum())(proposals)
    expected = np.zeros_like(proposals)
    expected[np.arange(B), head] = 2 * np.asarray(proposals)[np.arange(B), head]
    np.testing.assert_array_equal(gradient, expected)


def test_take_ignores_what_is_not_taken():
    """A masked sum must not let NaN or infinity of another head through."""
    proposals = jnp.array([[[1.0], [jnp.nan]], [[jnp.inf], [2.0]]])
    np.testing.assert_array_equal(heads.take(proposals, jnp.array([0, 1])), [[1.0], [2.0]])


def test_statistics_are_numpys():
    # float32: a few roundings of numbers near 1.
    proposals, values = random_proposals()
    m = jnp.int32(M)
    for got, slow, inputs in (
        (heads.spread(proposals, m), oracles.spread, proposals),
        (heads.q_gap(values, m), oracles.q_gap, values),
        (heads.mean(values, m), np.mean, values),
    ):
        expected = [slow(x) for x in np.asarray(inputs)]
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)


def test_one_head_has_neither_spread_nor_gap():
    proposals, values = random_proposals(1)
    assert not heads.spread(proposals, jnp.int32(1)).any()
    assert not heads.q_gap(values, jnp.int32(1)).any()


def test_choices_are_numpys():
    proposals, values = random_proposals()
    key, m = jax.random.key(0), jnp.int32(M)
    rows = np.arange(B)
    drawn = np.asarray(heads.draw(key, m, (B,)))
    expected = {
        "uniform": np.asarray(proposals)[rows, drawn],
        "argmax-q": np.asarray(proposals)[rows, np.asarray(values).argmax(-1)],
        "first": np.asarray(proposals)[:, 0],
    }
    for select, actions in expected.items():
        np.testing.assert_array_equal(heads.choose(select, key, proposals, values, m), actions)
    average = heads.choose("mean", key, proposals, values, m)
    np.testing.assert_allclose(average, np.asarray(proposals).mean(1), atol=1e-6)  # float32


@pytest.mark.parametrize("select", ["uniform", "argmax-q", "mean", "first"])
def test_padding_changes_no_choice(select):
    proposals, values = random_proposals(PADDED)
    key, m = jax.random.key(0), jnp.int32(M)
    padded = heads.choose(select, key, proposals, values.at[:, M:].set(1e9), m)
    plain = heads.choose(select, key, proposals[:, :M], values[:, :M], m)
    # Sums over 8 numbers, 5 of them 0, may round differently from sums over 3.
    np.testing.assert_allclose(padded, plain, atol=1e-7 if select == "mean" else 0)


def test_padding_changes_no_statistic():
    proposals, values = random_proposals(PADDED)
    m = jnp.int32(M)
    for statistic, inputs in (
        (heads.spread, proposals),
        (heads.q_gap, values),
        (heads.mean, values),
    ):
        padded = statistic(inputs.at[:, M:].multiply(1e9), m)
        np.testing.assert_allclose(padded, statistic(inputs[:, :M], m), rtol=1e-6)  # float32


def test_padding_changes_no_draw():
    """The number of heads may be traced, and the actor's size is not asked."""
    draw = jax.jit(lambda key, m: heads.draw(key, m, (1000,)))
    drawn = draw(jax.random.key(0), M)
    np.testing.assert_array_equal(drawn, heads.draw(jax.random.key(0), jnp.int32(M), (1000,)))
    assert set(np.asarray(drawn)) == set(range(M))


@pytest.mark.parametrize("temperature", [0.5, 2.0])
def test_heads_are_drawn_by_their_values(temperature):
    """Chi-square against p ∝ exp(Q / T) as above; heads that are padding change no draw."""
    values = np.array([0.3, -1.0, 0.9])
    weight = np.exp(values / temperature)
    expected = 60_000 * weight / weight.sum()
    drawn = []
    for padding in ([], [1e3, -1e3]):
        given = jnp.broadcast_to(
            jnp.asarray([*values, *padding], jnp.float32), (60_000, 3 + len(padding))
        )
        key, wide = jax.random.key(0), jnp.full(60_000, temperature)
        drawn.append(np.asarray(heads.draw_by_value(key, given, wide, jnp.int32(3))))
    np.testing.assert_array_equal(*drawn)
    counts = np.bincount(drawn[0], minlength=3)
    assert ((counts - expected) ** 2 / expected).sum() < oracles.chi_square_limit(3)


def test_one_head_is_drawn_whatever_it_is_worth():
    drawn = heads.draw_by_value(
        jax.random.key(0), jnp.full((50, 4), 7.0), jnp.ones(50), jnp.int32(1)
    )
    assert not np.asarray(drawn).any()


def test_distance_is_the_mean_over_pairs():
    proposals, _ = random_proposals(PADDED)
    expected = [oracles.distance(x[:M]) for x in np.asarray(proposals)]
    np.testing.assert_allclose(heads.distance(proposals, jnp.int32(M)), expected, rtol=1e-5)
    assert not heads.distance(proposals, jnp.int32(1)).any()
