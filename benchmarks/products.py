"""The matrix products of one update, and the time that they alone take: its floor.

python -m benchmarks.products ENVIRONMENT HEADS prints the microseconds of ours.
"""

import itertools
import sys
import time
from collections.abc import Callable, Sequence

import numpy as np

Product = tuple[int, int, int]
"""Rows, inner size and columns."""

BATCH, HIDDEN = 64, (64, 64)
HALFCHEETAH = 17, 6
PENDULUM = 3, 1
"""Sizes of observation and action."""

REPEATS, ROUNDS = 2_000, 5


def forward(widths: Sequence[int]) -> list[Product]:
    """A network's layers on a batch."""
    return [(BATCH, size, width) for size, width in itertools.pairwise(widths)]


def weight_gradients(widths: Sequence[int]) -> list[Product]:
    """Of every layer: its inputs, transposed, by the gradients of its outputs."""
    return [(size, BATCH, width) for size, width in itertools.pairwise(widths)]


def input_gradients(widths: Sequence[int]) -> list[Product]:
    """Of every layer: the gradients of its outputs by its weights, transposed."""
    return [(BATCH, width, size) for size, width in itertools.pairwise(widths)]


def of_ddpg(sizes: tuple[int, int], critics: int = 1, actor_every: int = 1) -> list[Product]:
    """DDPG or TD3 whose critics see [observation, action]: `actor_every` updates of the critics
    and one of the actor."""
    observation, action = sizes
    actor, critic = (observation, *HIDDEN, action), (observation + action, *HIDDEN, 1)
    target = forward(actor) + critics * forward(critic)
    learning = forward(critic) + weight_gradients(critic) + input_gradients(critic)[1:]
    through_critics = critics * (forward(critic) + input_gradients(critic))
    return [
        *actor_every * (target + critics * learning),
        *forward(actor),
        *through_critics,
        *weight_gradients(actor),
        *input_gradients(actor)[1:],
    ]


def of_mapg(sizes: tuple[int, int], heads: int) -> list[Product]:
    """Ours: the critic's first layer sees the state, once a sample; the action joins at the second.

    Nothing flows back into the critic's state layer while the actor learns.
    """
    observation, action = sizes
    first, second = HIDDEN
    actor = observation, first, second, heads * action
    state, joint, last = (observation, first), (first, second), (second, 1)

    def critic(actions: int) -> list[Product]:
        rows = BATCH * actions
        return [*forward(state), *forward(joint), (rows, action, second), (rows, second, 1)]

    layers = (state, joint, (action, second), last)
    return [
        *forward(actor),  # the target's proposals
        *critic(heads),
        *critic(1),
        *itertools.chain.from_iterable(map(weight_gradients, layers)),
        *input_gradients(last),
        *input_gradients(joint),
        *forward(actor),
        *critic(1),
        *input_gradients(last),
        *input_gradients((action, second)),
        *weight_gradients(actor),
        *input_gradients(actor)[1:],
    ]


def jax_microseconds(products: Sequence[Product]) -> float:
    """All products once, in XLA, in a compiled loop."""
    import jax
    import jax.numpy as jnp

    lefts = [jnp.zeros((rows, inner)) for rows, inner, _ in products]
    rights = [jnp.zeros((inner, columns)) for _, inner, columns in products]
    outs = [jnp.zeros((rows, columns)) for rows, _, columns in products]

    def step(_, carry):
        lefts, _ = carry
        outs = [left @ right for left, right in zip(lefts, rights, strict=True)]
        # One number of each result goes back: else XLA would take the products out of the loop.
        lefts = [x.at[0, 0].set(y[0, 0]) for x, y in zip(lefts, outs, strict=True)]
        return lefts, outs

    loop = jax.jit(lambda carry: jax.lax.fori_loop(0, REPEATS, step, carry))
    return _microseconds(lambda: jax.block_until_ready(loop((lefts, outs))))


def torch_microseconds(products: Sequence[Product]) -> float:
    """All products once, in PyTorch, each called from Python."""
    import torch  # pyright: ignore[reportMissingImports] (it is in .venv-peers)

    operands = [
        (torch.zeros(rows, inner), torch.zeros(inner, columns), torch.zeros(rows, columns))
        for rows, inner, columns in products
    ]

    def run():
        for _ in range(REPEATS):
            for left, right, out in operands:
                torch.mm(left, right, out=out)

    with torch.inference_mode():
        return _microseconds(run)


def _microseconds(run: Callable[[], object]) -> float:
    run()  # compiles
    times = []
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        run()
        times.append(time.perf_counter() - begun)
    return float(np.median(times)) / REPEATS * 1e6


if __name__ == "__main__":
    environment, heads = sys.argv[1:]
    sizes = {"halfcheetah": HALFCHEETAH, "pendulum": PENDULUM}[environment]
    print(jax_microseconds(of_mapg(sizes, int(heads))))
