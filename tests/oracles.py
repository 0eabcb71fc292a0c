"""Slow, obvious versions of what is tested, and tiny environments whose values are known."""

import csv
import dataclasses
import itertools
import math
import pathlib
import shutil

import jax
import jax.numpy as jnp
import jaxlib.version
import numpy as np

from envs.base import Env, State, with_episodes
from mapg_jax.algorithms.base import Transition
from mapg_jax.algorithms.deterministic import UpdateMetrics
from mapg_jax.reports.results import Result
from mapg_jax.runs.checkpoints import Checkpoints
from mapg_jax.runs.folder import RunFolder
from mapg_jax.runs.sealing import write_score
from mapg_jax.runs.train import begin
from mapg_jax.training import replay, trainer
from mapg_jax.training.agent import Agent, make_agent
from mapg_jax.training.config import Config
from mapg_jax.training.state import TrainState

# ----- tiny environments


class Tiny(Env):
    """One action in [-1, 1]; a subclass says what happens."""

    dt = 1.0  # s
    action_high = np.ones(1, np.float32)
    size = 1

    @property
    def observation_size(self) -> int:
        return self.size

    @property
    def action_size(self) -> int:
        return 1

    @property
    def backend(self) -> str:
        return "jax"

    def reset(self, rng: jax.Array) -> State:
        return self.state(jnp.zeros(self.size), 0.0, 0.0)

    def state(self, observation, reward, done) -> State:
        """A state that is all in its observation."""
        return State(None, observation, jnp.float32(reward), jnp.float32(done), {}, {})


class OneStep(Tiny):
    """Reward 1, then the end: Q = 1."""

    def step(self, state: State, action: jax.Array) -> State:
        return self.state(state.obs, 1.0, 1.0)


class TwoSteps(Tiny):
    """Observes 0, then 1; reward 0, then 1, then the end: Q = γ, then 1."""

    def step(self, state: State, action: jax.Array) -> State:
        return self.state(jnp.ones(1), state.obs[0], state.obs[0])


class Endless(Tiny):
    """Reward 1 for ever, in a single state: Q = 1 / (1 - γ)."""

    def step(self, state: State, action: jax.Array) -> State:
        return self.state(state.obs, 1.0, 0.0)


class Side(Tiny):
    """Observes s = ±1; reward s · a, then the end: Q(s, a) = s · a, and a = s is best."""

    def reset(self, rng: jax.Array) -> State:
        side = jnp.where(jax.random.bernoulli(rng), 1.0, -1.0)
        return self.state(side[None], 0.0, 0.0)

    def step(self, state: State, action: jax.Array) -> State:
        return self.state(state.obs, state.obs[0] * action[0], 1.0)


class RandomLength(Tiny):
    """Observes the steps left, 1 to 9, and a constant of the start; reward is their product + a.

    Long episodes are worth more, so that an average over the first to finish would be too low.
    """

    size = 2

    def reset(self, rng: jax.Array) -> State:
        left_key, worth_key = jax.random.split(rng)
        left = jax.random.randint(left_key, (), 1, 10).astype(jnp.float32)
        state = self.state(jnp.stack([left, jax.random.uniform(worth_key)]), 0.0, 0.0)
        return state.replace(metrics={"left": left})

    def step(self, state: State, action: jax.Array) -> State:
        left, worth = state.obs
        after = self.state(jnp.stack([left - 1, worth]), left * worth + action[0], left == 1)
        return after.replace(metrics={**state.metrics, "left": left - 1}, info=state.info)


TINY = Config(
    heads=3,
    environments=4,
    replay_size=200,
    batch_size=8,
    hidden=(8, 8),
    learning_starts=16,
)
"""A run that compiles and goes fast; its environment is given to `make_trainer`."""

RUN = dataclasses.replace(
    TINY, steps=800, time_limit=50, evaluate_every=200, evaluation_episodes=2, final_episodes=3,
    checkpoint_seconds=1e-9, checkpoints_kept=100,
)  # fmt: skip
"""A whole run on Pendulum with a checkpoint after every chunk, the first one at step 64."""


