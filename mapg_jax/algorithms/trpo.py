"""TRPO with M Gaussians a state, one drawn a step (Schulman et al. 2015).

M = 1 is TRPO. The trust region bounds the mean over heads of their divergences, which is exact and
bounds that of the mixtures. All functions are pure.
"""

import dataclasses
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from mapg_jax.algorithms import heads as heads_
from mapg_jax.algorithms import shards
from mapg_jax.algorithms.base import Rollout
from mapg_jax.algorithms.descent import Params
from mapg_jax.algorithms.on_policy import Batch, LearnerState, OnPolicy, OnPolicyOptions
from mapg_jax.algorithms.options import option

SHRINKINGS = 10  # of the step after the first try, each
SHRINK = 0.8  # of the one before (Spinning Up)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrpoOptions(OnPolicyOptions):
    """The numbers of TRPO, as Spinning Up has them."""

    trace: float = option(0.97, "λ of the generalised advantages.", at_least=0, at_most=1)
    critic_learning_rate: float = option(1e-3, "Of Adam, for the critic.", above=0)
    critic_steps: int = option(80, "Steps of the critic towards each rollout.", at_least=1)
    trust_region: float = option(
        0.01, "δ, the mean divergence of the heads, in nats, that a step may reach.", above=0
    )
    damping: float = option(0.1, "Added to the diagonal of the Fisher matrix.", at_least=0)
    conjugate_steps: int = option(10, "Steps of conjugate gradients.", at_least=1)


class Hyperparameters(struct.PyTreeNode):
    """Numbers an update reads; traced, so that the runs of one compiled program may differ."""

    heads: jax.Array  # [] i32, M
    discount: jax.Array  # [], γ
    trace: jax.Array  # [], λ
    critic_learning_rate: jax.Array  # []
    trust_region: jax.Array  # [], δ
    damping: jax.Array  # []


class UpdateMetrics(NamedTuple):
    """Diagnostics of one update; the next one never reads them."""

    critic_loss: jax.Array  # [], at the last step of the critic
    gain: jax.Array  # [], of the surrogate, in deviations of the advantage
    value_mean: jax.Array  # []
    step: jax.Array  # [], the share of the full step that was taken; 0 if none was good
    kl: jax.Array  # [], mean over heads and states, exact
    mixture_kl: jax.Array  # [], of the mixtures, by samples; at most `kl` on average
    actor_gradient_norm: jax.Array  # []


class Step(NamedTuple):
    """A try of the line search."""

    share: jax.Array  # [] of the full step
    actor: Params
    gain: jax.Array  # []
    kl: jax.Array  # []


