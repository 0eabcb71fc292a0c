"""MAPG's loop: collect, store, update."""

import fractions
import math

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Int, PRNGKeyArray

import envs
from mapg_jax.algorithms import exploration, heads
from mapg_jax.algorithms.mapg import Transition, UpdateMetrics
from mapg_jax.training.a3c_training import A3cTrainer
from mapg_jax.training.agent import Agent, AgentState, MapgAgent, hyperparameters, make_agent
from mapg_jax.training.config import Config
from mapg_jax.training.loop import Loop, Totals, count_step, no_totals, run_keys
from mapg_jax.training.replay import ReplayState
from mapg_jax.training import replay


class TrainState(struct.PyTreeNode):
    """All that changes while learning: what is jitted, donated, saved and resumed."""

    agent: AgentState
    replay: ReplayState
    env: envs.State  # leaves [N, ...]
    running_return: jax.Array  # [N], of the episodes under way
    noise: jax.Array  # [N, A]
    key: jax.Array  # []
    env_steps: jax.Array  # [] i32, all environments together
    update_credit: jax.Array  # [] i32, updates owed, in units of 1/q (see Trainer)
    diverged_at: jax.Array  # [] i32, env_steps at the first loss that was not finite, or -1
    totals: Totals


class Trainer(Loop):
    """MAPG's loop.

    p / q is the number of updates per environment step; a turn of N environment steps earns N·p
    credits, and each update costs q, so that any ratio is met exactly.
    """

    agent: MapgAgent

    @property
    def steps_per_turn(self) -> int:
        return self.config.environments

    @property
    def updates_ratio(self) -> fractions.Fraction:
        return fractions.Fraction(self.config.updates_per_step).limit_denominator(100_000)

    @property
    def updates_per_turn(self) -> int:
        """The most updates a turn can make."""
        return math.ceil(self.config.environments * self.updates_ratio)

    def init(self, seed: int | Int[Array, ""]) -> TrainState:
        """The state before the first step."""
        config = self.config
        n = config.environments
        keys = run_keys(seed)
        agent = self.agent.init(keys.agent, hyperparameters(config), self.env.observation_size)
        env = jax.vmap(self.env.reset)(jax.random.split(keys.env, n))
        return TrainState(
            agent=agent,
            replay=replay.init(self._transition(), config.replay_size),
            env=env,
            running_return=jnp.zeros(n),
            noise=jnp.zeros((n, self.env.action_size)),
            key=keys.loop,
            env_steps=jnp.zeros((), jnp.int32),
            update_credit=jnp.zeros((), jnp.int32),
            diverged_at=jnp.full((), -1, jnp.int32),
            totals=no_totals(UpdateMetrics),
        )

    def turn(self, state: TrainState) -> TrainState:
        """N environment steps, then the updates they have earned."""
        key, collect_key, sample_key, update_key = jax.random.split(state.key, 4)
        state = self.collect(state.replace(key=key), collect_key)
        return self.learn(state, sample_key, update_key)

    def collect(self, state: TrainState, key: PRNGKeyArray) -> TrainState:
        """One step of every environment, stored."""
        head_key, noise_key = jax.random.split(key)
        observation = jnp.asarray(state.env.obs)
        agent = self.agent.see(state.agent, observation)
        head = heads.draw(head_key, agent.hyper.heads, observation.shape[:1])
        scale = exploration.scales(
            agent.hyper.noise_scale, agent.hyper.noise_scale_last, self.config.environments
        )
        noise = exploration.advance(self.config.noise, noise_key, state.noise, scale)
        action = jnp.clip(self.agent.proposal(agent, observation, head) + noise, -1.0, 1.0)

        env = jax.vmap(self.env.step)(state.env, action)
        ended = env.done > 0.5
        terminal = ended if self.config.truncation == "terminal" else env.info["terminated"]
        transition = Transition(
            observation=observation,
            head=head,
            action=action,
            reward=env.reward,
            terminal=terminal,
            next_observation=env.info["final_observation"],
        )
        state = count_step(state, env)
        return state.replace(
            agent=agent,
            replay=replay.add(state.replay, transition),
            noise=exploration.restart(noise, ended),
        )

    def learn(
        self, state: TrainState, sample_key: PRNGKeyArray, update_key: PRNGKeyArray
    ) -> TrainState:
        """The updates that the steps so far have earned; their batches are drawn at once."""
        earned, cost = self.updates_ratio.as_integer_ratio()
        learning = state.env_steps >= self.config.learning_starts
        credit = state.update_credit + learning * self.config.environments * earned
        updates = credit // cost

        size = self.config.batch_size
        batches = replay.sample(state.replay, sample_key, self.updates_per_turn * size)
        batches = self.agent.prepare(state.agent, batches)
        batches = jax.tree.map(lambda x: x.reshape(-1, size, *x.shape[1:]), batches)

        def update(i, carry):
            agent, totals, diverged = carry
            batch = jax.tree.map(lambda x: x[i], batches)
            agent, metrics = self.agent.learn(agent, batch, jax.random.fold_in(update_key, i))
            finite = jnp.isfinite(metrics.critic_loss + metrics.actor_loss)
            return agent, jax.tree.map(jnp.add, totals, metrics), diverged | ~finite

        agent, totals, diverged = jax.lax.fori_loop(
            0, updates, update, (state.agent, state.totals.update_metrics, jnp.zeros((), bool))
        )
        first = diverged & (state.diverged_at < 0)
        return state.replace(
            agent=agent,
            update_credit=credit - updates * cost,
            diverged_at=jnp.where(first, state.env_steps, state.diverged_at),
            totals=state.totals._replace(
                updates=state.totals.updates + updates, update_metrics=totals
            ),
        )

    def _transition(self) -> Transition:
        observation = jnp.zeros(self.env.observation_size)
        return Transition(
            observation=observation,
            head=jnp.zeros((), jnp.uint8 if self.config.heads <= 256 else jnp.int32),
            action=jnp.zeros(self.env.action_size),
            reward=jnp.zeros(()),
            terminal=jnp.zeros((), bool),
            next_observation=observation,
        )


def make_trainer(config: Config, padded_heads: int | None = None) -> Loop:
    """The environment, the agent and the loop of a run."""
    env = envs.with_episodes(config.make_env(), config.episode_steps())
    trainer = A3cTrainer if config.algorithm == "a3c" else Trainer
    return trainer(config, env, make_agent(config, env.action_size, padded_heads))


def agent_shapes(config: Config, agent: Agent, observation_size: int) -> AgentState:
    """Shapes of an agent's state, for reading it from a checkpoint."""

    def init():
        return agent.init(jax.random.key(0), hyperparameters(config), observation_size)

    return jax.eval_shape(init)
