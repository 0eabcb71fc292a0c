"""A3C's loop: n steps of every environment, then one update on them, and they are forgotten."""

import fractions
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Int, PRNGKeyArray

import envs
from mapg_jax.algorithms.a3c import Rollout, UpdateMetrics
from mapg_jax.training.agent import A3cAgent, AgentState, hyperparameters
from mapg_jax.training.loop import Loop, Totals, count_step, no_totals, run_keys


class A3cTrainState(struct.PyTreeNode):
    """All that changes while learning: what is jitted, donated, saved and resumed."""

    agent: AgentState
    env: envs.State  # leaves [N, ...]
    running_return: jax.Array  # [N], of the episodes under way
    key: jax.Array  # []
    env_steps: jax.Array  # [] i32, all environments together
    diverged_at: jax.Array  # [] i32, env_steps at the first loss that was not finite, or -1
    totals: Totals


class A3cTrainer(Loop):
    """A3C's loop; all N environments act by the parameters that the last update made."""

    agent: A3cAgent

    @property
    def steps_per_turn(self) -> int:
        return self.config.a3c_rollout_steps * self.config.environments

    @property
    def updates_ratio(self) -> fractions.Fraction:
        return fractions.Fraction(1, self.steps_per_turn)

    def init(self, seed: int | Int[Array, ""]) -> A3cTrainState:
        """The state before the first step."""
        n = self.config.environments
        keys = run_keys(seed)
        agent = self.agent.init(keys.agent, hyperparameters(self.config), self.env.observation_size)
        env = jax.vmap(self.env.reset)(jax.random.split(keys.env, n))
        return A3cTrainState(
            agent=self.agent.see(agent, jnp.asarray(env.obs)),
            env=env,
            running_return=jnp.zeros(n),
            key=keys.loop,
            env_steps=jnp.zeros((), jnp.int32),
            diverged_at=jnp.full((), -1, jnp.int32),
            totals=no_totals(UpdateMetrics),
        )

    def turn(self, state: A3cTrainState) -> A3cTrainState:
        """n steps of every environment, then one update."""
        key, collect_key = jax.random.split(state.key)
        state, rollout = self.collect(state.replace(key=key), collect_key)
        return self.learn(state, rollout)

    def collect(self, state: A3cTrainState, key: PRNGKeyArray) -> tuple[A3cTrainState, Rollout]:
        """n steps of every environment, acting by samples clipped to [-1, 1]."""

        def step(state: Any, key: Any):
            observation = jnp.asarray(state.env.obs)
            action = self.agent.sample(state.agent, observation, key)
            env = jax.vmap(self.env.step)(state.env, jnp.clip(action, -1.0, 1.0))
            ended = env.done > 0.5
            terminal = ended if self.config.truncation == "terminal" else env.info["terminated"]
            row = Rollout(
                observation=observation,
                action=action,
                reward=env.reward,
                terminal=terminal,
                ended=ended,
                next_observation=env.info["final_observation"],
            )
            return count_step(state, env), row

        return jax.lax.scan(step, state, jax.random.split(key, self.config.a3c_rollout_steps))

    def learn(self, state: A3cTrainState, rollout: Rollout) -> A3cTrainState:
        """One update; the statistics of observations move after it, so that it is on-policy."""
        prepared = self.agent.prepare(state.agent, rollout)
        agent, metrics = self.agent.learn(state.agent, prepared)
        upcoming = jnp.concatenate([rollout.observation[1:], jnp.asarray(state.env.obs)[None]])
        agent = self.agent.see(agent, upcoming.reshape(-1, upcoming.shape[-1]))
        finite = jnp.isfinite(metrics.critic_loss + metrics.actor_loss)
        first = ~finite & (state.diverged_at < 0)
        return state.replace(
            agent=agent,
            diverged_at=jnp.where(first, state.env_steps, state.diverged_at),
            totals=state.totals._replace(
                updates=state.totals.updates + 1,
                update_metrics=jax.tree.map(jnp.add, state.totals.update_metrics, metrics),
            ),
        )
