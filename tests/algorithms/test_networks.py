"""Shapes, starts and what each input reaches."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import scipy.stats
import slow_ddpg

from mapg_jax.algorithms.networks import LAST_LAYER_SCALE, Actor, Critic

D, A = 5, 2
HIDDEN = (16, 16)


@functools.cache
def make_actor(heads, hidden=HIDDEN, layer_norm=True, action_size=A):
    actor = Actor(heads=heads, action_size=action_size, hidden=hidden, layer_norm=layer_norm)
    return actor, jax.jit(actor.init)(jax.random.key(0), jnp.zeros((1, D)))


@functools.cache
def make_critic(hidden=HIDDEN, layer_norm=True):
    critic = Critic(hidden=hidden, layer_norm=layer_norm, action_layer=2)
    params = jax.jit(critic.init)(jax.random.key(0), jnp.zeros((1, D)), jnp.zeros((1, 1, A)))
    return critic, params


def inputs(*shape):
    rng = np.random.default_rng(0)
    observation = jnp.asarray(rng.normal(size=(*shape[:-1], D)), jnp.float32)
    return observation, jnp.asarray(rng.uniform(-1, 1, (*shape, A)), jnp.float32)


def test_a_head_starts_the_same_whatever_the_number_of_heads():
    (_, few), (_, many) = make_actor(3), make_actor(8)
    oracles.assert_equal(oracles.trunk(few), oracles.trunk(many))
    kernel, bias = oracles.last_layer(many, 8)
    oracles.assert_equal(oracles.last_layer(few, 3), (kernel[:, :3], bias[:3]))


def test_heads_start_apart():
    kernel, bias = oracles.last_layer(make_actor(8)[1], 8)
    for m in range(1, 8):
        assert not np.array_equal(kernel[:, m], kernel[:, 0])
        assert not np.array_equal(bias[m], bias[0])


def test_last_layers_start_uniform():
    """Within ±3e-3; Kolmogorov-Smirnov p < 1e-6 comes once in a million, and the key is fixed."""
    kernel, bias = oracles.last_layer(make_actor(50, action_size=6)[1], 50)
    critic = make_critic((16, 512))[1]["params"]
    uniform = scipy.stats.uniform(-LAST_LAYER_SCALE, 2 * LAST_LAYER_SCALE)
    for weights in (kernel, bias, critic["kernel"]):
        values = np.asarray(weights, np.float64).ravel()
        assert scipy.stats.kstest(values, uniform.cdf).pvalue > 1e-6


def test_proposals_are_m_actions_within_one():
    actor, params = make_actor(3)
    observation, _ = inputs(7, 1)
    wild = jax.tree.map(lambda x: 1e3 * x, params)
    proposals = actor.apply(wild, observation)
    assert proposals.shape == (7, 3, A)
    assert jnp.abs(proposals).max() == 1
    one = actor.apply(wild, observation[0])  # no batch
    np.testing.assert_allclose(one, proposals[0], atol=1e-3)  # tanh of float32 sums near 1e6


@pytest.mark.parametrize("hidden", [HIDDEN, (16, 8, 4)])
@pytest.mark.parametrize("layer_norm", [True, False])
def test_values_of_many_actions_are_those_of_each(hidden, layer_norm):
    critic, params = make_critic(hidden, layer_norm)
    observation, actions = inputs(7, 3)
    values = jax.jit(critic.apply)
    together = values(params, observation, actions)
    assert together.shape == (7, 3)
    for k in range(3):
        alone = values(params, observation, actions[:, k : k + 1])
        np.testing.assert_allclose(together[:, k : k + 1], alone, rtol=1e-5, atol=1e-6)  # float32
        again = values(params, observation[2], actions[2, k : k + 1])  # no batch
        np.testing.assert_allclose(together[2, k], again[0], rtol=1e-5, atol=1e-6)


def test_without_layer_norm_networks_are_the_papers_two_layers():
    """Against the plain forward passes of the oracle, to float32."""
    actor, actor_params = make_actor(1, layer_norm=False)
    critic, critic_params = make_critic(layer_norm=False)
    observation, actions = inputs(7, 1)
    np.testing.assert_allclose(
        actor.apply(actor_params, observation)[:, 0],
        slow_ddpg.actor(slow_ddpg.actor_parameters(actor_params), observation),
        rtol=1e-5,
        atol=1e-7,
    )
    np.testing.assert_allclose(
        critic.apply(critic_params, observation, actions)[:, 0],
        slow_ddpg.critic(slow_ddpg.critic_parameters(critic_params), observation, actions[:, 0]),
        rtol=1e-5,
        atol=1e-6,
    )


def test_layer_norm_makes_the_scale_of_a_layer_vanish():
    """With layer norm, a layer's kernel and bias times ten change nothing but rounding."""
    actor, params = make_actor(3)
    observation, _ = inputs(7, 1)
    first = params["params"]["Dense_0"]
    scaled = {**params["params"], "Dense_0": jax.tree.map(lambda x: 10 * x, first)}
    # Layer norm adds 1e-6 to a variance near 0.1: relative changes of about 1e-5.
    np.testing.assert_allclose(
        actor.apply({"params": scaled}, observation),
        actor.apply(params, observation),
        atol=1e-6,
    )
    plain, params = make_actor(1, layer_norm=False)
    scaled = {"params": {**params["params"], "Dense_0": jax.tree.map(lambda x: 10 * x, first)}}
    change = plain.apply(scaled, observation) - plain.apply(params, observation)
    assert jnp.abs(change).max() > 1e-3


def test_the_action_joins_at_the_second_layer():
    """A critic whose first layer is silenced still hears the action, and no longer the state."""
    critic, params = make_critic(layer_norm=False)
    silent = jax.tree.map(jnp.zeros_like, params["params"]["Dense_0"])
    params = {"params": {**params["params"], "Dense_0": silent}}
    observation, actions = inputs(7, 1)

    def total(observation, actions):
        return critic.apply(params, observation, actions).sum()

    to_state, to_action = jax.grad(total, (0, 1))(observation, actions)
    assert not to_state.any()
    assert to_action.any()


def test_an_action_that_joins_at_the_first_layer_stands_beside_the_state():
    """Q is a plain network of [s, a], as in TD3 and SAC."""
    critic = Critic(hidden=HIDDEN, layer_norm=False, action_layer=1)
    observation, actions = inputs(7, 3)
    params = jax.jit(critic.init)(jax.random.key(0), observation, actions)
    found = critic.apply(params, observation, actions)
    p = jax.tree.map(np.asarray, params["params"])
    for k in range(3):
        x = np.concatenate([observation, actions[:, k]], 1)
        x = x @ np.concatenate([p["features_kernel"], p["action_kernel"]]) + p["joint_bias"]
        x = np.maximum(x, 0) @ p["Dense_0"]["kernel"] + p["Dense_0"]["bias"]
        expected = np.maximum(x, 0) @ p["kernel"] + p["bias"]
        np.testing.assert_allclose(found[:, k], expected, rtol=1e-5, atol=1e-6)
