"""Monte-Carlo returns of the heads, on policies whose heads are known to be worth the same."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from experiments import returns
from mapg_jax.runs.policy import Policy
from mapg_jax.training.trainer import make_trainer


@pytest.fixture(scope="module")
def played():
    """Of a policy that proposes 0 with every head."""
    trainer = make_trainer(oracles.RUN)
    state = trainer.jitted_init(0).agent
    idle = jax.tree.map(jnp.zeros_like, state.learner.actor)
    state = state.replace(learner=state.learner.replace(actor=idle))
    policy = Policy(trainer.env.env, trainer.agent, state, 0)
    with pytest.MonkeyPatch.context() as patch:
        for name, number in (("STATES", 4), ("REPEATS", 2), ("ACTIONS", 5)):
            patch.setattr(returns, name, number)
        return returns.play(policy, oracles.RUN, horizon=20)


def test_heads_that_propose_the_same_return_the_same(played):
    m = oracles.RUN.heads
    assert played.heads.shape == (4, m, 2) and played.held.shape == (4, m, 1)
    assert returns.scatter(played.heads) == 0
    assert np.array_equal(played.heads[..., :1], played.held)
    assert np.ptp(played.q_heads, axis=1).max() < 1e-5


def test_actions_at_random_differ_and_their_repeats_do_not(played):
    """Pendulum is deterministic, and what comes after the first action is the same."""
    assert played.actions.shape == (4, 5, 2)
    assert np.array_equal(played.actions[..., 0], played.actions[..., 1])
    assert returns.scatter(played.actions) > 0.01
    assert len(np.unique(played.heads[:, 0, 0])) == 4  # states of four episodes
