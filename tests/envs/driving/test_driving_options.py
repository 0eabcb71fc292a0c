"""Options of driving: laps as an end, the road ahead, cars of other numbers, bounds."""

from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.driving import Driving, from_segments, parse_segments, scripted_driver
from envs.driving.setup import Setup, drawn
from envs.driving.vehicle import MASS, at_rest, step_car

RING = from_segments("ring", parse_segments("S100 L40/180 S100 L40/180"), 12.0)  # 451 m


def make(**options) -> Driving:
    return cast(Driving, envs.make("driving", track=RING, **options))


@pytest.fixture(scope="module")
def two_laps():
    """The scripted driver until `max_laps=2` ends it, of an environment with a view ahead."""
    env = make(max_laps=2, lookahead=(0.0, 30.0), control_hz=20)
    policy = scripted_driver(env.ray_angles)

    @jax.jit
    def drive(key):
        def step(state, _):
            state = env.step(state, policy(state.obs[:29]))
            return state, state

        return jax.lax.scan(step, env.reset(key), length=1200)[1]

    states = jax.device_get(drive(jax.random.key(0)))
    last = int(np.argmax(states.done))
    return env, jax.tree.map(lambda x: x[: last + 1], states)


def test_it_ends_with_its_last_lap_and_keeps_every_time(two_laps):
    _, states = two_laps
    laps, times = states.metrics["laps"], states.pipeline_state.lap_times
    assert states.done[-1] == 1 and laps[-1] == 2 and (laps[:-1] < 2).all()
    assert times.shape == (len(laps), 2)
    first = np.argmax(laps == 1)
    assert not times[:first].any() and (times[first:-1, 1] == 0).all()
    assert times[-1].sum() == pytest.approx(len(laps) / 20, abs=0.05)
    np.testing.assert_array_equal(times[first:, 0], times[first, 0])
    assert states.metrics["last_lap_time"][-1] == times[-1, 1]
    assert states.metrics["best_lap_time"][-1] == times[-1].min() == times[-1, 1]  # begun rolling
    assert states.metrics["best_lap_time"][first - 1] == 0


def test_the_curvature_ahead_is_that_of_the_road(two_laps):
    """Bends of 40 m to the left: 10 / 40; nothing on the straights, but near where they meet."""
    env, states = two_laps
    assert env.observation_size == states.obs.shape[1] == 31
    s = states.metrics["distance"] % RING.length
    for column, ahead in ((29, 0.0), (30, 30.0)):
        at = (s + ahead) % (RING.length / 2)
        clear = (np.abs(at - 100) > 5) & (at > 5) & (at < RING.length / 2 - 5)
        expected = np.where(at > 100, 10 / 40, 0.0)
        np.testing.assert_allclose(states.obs[clear, column], expected[clear], atol=0.01)


def test_observations_lie_within_their_bounds(two_laps):
    env, states = two_laps
    low, high = env.observation_bounds
    assert np.isfinite([low, high]).all() and low.shape == high.shape == (31,)
    assert ((low <= states.obs) & (states.obs <= high)).all()
    endless = make(off_track_end=None).observation_bounds
    assert np.isfinite(endless).all() and endless[1][20] == np.finfo(np.float32).max


def test_a_penalty_is_taken_off_the_track_alone():
    plain, punished = (make(off_track_end=None, off_track_penalty=p) for p in (0.0, 0.25))
    state = jax.jit(plain.reset)(jax.random.key(0))
    step, punished_step = jax.jit(plain.step), jax.jit(punished.step)
    differences = []
    for _ in range(120):
        action = np.array([0.3, 1.0, 0.0], np.float32)
        taken = punished_step(state, action).reward
        state = step(state, action)
        differences.append((abs(state.obs[20]) > 1, float(state.reward - taken)))
    off, taken = np.array(differences).T
    assert 0 < off.sum() < len(off)
    np.testing.assert_allclose(taken, 0.25 * off, atol=1e-6)


def after(seconds, setup, speed=0.0, accelerator=0.0, brake=0.0):
    """The car, straight ahead on asphalt."""
    zero = jnp.zeros(())
    car = at_rest(zero, zero, zero)
    rolling = jnp.full(4, speed) / np.array([0.3306, 0.3306, 0.3276, 0.3276], np.float32)
    car = car.replace(velocity_x=zero + speed, wheel_speed=rolling)
    ground = jnp.full(4, 1.2), jnp.full(4, 0.001)

    def step(_, car):
        return step_car(car, zero, zero + accelerator, zero + brake, *ground, 0.0025, setup)

    return jax.lax.fori_loop(0, round(seconds / 0.0025), step, car)


@pytest.mark.parametrize(
    "setup, situation, faster",
    [
        (Setup(mass=1.5), {"accelerator": 1.0, "seconds": 4.0}, False),
        (Setup(power=1.5), {"accelerator": 1.0, "seconds": 6.0}, True),
        (Setup(power=0.5), {"accelerator": 1.0, "seconds": 6.0}, False),
        (Setup(drag=2.0), {"speed": 60.0, "seconds": 2.0}, False),
        (Setup(brakes=0.5), {"speed": 40.0, "brake": 0.2, "seconds": 1.0}, True),
        (Setup(grip=0.5), {"speed": 40.0, "brake": 1.0, "seconds": 1.0}, True),
    ],
)
def test_each_factor_does_what_its_name_says(setup, situation, faster):
    plain, changed = (after(setup=s, **situation).velocity_x for s in (Setup(), setup))
    assert (changed > plain + 0.5) if faster else (changed < plain - 0.5)


def test_drag_alone_slows_as_its_closed_form():
    r"""$\dot v = -d v^2 / m$, $v(t) = v_0 / (1 + d v_0 t / m)$, against the difference of two cars
    that have all other losses in common."""
    t, v, d = 1.0, 70.0, 0.6678
    one, two = (after(t, Setup(drag=k), speed=v).velocity_x for k in (1.0, 2.0))
    expected = v / (1 + d * v * t / MASS) - v / (1 + 2 * d * v * t / MASS)
    assert one - two == pytest.approx(expected, rel=0.1)


def test_episodes_draw_their_car():
    env = make(grip=0.8, randomize=0.25)
    draw = jax.jit(jax.vmap(lambda key: env.reset(key).pipeline_state.setup))
    setup = draw(jax.random.split(jax.random.key(0), 2_000))
    for name, about in (("grip", 0.8), ("mass", 1.0)):
        factors = np.asarray(getattr(setup, name)) / about
        assert 0.75 <= factors.min() < 0.76 and 1.24 < factors.max() <= 1.25
        assert factors.mean() == pytest.approx(1, abs=4 * 0.25 / np.sqrt(3 * 2_000))
    assert jax.eval_shape(make().reset, jax.random.key(0)).pipeline_state.setup is None
    none = drawn(jax.random.key(0), Setup(mass=2.0), 0.0)
    assert none == Setup(mass=2.0)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"max_laps": 0}, "max_laps must be above 0 or None, got 0"),
        ({"max_laps": 10**9}, "max_laps must be at most 1000, got 1000000000"),
        ({"off_track_penalty": -1.0}, "off_track_penalty must be at least 0, got -1.0"),
        ({"lookahead": (-5.0,)}, "lookahead must be distances of at least 0 m"),
        ({"grip": 0.0}, "grip must be a factor from 0.1 to 10, got 0.0"),
        ({"randomize": 1.0}, "randomize must be a share in"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)
