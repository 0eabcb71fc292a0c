"""The update: targets, gradients head by head, DDPG as M = 1, and padding.

Algebra is checked in float64, where 1e-10 is far above rounding and far below any mistake.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import oracles
import pytest
import slow_ddpg

from mapg_jax.algorithms.base import Transition
from mapg_jax.algorithms.descent import kernel_l2
from mapg_jax.algorithms.deterministic import LearnerState, Strength
from mapg_jax.algorithms.mapg import Hyperparameters, Mapg
from mapg_jax.algorithms.returns import td_target
from mapg_jax.training.agent import hyperparameters, make_agent
from mapg_jax.training.config import Config

M, B, D, A = 4, 12, 3, 2
CLOSE = {"rtol": 1e-10, "atol": 1e-12}  # float64
CONFIG = dataclasses.replace(
    oracles.TINY,
    heads=M,
    actor_learning_rate=1e-2,
    critic_learning_rate=1e-2,
    tau=0.1,
    discount=0.9,
)


RULES = [("stored", "mean"), ("resampled", "sampled"), ("all", "max")]
PLAIN_RULES = [{"gradient": gradient, "target": target} for gradient, target in RULES]
APART = [
    {"repulsion": "stein", "floor": 0.5, "repulsion_updates": 10},
    {"repulsion": "inverse", "gradient": "all"},
]


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


@functools.cache
def initial(heads: int, layer_norm: bool, padded_heads: int | None) -> LearnerState:
    """Networks whose targets differ from them and whose outputs are not tiny, in float64."""
    config = dataclasses.replace(CONFIG, heads=heads, layer_norm=layer_norm)
    algorithm = make_agent(config, A, padded_heads).algorithm
    with jax.enable_x64(False):
        init = jax.jit(algorithm.init, static_argnums=1)
        state, other = init(jax.random.key(0), D), init(jax.random.key(1), D)

    def grown(params, factor):
        last = {k: factor * params["params"][k] for k in ("kernel", "bias")}
        return {"params": {**params["params"], **last}}

    state = state.replace(
        actor=grown(state.actor, 100.0),
        critic=grown(state.critic, 100.0),
        actor_target=grown(other.actor, 70.0),
        critic_target=grown(other.critic, 130.0),
    )
    return jax.tree.map(lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x, state)


def setup(
    config: Config, padded_heads: int | None = None
) -> tuple[Mapg, LearnerState, Hyperparameters]:
    """The algorithm, its state and its numbers."""
    algorithm = make_agent(config, A, padded_heads).algorithm
    state = initial(config.heads, config.layer_norm, padded_heads)
    state = state.replace(
        actor_optimizer=algorithm.optimizer.init(state.actor),
        critic_optimizer=algorithm.optimizer.init(state.critic),
    )
    hyper = hyperparameters(config)
    floats = {name for name, x in vars(hyper).items() if x.dtype == jnp.float32}
    names = floats - {"noise_scale", "noise_scale_last"}  # no update asks for σ
    numbers = {name: jnp.float64(getattr(config, name)) for name in names}
    return algorithm, state, hyper.replace(**numbers)  # pyright: ignore[reportReturnType]


def make_batch(heads, terminal=0.3, seed=0, size=B) -> Transition:
    rng = np.random.default_rng(seed)
    return Transition(
        observation=jnp.asarray(rng.normal(size=(size, D))),
        extra=jnp.asarray(rng.choice(heads, size), jnp.uint8),
        action=jnp.asarray(rng.uniform(-1, 1, (size, A))),
        reward=jnp.asarray(rng.normal(size=size)),
        terminal=jnp.asarray(rng.random(size) < terminal),
        next_observation=jnp.asarray(rng.normal(size=(size, D))),
    )


@functools.cache
def compiled_actor_gradient(config: Config):
    return jax.jit(jax.grad(make_agent(config, A).algorithm.actor_loss))


def actor_gradient(config: Config, batch, key=None, actor=None):
    _, state, hyper = setup(config)
    actor = state.actor if actor is None else actor
    key = jax.random.key(0) if key is None else key
    none = Strength(jnp.zeros(()), jnp.zeros(()))
    return compiled_actor_gradient(config)(actor, state.critic, batch, hyper, none, key)


@functools.cache
def compiled_update(config: Config, padded_heads: int | None = None):
    return jax.jit(make_agent(config, A, padded_heads).algorithm.update)


def assert_close(got, expected, **tolerance):
    compare = functools.partial(np.testing.assert_allclose, **(tolerance or CLOSE))
    jax.tree.map(compare, got, expected)


# ----- targets


def test_td_target_is_the_one_step_return():
    reward, discount, value = jnp.array([1.0, 2.0]), jnp.array([0.9, 0.0]), jnp.array([10.0, 7.0])
    np.testing.assert_allclose(td_target(reward, discount, value), [10.0, 2.0], **CLOSE)


def slow_next_values(algorithm, state, observation):
    """Q'(s', ρ'_m(s')), one state and one head at a time, [B, M]."""
    proposals = jax.jit(algorithm.actions)(state.actor_target, observation)
    values = jax.jit(algorithm.values)
    return np.array(
        [
            [values(state.critic_target, s, a[None])[0] for a in actions]
            for s, actions in zip(observation, proposals, strict=True)
        ]
    )


def test_the_target_is_the_mean_over_the_heads_of_the_target_networks():
    algorithm, state, hyper = setup(CONFIG)
    observation = make_batch(range(M)).next_observation
    value = jax.jit(algorithm.next_value)(state, hyper, observation, jax.random.key(0))
    expected = slow_next_values(algorithm, state, observation).mean(1)
    np.testing.assert_allclose(value, expected, **CLOSE)


def test_the_sampled_target_is_one_head_drawn_uniformly():
    """Every value is one head's, and each head comes in its share: 6 standard errors of 1 / M."""
    algorithm, state, hyper = setup(dataclasses.replace(CONFIG, target="sampled"))
    observation = make_batch(range(M)).next_observation
    keys = jax.random.split(jax.random.key(0), 500)
    draw = jax.vmap(algorithm.next_value, in_axes=(None, None, None, 0))
    sampled = jax.jit(draw)(state, hyper, observation, keys)
    values = slow_next_values(algorithm, state, observation)
    distance = np.abs(np.asarray(sampled)[..., None] - values)  # [draws, B, M]
    assert distance.min(-1).max() < 1e-12
    share = np.bincount(distance.argmin(-1).ravel(), minlength=M) / (500 * B)
    assert np.abs(share - 1 / M).max() < 6 * np.sqrt(1 / M * (1 - 1 / M) / (500 * B))


