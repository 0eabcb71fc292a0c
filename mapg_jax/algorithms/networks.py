"""Actors with M heads, deterministic and Gaussian; A3C's actor; critics of actions and states.

Two hidden layers with ReLU each (MAPG, section 4.1); layer norm before each ReLU, as in the code
the paper ran on, can be turned off. Last layers start at U(±3e-3) (Lillicrap et al. 2016).
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Integer

from mapg_jax.algorithms.heads import take
from mapg_jax.algorithms.layer_norm import LayerNorm

LAST_LAYER_SCALE = 3e-3
VARIANCE_FLOOR = 1e-4  # of A3C's Gaussian: σ of 0.01 in units of [-1, 1], so that 1 / σ² is bounded
LOG_STD = (-5.0, 2.0)  # bounds of SAC's log σ, before the tanh
_hidden_init = nn.initializers.glorot_uniform()  # as in the code the paper ran on


def _uniform(scale):
    def init(key, shape, dtype=jnp.float32):
        return jax.random.uniform(key, shape, dtype, -scale, scale)

    return init


_last_layer_uniform = _uniform(LAST_LAYER_SCALE)


def _joint_init(fan_in):
    """Glorot's uniform for a part of the rows of a kernel with `fan_in` rows in all."""

    def init(key, shape, dtype=jnp.float32):
        limit = (6 / (fan_in + shape[-1])) ** 0.5
        return jax.random.uniform(key, shape, dtype, -limit, limit)

    return init


