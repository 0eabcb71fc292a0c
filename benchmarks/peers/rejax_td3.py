"""TD3 of rejax, two critics and no delay, on its Pendulum in JAX: training is one program.

python -m benchmarks.peers.rejax_td3 STEPS
"""

import sys
import time

import gymnax
import jax
import jax.numpy as jnp
from gymnax.wrappers.compat import LegacyStepAPIWrapper
from rejax import TD3

from benchmarks import peers, products

CRITICS = 2


class FiveValues(LegacyStepAPIWrapper):
    """rejax 0.1.3 unpacks what a step of gymnax gave before 1.0, and copies its environment."""

    def __deepcopy__(self, _):
        return self


def main(steps: int) -> None:
    algorithm = TD3.create(
        env=FiveValues(gymnax.make("Pendulum-v1")[0]),
        total_timesteps=steps,
        eval_freq=steps,
        skip_initial_evaluation=True,
        num_envs=1,
        num_epochs=1,
        policy_delay=1,
        num_critics=CRITICS,
        buffer_size=100_000,
        fill_buffer=products.BATCH,
        batch_size=products.BATCH,
        actor_kwargs={"activation": "relu"},
        critic_kwargs={"activation": "relu"},
    )
    algorithm = algorithm.replace(eval_callback=lambda *_: jnp.zeros(()))  # evaluation apart
    train = jax.jit(algorithm.train).lower(jax.random.PRNGKey(0)).compile()
    begun = time.perf_counter()
    jax.block_until_ready(train(jax.random.PRNGKey(0)))
    rate = steps / (time.perf_counter() - begun)
    update = products.of_ddpg(products.PENDULUM, critics=CRITICS)
    peers.tell(rate, products.jax_microseconds(update))


if __name__ == "__main__":
    main(int(sys.argv[1]))