def test_the_largest_target_is_the_best_heads():
    algorithm, state, hyper = setup(dataclasses.replace(CONFIG, target="max"))
    observation = make_batch(range(M)).next_observation
    value = jax.jit(algorithm.next_value)(state, hyper, observation, jax.random.key(0))
    expected = slow_next_values(algorithm, state, observation).max(1)
    np.testing.assert_allclose(value, expected, **CLOSE)


@pytest.mark.parametrize("target", ["mean", "sampled"])
def test_terminal_transitions_do_not_bootstrap(target):
    """What comes after a terminal step changes nothing at all; after another step it does."""
    config = dataclasses.replace(CONFIG, target=target)
    _, state, hyper = setup(config)
    update, key = compiled_update(config), jax.random.key(0)
    for terminal in (True, False):
        batch = make_batch(range(M))._replace(terminal=jnp.full(B, terminal))
        moved = batch._replace(next_observation=batch.next_observation + 1)
        (one, _), (other, _) = update(state, hyper, batch, key), update(state, hyper, moved, key)
        if terminal:
            oracles.assert_equal(one, other)
        else:
            kernel, moved_kernel = (s.critic["params"]["kernel"] for s in (one, other))
            assert not np.array_equal(kernel, moved_kernel)


def test_the_critics_loss_is_squared_error_and_penalty():
    algorithm, state, hyper = setup(CONFIG)
    batch = make_batch(range(M))
    target = jnp.linspace(-1, 1, B)
    loss, found = algorithm.critic_loss(state.critic, batch, target, hyper.critic_l2)
    q = np.asarray(algorithm.values(state.critic, batch.observation, batch.action[:, None]))[:, 0]
    error = np.mean((np.asarray(target) - q) ** 2)
    without_penalty = float(loss - hyper.critic_l2 * kernel_l2(state.critic))
    assert without_penalty == pytest.approx(error, rel=1e-10)
    np.testing.assert_allclose(found, q, **CLOSE)


def test_the_penalty_counts_kernels_only():
    """Its gradient is λW on every weight matrix and 0 on biases and layer norms."""
    _, state, _ = setup(CONFIG)
    gradient = jax.grad(kernel_l2)(state.critic)
    leaves = jax.tree_util.tree_leaves_with_path(state.critic)
    slopes = jax.tree.leaves(gradient)
    free = 0
    for (path, weights), slope in zip(leaves, slopes, strict=True):
        name = path[-1].key
        if name.endswith("bias") or name == "scale":
            assert not slope.any()
            free += 1
        else:
            np.testing.assert_array_equal(slope, weights)
    assert free == 3 + 2 * 2  # two hidden biases and the last one; scale and shift of two norms