@dataclasses.dataclass(frozen=True)
class Trpo(OnPolicy):
    """TRPO with M heads, of which those that acted are moved."""

    Options: ClassVar = TrpoOptions
    Hyper: ClassVar = Hyperparameters
    Metrics: ClassVar = UpdateMetrics
    presets: ClassVar = {
        "reference": {"rollout_steps": 4000, "hidden": (64, 32), "normalize": True},
        "parallel": {"rollout_steps": 16},
        "smoke": {"rollout_steps": 32, "critic_steps": 10},
    }

    @staticmethod
    def label(heads: int) -> str:
        """M = 1 is TRPO."""
        return "TRPO" if heads == 1 else f"TRPO, M = {heads}"

    @staticmethod
    def slug(heads: int) -> str:
        """Its name in files."""
        return "trpo"

    def surrogate(self, actor: Params, batch: Batch, hyper: Hyperparameters) -> Float[Array, ""]:
        r"""$\frac{1}{B} \sum_b \pi(a_b|s_b) / \pi_{\mathrm{old}}(a_b|s_b) A_b$ (TRPO, Eq. 14).

        Of the head that acted or of the mixture; A has mean 0 and deviation 1.
        """
        advantage = (batch.advantage - batch.advantage.mean()) / (batch.advantage.std() + 1e-8)
        density = self.log_density(actor, hyper, batch.observation, batch.choice)
        return (jnp.exp(density - batch.log_density) * advantage).mean()

    def kl(
        self, before: Params, after: Params, hyper: Hyperparameters, batch: Batch
    ) -> Float[Array, ""]:
        r"""$\frac{1}{BM} \sum_{b,m} \mathrm{KL}(\pi_m(\cdot|s_b) \,\|\, \pi'_m(\cdot|s_b))$, exact.

        By convexity it is at least the divergence of the mixtures.
        """
        old_mean, old_log_std = self.gaussians(before, batch.observation)
        mean, log_std = self.gaussians(after, batch.observation)
        variance = jnp.exp(2 * old_log_std) + jnp.square(old_mean - mean)
        each = log_std - old_log_std + 0.5 * variance * jnp.exp(-2 * log_std) - 0.5
        return heads_.mean(each.sum(-1), hyper.heads).mean()

    def direction(
        self, actor: Params, gradient: Params, hyper: Hyperparameters, batch: Batch
    ) -> Params:
        r"""The step $\sqrt{2\delta / x^\top F x}\, x$ with $F x = g$ (TRPO, Appendix C).

        F, the Hessian of the divergence at 0 with the damping on its diagonal, acts through a
        derivative of its gradient; x is found by conjugate gradients.
        """

        def fisher(x: Params) -> Params:
            slope = jax.grad(lambda after: self.kl(actor, after, hyper, batch))
            product = shards.mean(jax.jvp(slope, (actor,), (x,))[1])
            return jax.tree.map(lambda y, z: y + hyper.damping * z, product, x)

        steps = self.options.conjugate_steps
        x, _ = jax.scipy.sparse.linalg.cg(fisher, gradient, tol=0.0, maxiter=steps)
        length = jnp.sqrt(2 * hyper.trust_region / (optax.tree.vdot(x, fisher(x)) + 1e-8))
        return jax.tree.map(lambda y: length * y, x)

    def search(
        self, actor: Params, direction: Params, hyper: Hyperparameters, batch: Batch
    ) -> Step:
        """The first of some shrinking steps that gains and stays within the trust region."""
        start = self.surrogate(actor, batch, hyper)

        def attempt(share: Float[Array, ""]) -> Step:
            moved = jax.tree.map(lambda x, dx: x + share * dx, actor, direction)
            gain = self.surrogate(moved, batch, hyper) - start
            kl = self.kl(actor, moved, hyper, batch)
            return Step(share, moved, *shards.mean((gain, kl)))

        def bad(step: Step):
            return ~((step.gain > 0) & (step.kl <= hyper.trust_region))

        def again(step: Step):
            return bad(step) & (step.share > SHRINK ** (SHRINKINGS - 0.5))

        last = jax.lax.while_loop(
            again, lambda step: attempt(SHRINK * step.share), attempt(jnp.ones(()))
        )
        zero = jnp.zeros(())
        none = Step(zero, actor, zero, zero)
        return jax.tree.map(lambda x, y: jnp.where(bad(last), x, y), none, last)

    def update(
        self, learner: LearnerState, hyper: Hyperparameters, batch: Rollout, key: PRNGKeyArray
    ) -> tuple[LearnerState, UpdateMetrics]:
        """One step of the actor, then some of the critic (TRPO, Algorithm 1, in practice).

        Args:
          learner: its state.
          hyper: its numbers.
          batch: collected by this actor, observations normalised.
          key: nothing is drawn.
        """
        before = learner.actor
        learner, steps = self.prepare(learner, hyper, batch)
        gradient = shards.mean(jax.grad(self.surrogate)(before, steps, hyper))
        step = self.search(before, self.direction(before, gradient, hyper, steps), hyper, steps)

        def fit(learner: LearnerState, _):
            learner, critic = self.fit_critic(learner, hyper, steps)
            return learner, critic.loss

        learner, losses = jax.lax.scan(fit, learner, None, self.options.critic_steps)
        metrics = UpdateMetrics(
            critic_loss=losses[-1],
            gain=step.gain,
            value_mean=steps.returns.mean(),
            step=step.share,
            kl=step.kl,
            mixture_kl=self.mixture_kl(before, step.actor, hyper, steps),
            actor_gradient_norm=optax.tree.norm(gradient),
        )
        return learner.replace(actor=step.actor, updates=learner.updates + 1), metrics
