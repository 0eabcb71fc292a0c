"""The examples of the documents run as they stand."""

import importlib
import pathlib
import re
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs

DOCS = pathlib.Path(__file__).parents[2] / "docs"


def snippets(name, heading=None):
    """The Python of a document, or of its part under a heading of the second level."""
    text = (DOCS / name).read_text()
    if heading:
        text = text.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


@pytest.fixture
def my_envs(tmp_path, monkeypatch):
    """The module of one's own environments, as the document has it."""
    monkeypatch.setattr(envs.registry, "_SPECS", dict(envs.registry._SPECS))
    source = "\n\n".join(snippets("environments.md", "Your own environment"))
    (tmp_path / "my_envs.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("my_envs")
    del sys.modules["my_envs"]


def test_ones_own_cart(my_envs, tmp_path):
    """Its last place after 20 steps of force 1 from rest is x + dt² (1 + ... + 20)."""
    env = envs.with_episodes(envs.make("my-cart", start=0.5), envs.spec("my-cart").time_limit)
    start = jax.jit(env.reset)(jax.random.key(0))
    _, states = jax.jit(
        lambda state: jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, state, jnp.ones((20, 1)))
    )(start)
    assert abs(start.obs[0]) <= 0.5
    np.testing.assert_allclose(
        states.obs[-1], [start.obs[0] + 0.05**2 * 210, 1.0], rtol=0, atol=1e-5
    )
    (scored,) = env.scored_metrics
    assert scored.over(states.metrics[scored.metric]) == np.mean(np.abs(states.obs[:, 0]) < 0.1)
    episode = envs.Episode(np.asarray(states.pipeline_state), states.obs, np.ones((19, 1)))
    (path,) = env.render([episode], None, tmp_path)  # the wrapper's is that of the environment
    np.testing.assert_allclose(
        np.loadtxt(path, delimiter=",", skiprows=1), states.obs, rtol=1e-6, atol=0
    )


@pytest.mark.usefixtures("my_envs")
def test_ones_own_task_on_mujoco():
    """In a batch, for half a second without force; the reward is what the document says."""
    env = envs.make("balance-at", "native", target=0.25)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 3))
    step = jax.jit(jax.vmap(env.step))
    for _ in range(12):
        state = step(state, jnp.zeros((3, 1)))
    np.testing.assert_allclose(state.reward, 1 - (state.obs[:, 0] - 0.25) ** 2, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(state.done, np.abs(state.obs[:, 1]) > 0.2)


@pytest.mark.usefixtures("my_envs", "their_code")
@pytest.mark.parametrize("other", ["mjx", pytest.param("mjx-warp", marks=pytest.mark.warp)])
def test_ones_own_task_is_the_same_on_every_engine(other):
    """In shapes and types, where it starts and after a step."""
    shapes = []
    for engine in ("native", other):
        env = envs.make("balance-at", engine)
        start = jax.eval_shape(env.reset, jax.random.key(0))
        after = jax.eval_shape(env.step, start, jax.ShapeDtypeStruct((1,), jnp.float32))
        shapes += [(state.obs, state.reward, state.done, state.metrics) for state in (start, after)]
    assert all(_described(tree) == _described(shapes[0]) for tree in shapes)


def _described(tree):
    return jax.tree.map(lambda x: (x.shape, x.dtype), tree)


def test_the_first_lines_of_driving():
    names = {}
    exec(snippets("driving.md")[0], names)
    assert names["state"].metrics["distance"] > 0


@pytest.mark.mjx
@pytest.mark.usefixtures("their_code")
def test_the_first_lines_of_the_environments():
    names = {}
    exec(snippets("environments.md")[0], names)
    assert np.isfinite(names["state"].obs).all()