# ----- gradients head by head


def test_gradient_of_the_last_layer_is_zero_for_heads_that_did_not_act():
    kernel, bias = oracles.last_layer(actor_gradient(CONFIG, make_batch([0, 2])), M)
    for m in (1, 3):
        assert not kernel[:, m].any()
        assert not bias[m].any()
    for m in (0, 2):
        assert kernel[:, m].any()
        assert bias[m].all()


@pytest.mark.parametrize("m", range(M))
def test_the_trunk_gets_the_gradient_of_the_head_that_acted(m):
    """It is that of an actor with this head alone: DDPG's, for the samples of each head."""
    batch = make_batch([m])
    gradient = actor_gradient(CONFIG, batch)
    actor = oracles.with_one_head(setup(CONFIG)[1].actor, M, m)
    own = batch._replace(extra=jnp.zeros(B, jnp.uint8))
    alone = actor_gradient(dataclasses.replace(CONFIG, heads=1), own, actor=actor)
    assert_close(oracles.trunk(gradient), oracles.trunk(alone))
    (kernel, bias), (kernel_alone, bias_alone) = (
        oracles.last_layer(gradient, M),
        oracles.last_layer(alone, 1),
    )
    assert_close((kernel[:, m], bias[m]), (kernel_alone[:, 0], bias_alone[0]))


def test_all_is_the_mean_of_the_gradients_of_every_head():
    batch = make_batch(range(M))
    each = [
        actor_gradient(CONFIG, batch._replace(extra=jnp.full(B, m, jnp.uint8))) for m in range(M)
    ]
    expected = jax.tree.map(lambda *gradients: sum(gradients) / M, *each)
    assert_close(actor_gradient(dataclasses.replace(CONFIG, gradient="all"), batch), expected)


def test_resampled_heads_are_the_full_gradient_on_average():
    """Over 2,000 draws, each coordinate within 6 of its standard errors; fixed keys."""
    batch = make_batch(range(M))
    config = dataclasses.replace(CONFIG, gradient="resampled")
    keys = jax.random.split(jax.random.key(0), 2000)
    draws = jax.jit(jax.vmap(lambda key: actor_gradient(config, batch, key)))(keys)
    full = actor_gradient(dataclasses.replace(CONFIG, gradient="all"), batch)

    def compare(draws, expected):
        error = np.std(draws, axis=0) / np.sqrt(len(keys))
        assert (np.abs(np.mean(draws, axis=0) - expected) <= 6 * error + 1e-12).all()

    jax.tree.map(compare, draws, full)
    assert np.std(draws["params"]["bias"], axis=0).all()  # draws, not the mean itself


@pytest.mark.parametrize("gradient", ["resampled", "all"])
def test_only_the_stored_rule_asks_who_acted(gradient):
    batch = make_batch(range(M))
    others = batch._replace(extra=(batch.extra + 1) % M)
    config = dataclasses.replace(CONFIG, gradient=gradient)
    oracles.assert_equal(actor_gradient(config, batch), actor_gradient(config, others))
    stored, stored_others = actor_gradient(CONFIG, batch), actor_gradient(CONFIG, others)
    kernel, other_kernel = (oracles.last_layer(g, M)[0] for g in (stored, stored_others))
    assert not np.array_equal(kernel, other_kernel)


# ----- the whole update


@pytest.mark.parametrize(("gradient", "target"), RULES)
def test_one_head_is_ddpg(gradient, target):
    """Five updates against a DDPG written from its paper; with M = 1 all rules are one."""
    config = dataclasses.replace(
        CONFIG, heads=1, layer_norm=False, gradient=gradient, target=target
    )
    _, state, hyper = setup(config)
    ours = (slow_ddpg.actor_parameters, slow_ddpg.critic_parameters)
    oracle = slow_ddpg.Ddpg(
        *(read(params) for read, params in zip(ours, (state.actor, state.critic), strict=True)),
        config,
    )
    oracle.actor_target = ours[0](state.actor_target)
    oracle.critic_target = ours[1](state.critic_target)
    update = compiled_update(config)
    for i in range(5):
        batch = make_batch([0], seed=i)
        state, _ = update(state, hyper, batch, jax.random.key(i))
        oracle.update(
            batch.observation, batch.action, batch.reward, batch.terminal, batch.next_observation
        )
    assert_close(ours[0](state.actor), oracle.actor)
    assert_close(ours[1](state.critic), oracle.critic)
    assert_close(ours[0](state.actor_target), oracle.actor_target)
    assert_close(ours[1](state.critic_target), oracle.critic_target)