class CountingAgent(Agent):
    """Counts its updates; as metrics it gives numbers of its key and of its batch, and squares."""

    def learn(self, state, batch, key):
        learner = state.learner.replace(updates=state.learner.updates + 1)
        drawn, seen = jax.random.uniform(key), batch.observation.mean()
        metrics = UpdateMetrics(drawn, drawn**2, seen, seen**2, jnp.zeros(()))
        return state.replace(learner=learner), metrics


AS_IN_TRAINING = {"xla_backend_optimization_level": 3} | (
    {"xla_cpu_use_fusion_emitters": True} if jaxlib.version.__version_info__ < (0, 11) else {}
)
"""Compiler options of what must not differ in its last bits; conftest.py has quicker ones."""


def make_trainer(env: Env, time_limit: int, config: Config, padded_heads: int | None = None):
    """A trainer on an environment without a name."""
    agent = make_agent(config, env.action_size, padded_heads)
    return trainer.Trainer(config, with_episodes(env, time_limit), agent)


def untrained_run(config: Config, path: pathlib.Path) -> RunFolder:
    """A run folder with a checkpoint of the initial agent; nothing but `init` is compiled."""
    run = begin(config, path)
    state = run.trainer.jitted_init(config.seed)
    if state.replay is not None:
        one = jnp.int32(1)
        full = state.replay.replace(position=one, size=one, rows=one)
        state = state.replace(replay=full)
    run.members[0].begin_to_save(state, 0.0)
    run.members[0].checkpoints.wait()
    return run.folder


def assert_equal(got, expected) -> None:
    """Every leaf, to the last bit; random keys by their data, NaN equal to NaN."""

    def bits(x):
        return jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x

    got, expected = jax.tree.map(bits, got), jax.tree.map(bits, expected)
    jax.tree.map(np.testing.assert_array_equal, got, expected)


def stored(state: TrainState) -> Transition:
    """The transitions in the replay, the oldest first."""
    ring = state.replay
    slots = (ring.position - ring.size + jnp.arange(int(ring.size))) % replay.capacity(ring)
    return jax.tree.map(np.asarray, replay.read(ring, slots))


# ----- runs that were trained


CLOCK = ("seconds", "per_second")
"""How the names of columns end that depend on the clock."""


def copy_run(run: RunFolder, path: pathlib.Path, upto: int | None = None) -> RunFolder:
    """A copy, without the checkpoints after a step."""
    shutil.copytree(run.path, path)
    folder = RunFolder.open(path)
    for checkpoint in folder.checkpoints.iterdir():
        if upto is not None and int(checkpoint.name) > upto:
            shutil.rmtree(checkpoint)
    return folder


def newest_state(folder: RunFolder) -> TrainState:
    """The state of its newest checkpoint."""
    shapes = trainer.make_trainer(folder.config).shapes
    checkpoints = Checkpoints(folder.checkpoints, config=folder.digest)
    return jax.device_put(checkpoints.load(shapes)[0])


def metrics_without_clock(folder: RunFolder) -> list[dict[str, str]]:
    """The text of every column that does not depend on the clock."""
    with folder.metrics.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if not k.endswith(CLOCK)} for row in rows]


def assert_same_run(folder: RunFolder, expected: RunFolder) -> None:
    """The same newest state to the last bit, and the same metrics."""
    assert_equal(newest_state(folder), newest_state(expected))
    assert metrics_without_clock(folder) == metrics_without_clock(expected)


# ----- networks, as lists of arrays


def last_layer(actor, heads: int):
    """The actor's last kernel [W, M, A] and bias [M, A]."""
    kernel, bias = actor["params"]["kernel"], actor["params"]["bias"]
    return kernel.reshape(len(kernel), heads, -1), bias.reshape(heads, -1)


def trunk(actor):
    """The actor without its last layer."""
    return {k: v for k, v in actor["params"].items() if k not in ("kernel", "bias")}


