"""The native engine is Gymnasium, to the last bit, one instance or many."""

import dataclasses
import functools
import gc
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.stats

import envs
from envs.engines import host_call
from envs.engines.native import NativeEngine
from envs.mujoco_tasks.hopper import Hopper
from envs.mujoco_tasks.inverted_pendulum import InvertedPendulum

DOCUMENT = pathlib.Path(__file__).parents[2] / "docs" / "environments.md"
NAMES = [name for name in envs.names() if "native" in envs.spec(name).engines]
TRAVELLERS = ["hopper", "walker2d", "halfcheetah", "swimmer", "humanoid", "ant"]

# float32 rounds a reward, and a metric, by 6e-8 of its size; the sums before it are float64,
# but for the control cost, which is float32 in Gymnasium too.
REWARD_TOLERANCE = 1e-5

make = functools.cache(envs.make)


def rollout(env, qpos, qvel, actions):
    """The states before and after every action, from one compiled scan; leaves [T, ...]."""

    @jax.jit
    def run(start, actions):
        def step(state, action):
            state = env.step(state, action)
            return state, state

        return jax.lax.scan(step, start, actions)[1]

    start = env.reset_to(qpos, qvel)
    return start, run(start, actions)


def float64(state, model):
    """The float64 qpos and qvel that a state carries; a row begins with the time."""
    values = np.asarray(state.pipeline_state).view(np.float64)
    return np.split(values[..., 1 : 1 + model.nq + model.nv], [model.nq], -1)


def assert_equals_gymnasium(name, reference, qpos, qvel, steps, **options):
    env = envs.make(name, "native", **options) if options else make(name, "native")
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1, 1, (steps, env.action_size)).astype(np.float32)
    start, states = jax.device_get(rollout(env, qpos, qvel, actions))
    got_qpos, got_qvel = float64(states, env.task.model)

    np.testing.assert_array_equal(start.obs, reference.reset_to(qpos, qvel))
    stepped = []
    for action in actions:
        *seen, info = reference.step(action * env.action_high)
        stepped.append((*seen, info, reference.data.qpos.copy(), reference.data.qvel.copy()))
    observation, reward, terminated, info, expected_qpos, expected_qvel = zip(*stepped, strict=True)
    np.testing.assert_array_equal(got_qpos, expected_qpos)
    np.testing.assert_array_equal(got_qvel, expected_qvel)
    np.testing.assert_array_equal(states.obs, observation)
    np.testing.assert_array_equal(states.done, terminated)
    assert_close(states.reward, np.array(reward))
    assert states.metrics.keys() == info[0].keys()
    for key, value in states.metrics.items():
        assert_close(value, np.array([one[key] for one in info]))


def assert_close(got, expected):
    assert (abs(got - expected) <= REWARD_TOLERANCE * np.maximum(1, abs(expected))).all()


@pytest.mark.parametrize("name", NAMES)
def test_thousand_steps_are_gymnasiums(name, gymnasium_task, random_state):
    model = make(name, "native").task.model
    qpos, qvel = random_state(model, np.random.default_rng(0))
    assert_equals_gymnasium(name, gymnasium_task(name), qpos, qvel, steps=1000)


def test_ones_own_robot_of_the_documents(tmp_path, monkeypatch, gymnasium_task, random_state):
    monkeypatch.chdir(tmp_path)
    text = DOCUMENT.read_text().split("\n## Your own robot\n")[1]
    exec(text.split("```python\n")[1].split("```")[0], {})
    own = {"xml_file": "./heavy_hopper.xml"}
    theirs = gymnasium_task("hopper", **own)
    torso = theirs.env.model.body("torso").mass
    assert torso == pytest.approx(1.5 * make("hopper", "native").task.model.body("torso").mass)
    qpos, qvel = random_state(theirs.env.model, np.random.default_rng(0))
    assert_equals_gymnasium("hopper", theirs, qpos, qvel, steps=50, **own)


