"""MuJoCo XLA and Warp run the same tasks: a control step of theirs against the native engine's."""

import threading

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from visited import INSTANCES, visited_states

import envs
from envs.base import with_episodes
from envs.engines.contact_frames import mujoco_contact_frames

pytestmark = pytest.mark.usefixtures("their_code")

COMPILED_BY_DEFAULT = (
    ("inverted_pendulum", "mjx"),
)  # the quickest; hopper is traced by `make test-slow`
TRACED_BY_DEFAULT = ("ant",)  # whose fields MJX keeps in several places
CONTACT_FORCES_SEEN = ("ant", "humanoid", "humanoid_standup")  # stiff: 1e-7 m is much force

CAPSULE = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body><freejoint/><geom type="capsule" size="0.1 0.2"/></body>
  </worldbody>
</mujoco>
"""


def tasks(default):
    return [
        name if name in default else pytest.param(name, marks=pytest.mark.mjx)
        for name in envs.names()
        if "mjx" in envs.spec(name).engines
    ]


def on_engines(default):
    """Names with each engine that they have beside the native one."""
    marks = {"mjx": pytest.mark.mjx, "mjx-warp": pytest.mark.warp}
    return [
        pytest.param(name, engine, marks=() if (name, engine) in default else marks[engine])
        for name in envs.names()
        for engine in envs.spec(name).engines
        if engine in marks
    ]


@pytest.mark.parametrize(("name", "engine"), on_engines(COMPILED_BY_DEFAULT))
def test_a_control_step_is_the_native_engines(name, engine):
    native, xla = envs.make(name, "native"), envs.make(name, engine)
    rng = np.random.default_rng(0)
    qpos, qvel = visited_states(name, rng)
    actions = rng.uniform(-1, 1, (INSTANCES, native.action_size)).astype(np.float32)

    def two_steps_of(env):
        def play(qpos, qvel, action):
            start, actions = env.reset_to(qpos, qvel), jnp.stack([action, -action])
            return jax.lax.scan(lambda state, a: (env.step(state, a),) * 2, start, actions)[1]

        states = jax.device_get(jax.jit(jax.vmap(play))(qpos, qvel, actions))
        return [jax.tree.map(lambda x: x[:, t], states) for t in range(2)]  # noqa: B023

    (theirs, their_second), (ours, our_second) = two_steps_of(native), two_steps_of(xla)
    model = native.task.model
    row = theirs.pipeline_state.view(np.float64)[:, 1 : 1 + model.nq + model.nv]
    expected_qpos, expected_qvel = np.split(row, [model.nq], -1)
    # float32 against float64: what a control step of stiff contacts makes of 6e-8.
    np.testing.assert_allclose(ours.pipeline_state.qpos, expected_qpos, rtol=0, atol=1e-5)
    np.testing.assert_allclose(ours.pipeline_state.qvel, expected_qvel, rtol=0, atol=1e-3)
    # Velocities reach the observation and, through them and x, the reward.
    np.testing.assert_allclose(ours.reward, theirs.reward, rtol=1e-3, atol=1e-3)
    np.testing.assert_array_equal(ours.done, theirs.done)
    assert ours.metrics.keys() == theirs.metrics.keys()
    if (name, engine) in COMPILED_BY_DEFAULT:  # what one step hands on to the next
        np.testing.assert_allclose(our_second.reward, their_second.reward, rtol=1e-2, atol=1e-2)
        np.testing.assert_allclose(our_second.pipeline_state.time, 2 * xla.dt, rtol=1e-5)
    if name not in CONTACT_FORCES_SEEN:
        np.testing.assert_allclose(ours.obs, theirs.obs, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", tasks(TRACED_BY_DEFAULT))
def test_episodes_keep_shapes_and_types(name):
    """As `lax.scan` wants them, and the native engine's outputs."""
    env = with_episodes(envs.make(name, "mjx"), 10)
    native = with_episodes(envs.make(name, "native"), 10)
    start = jax.eval_shape(env.reset, jax.random.key(0))
    action = jax.ShapeDtypeStruct((env.action_size,), jnp.float32)
    after = jax.eval_shape(env.step, start, action)

    def shape(x):
        return x.shape, x.dtype

    assert jax.tree.map(shape, start) == jax.tree.map(shape, after)
    expected = jax.eval_shape(native.reset, jax.random.key(0)).replace(pipeline_state=None)
    assert jax.tree.map(shape, after.replace(pipeline_state=None)) == jax.tree.map(shape, expected)