@pytest.mark.parametrize("rules", [*PLAIN_RULES, *APART])
def test_padding_heads_learns_the_same(rules):
    """M = 4 padded to 9: five updates agree, and heads past M keep their first values."""
    padded = 9
    config = dataclasses.replace(CONFIG, **rules)
    states = []
    for size in (None, padded):
        _, state, hyper = setup(config, size)
        first, update = state, compiled_update(config, size)
        for i in range(5):
            state, metrics = update(state, hyper, make_batch(range(M), seed=i), jax.random.key(i))
        states.append((first, state, metrics))
    (_, plain, plain_metrics), (first, wide, wide_metrics) = states

    for name in ("actor", "actor_target"):
        kernel, bias = oracles.last_layer(getattr(wide, name), padded)
        mine = oracles.last_layer(getattr(plain, name), M)
        assert_close((kernel[:, :M], bias[:M]), mine)
        assert_close(oracles.trunk(getattr(wide, name)), oracles.trunk(getattr(plain, name)))
    assert_close((wide.critic, wide.critic_target), (plain.critic, plain.critic_target))
    assert_close(wide_metrics, plain_metrics)

    kernel, bias = oracles.last_layer(wide.actor, padded)
    first_kernel, first_bias = oracles.last_layer(first.actor, padded)
    np.testing.assert_array_equal(kernel[:, M:], first_kernel[:, M:])
    np.testing.assert_array_equal(bias[M:], first_bias[M:])


@pytest.mark.parametrize("repulsion", ["stein", "inverse"])
def test_a_repulsion_without_weight_is_none(repulsion):
    """To the last bit, as is one whose weight has fallen to 0."""
    batch, key = make_batch(range(M)), jax.random.key(0)
    _, state, hyper = setup(CONFIG)
    state = state.replace(updates=jnp.int32(7))

    def update(config):
        compiled = jax.jit(
            make_agent(config, A).algorithm.update, compiler_options=oracles.AS_IN_TRAINING
        )
        return functools.partial(compiled, state)

    plain, _ = update(CONFIG)(hyper, batch, key)
    repelled = update(dataclasses.replace(CONFIG, repulsion=repulsion))
    for off in ({"repulsion_weight": jnp.float64(0)}, {"repulsion_updates": jnp.int32(7)}):
        after, _ = repelled(hyper.replace(**off), batch, key)
        oracles.assert_equal(after, plain)
    after, _ = repelled(hyper, batch, key)
    assert not np.array_equal(after.actor["params"]["bias"], plain.actor["params"]["bias"])


def test_fresh_targets_are_the_networks_and_then_follow():
    algorithm = make_agent(CONFIG, A).algorithm
    state = jax.jit(algorithm.init, static_argnums=1)(jax.random.key(1), D)
    oracles.assert_equal(state.actor, state.actor_target)
    oracles.assert_equal(state.critic, state.critic_target)

    _, state, hyper = setup(CONFIG)
    update = compiled_update(CONFIG)
    after, _ = update(state, hyper, make_batch(range(M)), jax.random.key(0))
    assert after.updates == state.updates + 1
    for name in ("actor", "critic"):
        before, online = getattr(state, name + "_target"), getattr(after, name)
        blend = jax.tree.map(lambda x, y: 0.9 * x + 0.1 * y, before, online)  # τ = 0.1
        assert_close(getattr(after, name + "_target"), blend)


def test_gradients_are_scaled_down_to_the_norm():
    """Adam's first moment after one update is a tenth of the gradient it was given."""
    batch = make_batch(range(M))
    given = []
    for bound in (None, 0.01):
        config = dataclasses.replace(CONFIG, max_gradient_norm=bound)
        _, state, hyper = setup(config)
        after, metrics = compiled_update(config)(state, hyper, batch, jax.random.key(0))
        moments = optax.tree_utils.tree_get(after.critic_optimizer, "mu")
        given.append(10 * optax.tree.norm(moments))
        assert metrics.critic_gradient_norm > 0.01  # as it was before
    np.testing.assert_allclose(given, [metrics.critic_gradient_norm, 0.01], rtol=1e-7)