def _per_head_uniform(heads, scale, first=None):
    """U(±scale) head by head, so that head m starts the same whatever the number of heads.

    Head 0 may start within ± `first` instead.
    """

    def init(key, shape, dtype=jnp.float32):
        rows, columns = shape

        def one_head(m):
            head_key = jax.random.fold_in(key, m)
            bound = scale if first is None else jnp.where(m == 0, first, scale)
            return _uniform(bound)(head_key, (rows, columns // heads), dtype)

        return jnp.moveaxis(jax.vmap(one_head)(jnp.arange(heads)), 0, 1).reshape(shape)

    return init


class _Rectifier(nn.Module):
    """Layer norm (or none), then ReLU."""

    layer_norm: bool

    @nn.compact
    def __call__(self, x):
        return LayerNorm()(x) if self.layer_norm else nn.relu(x)


def _trunk(x, hidden, layer_norm):
    for width in hidden:
        x = nn.Dense(width, kernel_init=_hidden_init)(x)
        x = _Rectifier(layer_norm)(x)
    return x


def _last_layer(width):
    return nn.Dense(width, kernel_init=_last_layer_uniform, bias_init=_last_layer_uniform)


def _of_heads(module, name, x, size, bias_init=None):
    """A last layer for all heads, one matrix product: [*B, W] x [W, M * size] as [*B, M, size]."""
    columns = module.heads * size
    kernel_init = _per_head_uniform(module.heads, LAST_LAYER_SCALE)
    kernel = module.param(f"{name}kernel", kernel_init, (x.shape[-1], columns))
    bias = module.param(f"{name}bias", bias_init or kernel_init, (1, columns))
    return _plus(x @ kernel, bias[0]).reshape(*x.shape[:-1], module.heads, size)


def _plus(x, bias):
    return x + jnp.expand_dims(bias, range(x.ndim - 1))


class Actor(nn.Module):
    r"""$\rho_1(s) \ldots \rho_M(s)$, each in [-1, 1]^A."""

    heads: int
    action_size: int
    hidden: tuple[int, ...]
    layer_norm: bool
    spread: float = LAST_LAYER_SCALE
    """Of the heads' first biases."""

    @nn.compact
    def __call__(
        self, observation: Float[Array, "*B D"], head: Integer[Array, "*B"] | None = None
    ) -> Float[Array, "*B {self.heads} {self.action_size}"] | Float[Array, "*B {self.action_size}"]:
        """All M proposals, or that of one head a state; its gradient reaches that head alone."""
        x = _trunk(observation, self.hidden, self.layer_norm)
        x = _of_heads(self, "", x, self.action_size, _per_head_uniform(self.heads, self.spread))
        return jnp.tanh(x if head is None else take(x, head))


class Critic(nn.Module):
    """Q(s, a) of K actions a state."""

    hidden: tuple[int, ...]
    layer_norm: bool
    action_layer: int
    """The hidden layer that the action joins, counted from 1."""

    @nn.compact
    def __call__(
        self,
        observation: Float[Array, "*B D"],
        actions: Float[Array, "*B K A"],
    ) -> Float[Array, "*B K"]:
        before = self.hidden[: self.action_layer - 1]
        width, *rest = self.hidden[self.action_layer - 1 :]
        x = _trunk(observation, before, self.layer_norm)
        x = self._join(x, actions, width)
        x = _trunk(_Rectifier(self.layer_norm)(x), rest, self.layer_norm)
        kernel = self.param("kernel", _last_layer_uniform, (x.shape[-1],))
        return x @ kernel + self.param("bias", _last_layer_uniform, ())

    def _join(self, features, actions, width):
        """A dense layer on [features, action]; the features' part is computed once a state."""
        sizes = features.shape[-1], actions.shape[-1]
        init = _joint_init(sum(sizes))
        features_kernel = self.param("features_kernel", init, (sizes[0], width))
        action_kernel = self.param("action_kernel", init, (sizes[1], width))
        bias = self.param("joint_bias", nn.initializers.zeros, (width,))
        x = _plus(features @ features_kernel, bias)
        return x[..., None, :] + actions @ action_kernel


class GaussianActor(nn.Module):
    r"""$\mu(s)$ in [-1, 1]^A and one variance $\sigma^2(s)$ for all dimensions of the action.

    $\mu$ by tanh, $\sigma^2$ by softplus (Mnih et al. 2016, section 9), which starts at 0.69.
    """

    action_size: int
    hidden: tuple[int, ...]
    layer_norm: bool

    @nn.compact
    def __call__(
        self, observation: Float[Array, "*B D"]
    ) -> tuple[Float[Array, "*B {self.action_size}"], Float[Array, "*B"]]:
        x = _trunk(observation, self.hidden, self.layer_norm)
        mean = jnp.tanh(_last_layer(self.action_size)(x))
        return mean, nn.softplus(_last_layer(1)(x))[..., 0] + VARIANCE_FLOOR


class GaussianHeads(nn.Module):
    r"""M diagonal Gaussians: means, and $\log \sigma$ of each dimension, before any squashing.

    $\log \sigma$ lies within `LOG_STD` by a tanh, as in CleanRL's SAC; or it is `free`, one number
    a head and dimension whatever the state, which starts at 0 (Schulman et al. 2015).
    """

    heads: int
    action_size: int
    hidden: tuple[int, ...]
    layer_norm: bool
    spread: float = LAST_LAYER_SCALE
    """Of the first biases of the means."""
    free: bool = False

    @nn.compact
    def __call__(
        self, observation: Float[Array, "*B D"]
    ) -> tuple[
        Float[Array, "*B {self.heads} {self.action_size}"],
        Float[Array, "*B {self.heads} {self.action_size}"],
    ]:
        x = _trunk(observation, self.hidden, self.layer_norm)
        mean = _of_heads(
            self, "mean_", x, self.action_size, _per_head_uniform(self.heads, self.spread)
        )
        if self.free:
            zeros = nn.initializers.zeros
            log_std = self.param("log_std", zeros, (self.heads, self.action_size))
            log_std = jnp.expand_dims(log_std, range(mean.ndim - 2))
            return mean, jnp.broadcast_to(log_std, mean.shape)
        low, high = LOG_STD
        share = 0.5 * (1 + jnp.tanh(_of_heads(self, "log_std_", x, self.action_size)))
        return mean, low + (high - low) * share


class Peaks(nn.Module):
    """M quadratic peaks of Q: V, the peaks in [-1, 1]^A, L of each, and heights β.

    All start equally high; L is lower triangular with an exponential diagonal, as in NAF.
    """

    heads: int
    action_size: int
    hidden: tuple[int, ...]
    layer_norm: bool
    spread: float
    """Of the first biases of all peaks but one."""

    @nn.compact
    def __call__(
        self, observation: Float[Array, "*B D"]
    ) -> tuple[
        Float[Array, "*B"],
        Float[Array, "*B {self.heads} {self.action_size}"],
        Float[Array, "*B {self.heads} {self.action_size} {self.action_size}"],
        Float[Array, "*B {self.heads}"],
    ]:
        x = _trunk(observation, self.hidden, self.layer_norm)
        value = _last_layer(1)(x)[..., 0]
        bias_init = _per_head_uniform(self.heads, self.spread, first=LAST_LAYER_SCALE)
        peaks = jnp.tanh(_of_heads(self, "peaks_", x, self.action_size, bias_init))
        square = _of_heads(self, "cholesky_", x, self.action_size**2)
        square = square.reshape(*peaks.shape, self.action_size)
        diagonal = jnp.eye(self.action_size, dtype=bool)
        # Of the diagonal alone: beside it an exponential may overflow, and 0 times infinity is NaN.
        positive = jnp.exp(jnp.where(diagonal, square, 0.0))
        cholesky = jnp.where(diagonal, positive, jnp.tril(square, -1))
        zeros = nn.initializers.zeros
        height = nn.Dense(self.heads, name="height", kernel_init=zeros, bias_init=zeros)(x)
        return value, peaks, cholesky, height


class StateCritic(nn.Module):
    """V(s)."""

    hidden: tuple[int, ...]
    layer_norm: bool

    @nn.compact
    def __call__(self, observation: Float[Array, "*B D"]) -> Float[Array, "*B"]:
        return _last_layer(1)(_trunk(observation, self.hidden, self.layer_norm))[..., 0]
