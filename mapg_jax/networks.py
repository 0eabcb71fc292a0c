"""The actor with M heads, and the critic.

Two hidden layers with ReLU each (MAPG, section 4.1); layer norm before each ReLU, as in the code
the paper ran on, can be turned off. Last layers start at U(±3e-3) (Lillicrap et al. 2016).
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

LAST_LAYER_SCALE = 3e-3
_hidden_init = nn.initializers.glorot_uniform()  # as in the code the paper ran on


def _last_layer_uniform(key, shape, dtype=jnp.float32):
    return jax.random.uniform(key, shape, dtype, -LAST_LAYER_SCALE, LAST_LAYER_SCALE)


def _per_head_uniform(key, shape, dtype=jnp.float32):
    """U(±3e-3), head by head, so that head m starts the same whatever the number of heads.

    The axis of heads is the second to last one.
    """

    def one_head(m):
        return _last_layer_uniform(jax.random.fold_in(key, m), (*shape[:-2], shape[-1]), dtype)

    return jnp.moveaxis(jax.vmap(one_head)(jnp.arange(shape[-2])), 0, -2)


class _Rectifier(nn.Module):
    """Layer norm (or none), then ReLU."""

    layer_norm: bool

    @nn.compact
    def __call__(self, x):
        return nn.relu(nn.LayerNorm()(x) if self.layer_norm else x)


class Actor(nn.Module):
    r"""$\rho_1(s) \ldots \rho_M(s)$, each in [-1, 1]^A."""

    heads: int
    action_size: int
    hidden: tuple[int, ...]
    layer_norm: bool

    @nn.compact
    def __call__(self, observation: Float[Array, "*B D"]) -> Float[Array, "*B {self.heads} A"]:
        x = observation
        for width in self.hidden:
            x = nn.Dense(width, kernel_init=_hidden_init)(x)
            x = _Rectifier(self.layer_norm)(x)
        shape = (self.heads, self.action_size)
        kernel = self.param("kernel", _per_head_uniform, (x.shape[-1], *shape))
        bias = self.param("bias", _per_head_uniform, shape)
        # One matrix product for all heads: [B, W] x [W, M * A].
        flat = x @ kernel.reshape(x.shape[-1], -1)
        return jnp.tanh(flat.reshape(*x.shape[:-1], *shape) + bias)


class Critic(nn.Module):
    """Q(s, a) of K actions a state; the action joins at the second hidden layer."""

    hidden: tuple[int, ...]
    layer_norm: bool

    @nn.compact
    def __call__(
        self, observation: Float[Array, "*B D"], actions: Float[Array, "*B K A"]
    ) -> Float[Array, "*B K"]:
        first, *rest = self.hidden
        x = nn.Dense(first, kernel_init=_hidden_init)(observation)
        x = _Rectifier(self.layer_norm)(x)
        for i, width in enumerate(rest):
            if i == 0:
                x = self._join(x, actions, width)
            else:
                x = nn.Dense(width, kernel_init=_hidden_init)(x)
            x = _Rectifier(self.layer_norm)(x)
        kernel = self.param("kernel", _last_layer_uniform, (x.shape[-1],))
        return x @ kernel + self.param("bias", _last_layer_uniform, ())

    def _join(self, features, actions, width):
        """A dense layer on [features, action]; the features' part is computed once a state."""
        size = features.shape[-1]
        shape = (size + actions.shape[-1], width)
        kernel = self.param("joint_kernel", _hidden_init, shape)
        bias = self.param("joint_bias", nn.initializers.zeros, (width,))
        return (features @ kernel[:size])[..., None, :] + (actions @ kernel[size:] + bias)