def with_one_head(actor, heads: int, m: int):
    """The actor that has head m alone."""
    kernel, bias = last_layer(actor, heads)
    shape = actor["params"]["bias"].shape[:-2]
    return {
        "params": {
            **trunk(actor),
            "kernel": kernel[:, m],
            "bias": bias[m].reshape(*shape, 1, -1),
        }
    }


# ----- statistics


def spread(proposals) -> float:
    """Standard deviation over the M proposals [M, A], averaged over the action's dimensions."""
    return float(np.mean([np.std(column) for column in np.asarray(proposals, np.float64).T]))


def distance(proposals) -> float:
    """Mean distance between two of the M proposals [M, A], over the diagonal of [-1, 1]^A."""
    rows = np.asarray(proposals, np.float64)
    pairs = itertools.combinations(range(len(rows)), 2)
    return float(np.mean([np.linalg.norm(rows[i] - rows[j]) for i, j in pairs])) / (
        2 * math.sqrt(rows.shape[1])
    )


def optima_share(values, proposals) -> float:
    """The share of Q's optima that have a head, from Q over a lattice of 41 points each way."""
    values, axis = np.asarray(values), np.linspace(-1, 1, 41, dtype=np.float32)
    found = []
    for place in np.ndindex(values.shape):
        around = itertools.product(*((i - 1, i, i + 1) for i in place))
        others = [values[p] for p in around if p != place and min(p) >= 0 and max(p) < 41]
        good = values[place] >= values.max() - 0.1 * (values.max() - values.min())
        if good and values[place] > max(others):
            off = np.abs(np.asarray(proposals) - axis[list(place)]).max(-1)
            found.append(off.min() <= 0.1)
    return float(np.mean(found)) if found else math.nan


def q_gap(values) -> float:
    """Largest minus smallest of the M values."""
    return float(max(values) - min(values))


def ou_moments(start, theta, sigma, dt, steps):
    """Mean and variance of the Euler-Maruyama Ornstein-Uhlenbeck process after some steps."""
    a = 1 - theta * dt
    variance = sigma**2 * dt * sum(a ** (2 * k) for k in range(steps))
    return start * a**steps, variance


def chi_square_limit(cells: int, deviations: float = 6.0) -> float:
    """A bound of Pearson's statistic: its mean plus so many of its standard deviations."""
    return (cells - 1) + deviations * math.sqrt(2 * (cells - 1))


# ----- finished runs, without training


def result(**fields) -> Result:
    """A record of MAPG on Hopper."""
    return Result(
        env="hopper", algorithm="mapg", heads=10, seed=0, steps=1000, return_mean=7.0,
        return_std=2.0, episodes=100, settings="", select="uniform", physics="native",
        versions="gymnasium 1.4.0, mujoco 3.17.0", seconds=60.0, date="2026-01-01",
        command="mapg train",
    )._replace(**fields)  # fmt: skip


def finished_run(config: Config, path: pathlib.Path, returns, metrics=None) -> RunFolder:
    """The files that a run leaves, with these returns."""
    folder = RunFolder.create(path, config)
    turn = config.environments
    for share in (0.25, 0.5, 0.75, 1.0):
        steps = math.ceil(share * config.steps / turn) * turn
        row = {
            "env_steps": steps, "return_mean": share * float(np.mean(returns)), "return_std": 1.0,
            "spread": 1.0 - share, "q_gap_relative": 0.5, "seconds": 12.5 * share,
        }  # fmt: skip
        with folder.metrics.open("a", newline="") as file:
            writer = csv.DictWriter(file, row)
            if share == 0.25:
                writer.writeheader()
            writer.writerow(row)
    record = {
        "env": config.env, "physics": "native", "select": "uniform", "episodes": len(returns),
        "mean": float(np.mean(returns)), "std": float(np.std(returns, ddof=1)),
        "returns": list(returns),
    }  # fmt: skip
    write_score(folder, record | ({"metrics": metrics} if metrics else {}))
    return folder
