"""MuJoCo Warp as a physics engine: as MJX has it, however its simulations are laid out."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from visited import visited_states

import envs
from envs.mujoco_env import MujocoEnv

PLANAR = ("hopper", "walker2d", "halfcheetah", "swimmer")


def starts(name):
    """qpos, qvel and actions, 16 of each."""
    rng = np.random.default_rng(0)
    qpos, qvel = visited_states(name, rng)
    actions = rng.uniform(-1, 1, (len(qpos), envs.make(name, "native").action_size))
    return qpos, qvel, actions.astype(np.float32)


def stepped(env):
    """(qpos, qvel, action) → the state after a control step from there."""
    return lambda qpos, qvel, action: env.step(env.reset_to(qpos, qvel), action)


def test_tasks_that_observe_contact_forces_have_no_such_engine():
    tasks = [spec for spec in envs.registry.loaded() if "mjx" in spec.engines]
    for spec in tasks:
        reads = "cfrc_ext" in spec.load().fields
        assert spec.engines == (("native", "mjx") if reads else ("native", "mjx", "mjx-warp"))
    with pytest.raises(ValueError, match=r"ant has no engine 'mjx-warp'; it has native, mjx$"):
        envs.make("ant", "mjx-warp")
    task = envs.make("ant", "native").task  # as a user's own could be registered
    with pytest.raises(ValueError, match="Ant reads cfrc_ext, which MuJoCo Warp does not compute"):
        MujocoEnv(task, "mjx-warp")


def test_a_missing_extra_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(ValueError, match=r"mjx-warp needs: pip install 'mapg-jax\[warp\]'"):
        envs.make("hopper", "mjx-warp")


@pytest.mark.warp
@pytest.mark.usefixtures("their_code")
@pytest.mark.parametrize("name", PLANAR)
def test_it_agrees_with_mjx(name):
    """In float32 both, whose sums have other orders: what stiff contacts make of 6e-8."""
    inputs = starts(name)
    theirs, ours = (
        jax.device_get(jax.jit(jax.vmap(stepped(envs.make(name, engine))))(*inputs))
        for engine in ("mjx", "mjx-warp")
    )
    theirs_at, ours_at = theirs.pipeline_state, ours.pipeline_state
    np.testing.assert_allclose(ours_at.qpos, theirs_at.qpos, rtol=0, atol=1e-5)
    np.testing.assert_allclose(ours_at.qvel, theirs_at.qvel, rtol=0, atol=1e-3)
    np.testing.assert_allclose(ours.obs, theirs.obs, rtol=0, atol=1e-3)
    np.testing.assert_allclose(ours.reward, theirs.reward, rtol=1e-3, atol=1e-3)
    np.testing.assert_array_equal(ours.done, theirs.done)
    assert ours.metrics.keys() == theirs.metrics.keys()


@pytest.mark.warp
@pytest.mark.usefixtures("their_code")
def test_simulations_do_not_touch_each_other():
    """The same bits in one batch, in two axes of a batch, and alone: none takes another's room."""
    step, inputs = stepped(envs.make("walker2d", "mjx-warp")), starts("walker2d")
    batch = jax.device_get(jax.jit(jax.vmap(step))(*inputs))
    assert (batch.pipeline_state.qvel != inputs[1]).any(-1).all()
    laid = [x.reshape(2, 8, *x.shape[1:]) for x in inputs]
    twice = jax.device_get(jax.jit(jax.vmap(jax.vmap(step)))(*laid))
    one_qpos = jax.device_get(jax.jit(jax.vmap(step, (None, 0, 0)))(inputs[0][0], *inputs[1:]))
    alone = jax.device_get(jax.jit(step)(*(x[3] for x in inputs)))
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x, y.reshape(x.shape)), batch, twice)
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[3], y), batch, alone)
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[0], y[0]), batch, one_qpos)


@pytest.mark.warp
@pytest.mark.usefixtures("their_code")
def test_the_room_for_contacts_is_enough(capfd):
    """Of a heap of fallen walkers, as the native engine has them; Warp says what it drops."""
    native, ours = (envs.make("walker2d", engine) for engine in ("native", "mjx-warp"))
    rng = np.random.default_rng(1)
    qpos = rng.uniform(-1, 1, (64, native.task.model.nq)).astype(np.float32)
    qpos[:, 1] = rng.uniform(-0.3, 0.1, 64)  # on the floor, and in it
    qvel = rng.normal(0, 1, (64, native.task.model.nv)).astype(np.float32)
    action = np.zeros((64, 6), np.float32)
    expected, found = (
        jax.device_get(jax.jit(jax.vmap(stepped(env)))(qpos, qvel, action))
        for env in (native, ours)
    )
    # They are thrown out of the floor, at up to hundreds of m/s.
    np.testing.assert_allclose(found.obs, expected.obs, rtol=1e-3, atol=1e-3)
    assert "overflow" not in "".join(capfd.readouterr())


@pytest.mark.warp
@pytest.mark.usefixtures("their_code")
def test_it_lowers_for_gpus():
    """4,096 simulations, on a machine without one; all in one call of Warp's a physics step."""
    env = envs.make("hopper", "mjx-warp")
    state = jax.eval_shape(jax.vmap(env.reset), jax.random.split(jax.random.key(0), 4096))
    actions = jax.ShapeDtypeStruct((4096, 3), jnp.float32)
    lowered = jax.jit(jax.vmap(env.step)).trace(state, actions).lower(lowering_platforms=("cuda",))
    calls = [line for line in lowered.as_text().splitlines() if "custom_call @jax_callable" in line]
    assert len(calls) == 1 and "tensor<4096x6xf32>" in calls[0]  # qpos and qvel
