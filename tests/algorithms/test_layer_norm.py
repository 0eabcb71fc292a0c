"""Layer norm and ReLU against flax's, in values and derivatives of first and second order.

Algebra is checked in float64, where 1e-10 is far above rounding and far below any mistake.
"""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

from mapg_jax.algorithms.layer_norm import layer_norm_relu

B, W = 7, 48
CLOSE = {"rtol": 1e-10, "atol": 1e-10}  # float64
UNIT = 2.0**-24  # rounding of float32


def flax_layer_norm_relu(x, scale, bias):
    return nn.relu(nn.LayerNorm().apply({"params": {"scale": scale, "bias": bias}}, x))


def numbers(seed, shape=(B, W), dtype: type = np.float64, offset=0.0):
    """x, scale and bias."""
    rng = np.random.default_rng(seed)
    arrays = rng.normal(offset, 1, shape), rng.normal(1, 0.3, W), rng.normal(0, 0.3, W)
    return tuple(np.asarray(array, dtype) for array in arrays)


def value(f, at, along, weights):
    return f(*at)


def gradient(f, at, along, weights):
    """Of a weighted sum of the outputs."""
    return jax.vjp(f, *at)[1](weights)


def tangent(f, at, along, weights):
    return jax.jvp(f, at, along)


def tangent_of_gradient(f, at, along, weights):
    """A Hessian-vector product, forward over reverse."""
    return jax.jvp(lambda *at: gradient(f, at, along, weights), at, along)


def gradient_of_tangent(f, at, along, weights):
    """The same product, reverse over forward."""
    return jax.grad(lambda at: jnp.vdot(weights, tangent(f, at, along, weights)[1]))(at)


def tangent_of_tangent(f, at, along, weights):
    return jax.jvp(lambda *at: tangent(f, at, along, weights)[1], at, along)


def gradient_in_lockstep(f, at, along, weights):
    """Of several runs, each with its own scale and bias."""
    stacked = [jnp.stack([x, x + dx]) for x, dx in zip(at, along, strict=True)]
    return jax.vmap(lambda *at: gradient(f, at, along, weights))(*stacked)


@functools.cache
def compiled(f, derivative):
    return jax.jit(functools.partial(derivative, f))


SECOND_ORDER = [tangent_of_gradient, gradient_of_tangent, tangent_of_tangent]


@pytest.mark.parametrize(
    ("derivative", "shape"),
    [(derivative, (B, W)) for derivative in (tangent, gradient_in_lockstep, *SECOND_ORDER)]
    + [(derivative, shape) for derivative in (value, gradient) for shape in ((W,), (3, 2, W))],
)
def test_it_is_flaxs_layer_norm_and_relu(derivative, shape):
    with jax.enable_x64(True):
        at, along, (weights, _, _) = (numbers(seed, shape) for seed in range(3))
        ours, flaxs = (
            compiled(f, derivative)(at, along, weights)
            for f in (layer_norm_relu, flax_layer_norm_relu)
        )
    compare = functools.partial(np.testing.assert_allclose, **CLOSE)
    jax.tree.map(compare, ours, flaxs)


def errors(f, derivative, offset):
    """The largest error of every float32 result, over its largest number or 1."""
    with jax.enable_x64(True):
        at, along = numbers(0, offset=offset, dtype=np.float32), numbers(1, dtype=np.float32)
        weights = numbers(2, dtype=np.float32)[0]
        wide = jax.tree.map(lambda x: np.asarray(x, np.float64), (at, along, weights))
        exact = jax.tree.map(np.asarray, compiled(flax_layer_norm_relu, derivative)(*wide))
        got = jax.tree.map(np.asarray, compiled(f, derivative)(at, along, weights))
    assert all(x.dtype == np.float32 for x in jax.tree.leaves(got))
    pairs = zip(jax.tree.leaves(got), jax.tree.leaves(exact), strict=True)
    return [np.abs(x - y).max() / max(1, np.abs(y).max()) for x, y in pairs]


@pytest.mark.parametrize("derivative", [value, gradient, tangent_of_gradient])
def test_float32_errs_by_rounding_alone(derivative):
    """A sum of W terms errs by at most W roundings; two such sums, one in the other, by 2 W."""
    assert max(errors(layer_norm_relu, derivative, offset=0.0)) < 2 * W * UNIT


def test_the_variance_does_not_cancel():
    """Far from 0, E[x²] - E[x]² loses the offset's square in roundings; deviations lose less."""
    (ours,), (flaxs,) = (
        errors(f, value, offset=100.0) for f in (layer_norm_relu, flax_layer_norm_relu)
    )
    assert ours < 2 * 100 * UNIT  # x - mean: the roundings of x and of the mean
    assert flaxs > ours


def test_equal_inputs_give_the_bias_and_finite_gradients():
    _, scale, bias = numbers(0, dtype=np.float32)
    y, pull = jax.vjp(layer_norm_relu, jnp.zeros((B, W)), scale, bias)
    np.testing.assert_array_equal(y, np.broadcast_to(np.maximum(bias, 0), (B, W)))
    assert all(np.isfinite(x).all() for x in pull(jnp.ones_like(y)))


def test_sums_are_products_in_full_precision():
    """What makes it quick on a CPU, and right on accelerators, which would take TF32."""
    at = numbers(0, dtype=np.float32)
    program = jax.make_jaxpr(lambda *at: jax.vjp(layer_norm_relu, *at)[1](at[0]))(*at)
    equations = list(_equations(program.jaxpr))
    products = [e for e in equations if e.primitive.name == "dot_general"]
    sums = [e for e in equations if "reduce" in e.primitive.name]
    assert all(e.invars[0].aval.size == e.outvars[0].aval.size for e in sums)  # over axes of 1
    assert len(products) >= 6
    highest = (jax.lax.Precision.HIGHEST,) * 2
    assert all(e.params["precision"] == highest for e in products)


def _equations(jaxpr):
    for equation in jaxpr.eqns:
        yield equation
        for inner in jaxprs_in_params(equation.params):
            yield from _equations(inner)