@pytest.mark.parametrize("name", TRAVELLERS)
def test_steps_a_kilometre_away_are_gymnasiums(name, gymnasium_task, random_state):
    qpos, qvel = random_state(make(name, "native").task.model, np.random.default_rng(2))
    qpos[0] += 1000.0  # m
    assert_equals_gymnasium(name, gymnasium_task(name), qpos, qvel, steps=50)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        (
            "hopper",
            {
                "exclude_current_positions_from_observation": False,
                "healthy_z_range": (1.2, 1.3),
                "terminate_when_unhealthy": False,
                "frame_skip": 2,
            },
        ),
        ("walker2d", {"healthy_reward": 2.0, "healthy_angle_range": (-0.1, 0.1)}),
        ("halfcheetah", {"forward_reward_weight": 2.0, "ctrl_cost_weight": 0.7}),
        ("swimmer", {"exclude_current_positions_from_observation": False}),
        (
            "ant",
            {
                "include_cfrc_ext_in_observation": False,
                "contact_force_range": (-3.0, 2.0),
                "contact_cost_weight": 0.1,
                "main_body": "aux_1",
            },
        ),
        (
            "humanoid",
            {
                "exclude_current_positions_from_observation": False,
                "include_cvel_in_observation": False,
                "contact_cost_weight": 1e-3,
                "contact_cost_range": (0.5, 3.0),
            },
        ),
        ("humanoid_standup", {"impact_cost_weight": 1e-3, "include_cinert_in_observation": False}),
        ("inverted_double_pendulum", {"healthy_reward": 3.0}),
        ("reacher", {"reward_dist_weight": 2.0, "reward_control_weight": 0.1}),
        ("pusher", {"reward_near_weight": 2.0, "reward_dist_weight": 0.3}),
    ],
)
def test_options_are_gymnasiums(name, options, gymnasium_task, random_state):
    reference = gymnasium_task(name, **options)
    qpos, qvel = random_state(reference.env.model, np.random.default_rng(3))
    assert_equals_gymnasium(name, reference, qpos, qvel, steps=50, **options)


def test_humanoid_with_constant_zeros_observes_what_gymnasiums_v4_did(random_state):
    from gymnasium.envs.mujoco.humanoid_v4 import HumanoidEnv  # by class: make() would warn

    env = envs.make("humanoid", "native", include_constant_zeros=True)
    reference = HumanoidEnv()
    qpos, qvel = random_state(env.task.model, np.random.default_rng(4))
    actions = np.random.default_rng(5).uniform(-1, 1, (100, env.action_size)).astype(np.float32)
    start, states = rollout(env, qpos, qvel, actions)

    mujoco.mj_resetData(reference.model, reference.data)
    reference.set_state(qpos, qvel)
    assert env.observation_size == 376
    np.testing.assert_array_equal(start.obs, reference._get_obs().astype(np.float32))
    for t, action in enumerate(actions):
        observation = reference.step(action * env.action_high)[0]
        np.testing.assert_array_equal(states.obs[t], observation.astype(np.float32))


@pytest.mark.parametrize("name", ["halfcheetah", "ant", "humanoid"])
def test_a_batch_steps_every_instance_as_if_alone(name, random_state):
    env = make(name, "native")
    rng = np.random.default_rng(6)
    starts = [random_state(env.task.model, rng, scale) for scale in np.linspace(0.01, 0.3, 12)]
    actions = rng.uniform(-1, 1, (12, env.action_size)).astype(np.float32)
    one = jax.jit(env.step)
    states = [env.reset_to(*start) for start in starts]
    for _ in range(5):
        states = [one(state, action) for state, action in zip(states, actions, strict=True)]
    expected = jax.tree.map(lambda *leaves: np.stack(leaves), *states)

    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *(env.reset_to(*s) for s in starts))
    nested = jax.tree.map(lambda x: x.reshape(3, 4, *x.shape[1:]), batch)
    flat_step, nested_step = jax.jit(jax.vmap(env.step)), jax.jit(jax.vmap(jax.vmap(env.step)))
    for _ in range(5):
        batch = flat_step(batch, actions)
        nested = nested_step(nested, actions.reshape(3, 4, -1))
        flat_step(jax.tree.map(lambda x: np.flip(x, 0), batch), actions)  # unrelated, in between

    jax.tree.map(np.testing.assert_array_equal, batch, expected)
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x.reshape(y.shape), y), nested, batch)


@pytest.mark.parametrize("name", NAMES)
def test_starts_are_drawn_as_gymnasium_draws_them(name, gymnasium_task):
    """A Kolmogorov-Smirnov test of every coordinate; the smallest of its p-values is compared.

    With 400 draws on both sides and at most 47 coordinates, p < 1e-6 comes once in 20,000 runs by
    chance, and the keys are fixed.
    """
    draws = 400
    task, reference = make(name, "native").task, gymnasium_task(name)
    keys = jax.random.split(jax.random.key(7), draws)
    qpos, qvel = jax.vmap(task.start_offset)(keys)
    ours = np.concatenate([task.model.qpos0 + np.asarray(qpos), qvel], -1)
    theirs = []
    reference.env.reset(seed=7)
    for _ in range(draws):
        reference.env.reset()
        theirs.append(np.concatenate([reference.data.qpos, reference.data.qvel]))
    theirs = np.stack(theirs)

    constant = np.ptp(theirs, axis=0) == 0
    np.testing.assert_array_equal(ours[:, constant], theirs[:, constant])
    for mine, other in zip(ours[:, ~constant].T, theirs[:, ~constant].T, strict=True):
        assert scipy.stats.ks_2samp(mine, other).pvalue > 1e-6


