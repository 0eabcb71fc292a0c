"""HalfCheetahs per second: raw mujoco.batch, behind the callback in jit, and as an environment."""

import time

import jax
import jax.numpy as jnp
import numpy as np
from mujoco.batch import Batch

import envs
from envs.mujoco_env import MujocoEnv
from envs.mujoco_tasks.halfcheetah import HalfCheetah

SIMULATIONS = 256
STEPS = 50
ROUNDS = 9


def _rate(function) -> float:
    begun = time.perf_counter()
    function()
    return SIMULATIONS * STEPS / (time.perf_counter() - begun)


def measure() -> dict[str, float]:
    """Control steps per second, the median over interleaved rounds, of each of the three."""
    env = MujocoEnv(HalfCheetah(), "native")
    episodes = envs.with_episodes(env, 1000)
    batch = Batch(env.task.model, SIMULATIONS)
    control = np.random.default_rng(0).uniform(-1, 1, (STEPS, SIMULATIONS, 6))
    actions = jnp.asarray(control, jnp.float32)
    keys = jax.random.split(jax.random.key(0), SIMULATIONS)

    def raw():
        for ctrl in control:
            batch.ctrl = ctrl
            batch.step(nstep=env.task.frame_skip)

    def scan(step):
        def body(carry, action):
            return jax.vmap(step)(carry, action), None

        return jax.jit(lambda carry: jax.lax.scan(body, carry, actions)[0])

    callback = scan(lambda state, action: env.engine.step(state, action)[0])
    whole = scan(episodes.step)
    bits = jax.vmap(env.reset)(keys).pipeline_state
    states = jax.vmap(episodes.reset)(keys)

    subjects = {
        "raw": raw,
        "callback": lambda: jax.block_until_ready(callback(bits)),
        "environment": lambda: jax.block_until_ready(whole(states)),
    }
    for function in subjects.values():
        function()  # compile, and let the thread pools start
    rates = {name: [] for name in subjects}
    for _ in range(ROUNDS):
        for name, function in subjects.items():
            rates[name].append(_rate(function))
    return {name: float(np.median(values)) for name, values in rates.items()}