def test_contact_frames_of_capsules_are_mujocos():
    """At every lean from the plane's normal; MJX alone differs below 30°, and is left as it was."""
    model = mujoco.MjModel.from_xml_string(CAPSULE)
    data, mjx_model = mujoco.MjData(model), mjx.put_model(model)
    rng = np.random.default_rng(0)
    leans, turns = np.linspace(0.05, np.pi / 2, 12), rng.uniform(0, 2 * np.pi, 12)
    quaternions = np.stack(
        [
            np.cos(leans / 2),
            np.sin(leans / 2) * np.cos(turns),
            np.sin(leans / 2) * np.sin(turns),
            np.zeros(12),
        ],
        -1,
    )

    def frames(quaternion):
        state = mjx.make_data(mjx_model).replace(
            qpos=jnp.concatenate([jnp.zeros(3), jnp.asarray(quaternion, jnp.float32)])
        )
        return mjx.collision(mjx_model, mjx.kinematics(mjx_model, state))._impl.contact.frame[0]

    with mujoco_contact_frames():
        corrected = jax.jit(jax.vmap(frames))(quaternions)
    plain = jax.jit(jax.vmap(lambda q: frames(q)))(quaternions)  # another function, traced anew
    expected = []
    for quaternion in quaternions:
        data.qpos[3:] = quaternion
        mujoco.mj_forward(model, data)
        expected.append(data.contact.frame[0].reshape(3, 3).copy())
    # A frame is a unit axis seen under a lean of at least 0.05: float32's 6e-8, 20 times.
    np.testing.assert_allclose(corrected, expected, atol=1e-5)
    differs = np.abs(plain - np.stack(expected)).max((1, 2)) > 0.1
    np.testing.assert_array_equal(differs, np.sin(leans) < 0.5)


def test_other_threads_see_mjx_as_it_is():
    """While one traces with MuJoCo's frames; the programs tell them apart."""
    model = mjx.put_model(mujoco.MjModel.from_xml_string(CAPSULE))
    data = jax.eval_shape(lambda: mjx.make_data(model))

    def traced():
        return str(
            jax.make_jaxpr(lambda data: mjx.collision(model, mjx.kinematics(model, data)))(data)
        )

    def trace_elsewhere():
        found.append(traced())

    found, plain = [], traced()
    with mujoco_contact_frames():
        assert traced() != plain
        thread = threading.Thread(target=trace_elsewhere)
        thread.start()
        thread.join()
    assert found == [plain]
    assert traced() == plain


def test_the_solver_that_mjx_lacks_is_replaced():
    env = envs.make("humanoid", "mjx")
    assert env.task.model.opt.solver == mujoco.mjtSolver.mjSOL_PGS
    assert env.engine.model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON


def test_mj_data_is_the_simulation_of_the_state():
    env = envs.make("ant", "mjx")
    model = env.task.model
    shapes = jax.eval_shape(env.reset, jax.random.key(0))
    state = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    qpos = jnp.asarray(model.qpos0, jnp.float32).at[:2].set(2.0)
    state = state.replace(pipeline_state=state.pipeline_state.replace(qpos=qpos))
    data = env.mj_data(state)
    np.testing.assert_array_equal(data.qpos, qpos)
    np.testing.assert_array_equal(data.body("torso").xpos, qpos[:3])