def test_reset_is_a_start_plus_its_offset_in_float64():
    env, key = make("hopper", "native"), jax.random.key(8)
    qpos, qvel = env.task.start_offset(key)
    got_qpos, got_qvel = float64(env.reset(key), env.task.model)
    np.testing.assert_array_equal(got_qpos, env.task.model.qpos0 + np.float64(qpos))
    np.testing.assert_array_equal(got_qvel, np.float64(qvel))


@pytest.mark.parametrize("make_key", [jax.random.PRNGKey, jax.random.key])
def test_legacy_and_typed_keys_both_reset(make_key):
    env = make("reacher", "native")
    first, second = env.reset(make_key(0)), env.reset(make_key(1))
    assert not np.array_equal(first.obs, second.obs)
    jax.tree.map(np.testing.assert_array_equal, first, env.reset(make_key(0)))


def test_actions_are_clipped_to_one():
    env = make("humanoid", "native")
    state = env.reset(jax.random.key(0))
    actions = np.linspace(-3, 3, env.action_size, dtype=np.float32)
    wild, clipped = env.step(state, actions), env.step(state, actions.clip(-1, 1))
    jax.tree.map(np.testing.assert_array_equal, wild, clipped)


def test_step_keeps_what_wrappers_wrote():
    env = make("hopper", "native")
    state = env.reset(jax.random.key(0))
    state = state.replace(
        info={**state.info, "wrapper": 1}, metrics={**state.metrics, "wrapper": 2}
    )
    after = env.step(state, np.zeros(env.action_size, np.float32))
    assert after.info["wrapper"] == 1
    assert after.metrics["wrapper"] == 2
    assert "wrapper" not in env.reset(jax.random.key(0)).info


def test_mj_data_is_the_simulation_of_the_state(random_state):
    env = make("ant", "native")
    qpos, qvel = random_state(env.task.model, np.random.default_rng(9))
    state = env.step(env.reset_to(qpos, qvel), np.ones(env.action_size, np.float32))
    data = env.mj_data(state)
    expected_qpos, expected_qvel = float64(state, env.task.model)
    np.testing.assert_array_equal(data.qpos, expected_qpos)
    np.testing.assert_array_equal(data.qvel, expected_qvel)
    np.testing.assert_array_equal(data.body("torso").xpos, expected_qpos[:3])
    assert data.time == pytest.approx(env.dt, rel=1e-12)  # five sums of 0.01 in float64


def test_reset_to_names_the_shapes_it_wants():
    with pytest.raises(ValueError, match=r"shapes \(6,\) and \(6,\), got \(5,\) and \(6,\)"):
        make("hopper", "native").reset_to(np.zeros(5), np.zeros(6))


def test_asymmetric_controls_are_refused(tmp_path):
    model = tmp_path / "lopsided.xml"
    model.write_text("""
        <mujoco>
          <worldbody>
            <body><joint name="x" type="slide"/><joint name="y"/><geom size="1"/></body>
          </worldbody>
          <actuator><motor joint="x" ctrllimited="true" ctrlrange="0 1"/></actuator>
        </mujoco>
    """)
    with pytest.raises(ValueError, match="control ranges must be symmetric"):
        envs.make("inverted_pendulum", "native", xml_file=str(model))


def test_an_action_that_is_no_number_leaves_no_file(tmp_path, monkeypatch, capfd):
    """MuJoCo warns, resets the simulation and goes on, and would keep a log in the folder."""
    monkeypatch.chdir(tmp_path)
    env = make("hopper", "native")
    state = jax.jit(env.reset)(jax.random.key(0))
    after = jax.jit(env.step)(state, np.full(3, np.nan, np.float32))
    assert np.isfinite(after.obs).all()
    assert "Nan, Inf or huge value in CTRL" in "".join(capfd.readouterr())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["halfcheetah", "ant"])
