"""States of MuJoCo tasks that random actions reach."""

import jax
import numpy as np

import envs
from envs.base import with_episodes

INSTANCES = 16


def visited_states(name, rng):
    """qpos and qvel [INSTANCES, n] float32 of random episodes, instance i after 5 i steps."""
    env = with_episodes(envs.make(name, "native"), envs.spec(name).time_limit)
    model, step = env.task.model, jax.jit(jax.vmap(env.step))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), INSTANCES))
    rows = []
    for t in range(5 * INSTANCES):
        if t % 5 == 0:
            rows.append(np.asarray(state.pipeline_state)[t // 5].view(np.float64))
        actions = rng.uniform(-1, 1, (INSTANCES, model.nu)).astype(np.float32)
        state = step(state, actions)
    values = np.stack(rows)[:, 1 : 1 + model.nq + model.nv].astype(np.float32)
    return np.split(values, [model.nq], -1)