def test_the_host_is_called_alike_both_ways(name, monkeypatch):
    env = make(name, "native")
    keys = jax.random.split(jax.random.key(0), 3)
    actions = np.random.default_rng(0).uniform(-1, 1, (3, env.action_size)).astype(np.float32)

    def run(keys, actions):
        states = jax.vmap(env.reset)(keys)
        step = lambda _, states: jax.vmap(env.step)(states, actions)  # noqa: E731
        return jax.lax.fori_loop(0, 20, step, states)

    foreign = jax.jit(run).lower(keys, actions)
    monkeypatch.setattr(host_call, "interface_is_known", lambda: False)
    callback = jax.jit(lambda *arguments: run(*arguments)).lower(keys, actions)
    assert "python_cpu_callback" not in foreign.as_text()
    assert "python_cpu_callback" in callback.as_text()
    jax.tree.map(
        np.testing.assert_array_equal,
        foreign.compile()(keys, actions),
        callback.compile()(keys, actions),
    )


def test_an_engines_errors_reach_the_user(monkeypatch):
    env = envs.make("hopper", "native", frame_skip=3)

    def fail(*_):
        raise RuntimeError("the simulation broke")

    monkeypatch.setattr(env.engine._host._simulator, "step", fail)
    state = env.reset(jax.random.key(0))
    with pytest.raises(jax.errors.JaxRuntimeError, match="RuntimeError: the simulation broke"):
        jax.block_until_ready(jax.jit(env.step)(state, np.zeros(3, np.float32)))


def test_equal_tasks_are_one_on_the_host_and_others_are_not():
    def host(task):
        return NativeEngine(task)._host

    first = host(Hopper())
    targets = len(host_call._handlers)
    for _ in range(3):
        env = envs.make("hopper", "native")
        env.step(env.reset(jax.random.key(0)), np.zeros(3, np.float32))
        assert env.engine._host is first
    assert len(host_call._handlers) <= targets + 2  # reset and step, unless they were known

    heavier = Hopper()
    heavier.model.body_mass[1] *= 2
    again = dataclasses.make_dataclass("Hopper", [], bases=(Hopper,), frozen=True, eq=False)
    again.__module__, again.__qualname__ = Hopper.__module__, Hopper.__qualname__
    others = [Hopper(healthy_reward=2.0), heavier, again(), InvertedPendulum()]
    hosts = [host(task) for task in others]
    names = {first.name, *(other.name for other in hosts)}
    assert len(names) == 1 + len(others)
    assert [host(task) for task in others] == hosts


def test_a_change_of_the_model_changes_no_engine_made_before():
    task = InvertedPendulum()
    engine, key = NativeEngine(task), jax.random.key(0)
    control = jnp.ones(1)
    before = engine.step(engine.reset(key)[0], control)[0]
    task.model.opt.gravity[2] = 0.0
    np.testing.assert_array_equal(engine.step(engine.reset(key)[0], control)[0], before)
    changed = NativeEngine(task)
    assert not np.array_equal(changed.step(changed.reset(key)[0], control)[0], before)


def test_a_task_that_holds_objects_is_not_mistaken_for_another():
    @dataclasses.dataclass(frozen=True, eq=False)
    class Paid(InvertedPendulum):
        pay: object = None

        def reward(self, xp, anchor, physics, control):
            reward, metrics = super().reward(xp, anchor, physics, control)
            return self.pay(reward), metrics

    for factor in (2.0, 3.0):
        engine = NativeEngine(Paid(pay=lambda reward, factor=factor: factor * reward))
        bits, _ = engine.reset(jax.random.key(0))
        assert jax.jit(engine.step)(bits, jnp.zeros(1))[1].reward == factor


def test_a_program_outlives_its_engine():
    env = envs.make("inverted_pendulum", "native", frame_skip=4)
    state, action = env.reset(jax.random.key(0)), np.zeros(1, np.float32)
    expected = env.step(state, action)
    program = jax.jit(env.step).lower(state, action).compile()
    del env
    gc.collect()
    jax.tree.map(np.testing.assert_array_equal, program(state, action), expected)


def test_the_hosts_name_is_the_same_in_every_process():
    """Compiled programs hold it, and are found again in JAX's persistent cache by it."""
    code = "import envs; print(envs.make('humanoid', 'native', frame_skip=2).engine._host.name)"
    printed = subprocess.run(
        [sys.executable, "-c", code], check=True, stdout=subprocess.PIPE, text=True
    ).stdout
    assert printed.strip() == envs.make("humanoid", "native", frame_skip=2).engine._host.name
