"""The driving environment: its contract, episodes, rewards, ends and metrics."""

import functools
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import scipy.stats

import envs
from envs.driving import Drive, Driving, from_segments, parse_segments, scripted_driver
from envs.driving.env import controls

KEY = jax.random.key(0)
NO_ENDS = {"off_track_end": None, "backwards_end": None, "slow_end": None}
STADIUM = from_segments("stadium", parse_segments("S200 L50/180 S400 L50/180 S200"), 12.0)


@functools.cache
def make(**options) -> Driving:
    return cast(Driving, envs.make("driving", **options))


@functools.cache
def programs(env):
    return jax.jit(env.reset), jax.jit(env.step)


def roll(env, state, policy, steps):
    """States over time [T, ...], as NumPy arrays; policy(observation, t)."""
    _, step = programs(env)
    states = []
    for t in range(steps):
        state = step(state, np.asarray(policy(state.obs, t), np.float32))
        states.append(state)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *states)


def play(env, actions):
    """States over time from a reset under actions [T, 3]."""
    return roll(env, programs(env)[0](KEY), lambda _, t: actions[t], len(actions))


def constant(steps, *action):
    return np.tile(np.array(action, np.float32), (steps, 1))


@pytest.fixture(scope="module")
def driven():
    """90 s of the scripted driver round the stadium: two laps and a bit."""
    env = make(track=STADIUM)
    policy = jax.jit(scripted_driver(env.ray_angles))
    return env, roll(env, programs(env)[0](KEY), lambda obs, t: policy(obs), 4500)


def test_an_episode_is_drawn(driven, player, tmp_path):
    env, states = driven
    episode = envs.Episode(states.pipeline_state, states.obs, np.zeros((4499, 3)))
    picture, animation = env.render([episode], player(np.zeros((1, 3)), None), tmp_path)
    assert (picture.name, animation.name) == ("drive.png", "drive.html")
    assert sorted(tmp_path.iterdir()) == [animation, picture]
    assert picture.read_bytes().startswith(b"\x89PNG")
    drive = states.pipeline_state
    last_drawn = [round(float(values[-2]), 3) for values in (drive.x, drive.y)]  # each second one
    assert ",".join(map(str, last_drawn)) in animation.read_text(encoding="utf-8")


def test_the_contract():
    env = make()
    assert (env.observation_size, env.action_size, env.backend, env.dt) == (29, 3, "jax", 0.02)
    last = {"distance": [10.0, 40.0, 130.0], "laps": [0.0, 1.0, 3.0]}  # of three episodes
    scores = {scored.name: scored.over(last[scored.metric]) for scored in env.scored_metrics}
    assert scores == {"distance_mean": 60.0, "laps_mean": 4 / 3, "lap_share": 2 / 3}
    assert env.action_high.dtype == np.float32 and (env.action_high == 1).all()
    assert envs.spec("driving").engines == ("jax",)
    state = jax.eval_shape(env.reset, KEY)
    assert state.obs.shape == (29,) and state.obs.dtype == jnp.float32
    after = jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((3,), jnp.float32))
    assert jax.tree.map(lambda x: (x.shape, x.dtype), state) == jax.tree.map(
        lambda x: (x.shape, x.dtype), after
    )


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        ((0, 0, 0), (0, 0.5, 0)),  # a fresh actor: half throttle and no brake
        ((1, 1, 1), (1, 1, 1)),
        ((-1, -1, -1), (-1, 0, 0)),
        ((0.5, -0.5, 0.5), (0.5, 0.25, 0.5)),
        ((7, -7, 7), (1, 0, 1)),
        ((np.nan, np.nan, np.nan), (0, 0.5, 0)),
        ((np.inf, -np.inf, -np.inf), (1, 0, 0)),
    ],
)
def test_actions(action, expected):
    np.testing.assert_array_equal(jnp.stack(controls(make().clipped(action))), expected)


def test_a_fresh_actor_drives_off():
    states = play(make(), constant(250, 0, 0, 0))
    assert states.metrics["speed"][-1] > 60  # km/h after 5 s
    assert not states.done.any()


def test_plus_1_steers_left():
    states = play(make(**NO_ENDS), [*constant(100, 0, 1, 0), *constant(25, 0.2, 0, 0)])
    assert states.pipeline_state.heading[-1] > 0.1
    assert states.obs[-1, 0] < 0 < states.obs[-1, 20]


def test_rewards_are_what_the_observation_says():
    """On a drive that swerves off the track; float32 angles leave 1e-3 km/h."""
    names = ("progress", "progress_kmh", "gym_torcs", "ddpg_keras")
    steps = [make(reward=name, **NO_ENDS).step for name in names]
    rewards_of = jax.jit(lambda state, action: [step(state, action).reward for step in steps])
    env = make(**NO_ENDS)
    reset, step = programs(env)
    state = reset(KEY)
    for t in range(400):
        action = np.array([0.3 * np.sin(t / 20), 1, -1], np.float32)
        rewards = rewards_of(state, action)
        state = step(state, action)
        angle, position, v = np.pi * state.obs[0], state.obs[20], 300 * state.obs[21]
        progress = v * np.cos(angle)
        expected = (
            progress / 300,
            progress,
            -1 if abs(position) > 1 else progress,
            progress - abs(v * np.sin(angle)) - v * abs(position),
        )
        np.testing.assert_allclose(rewards, expected, rtol=1e-4, atol=1e-3)
    assert abs(state.obs[20]) > 1


def test_the_default_reward_is_at_most_about_1(driven):
    _, states = driven
    assert states.reward.min() >= 0 and states.reward.max() < 1


def first_end(states):
    return int(np.argmax(states.done)) if states.done.any() else None


def test_it_ends_off_the_track():
    steer_off = constant(300, 0.3, 0.5, 0)
    ended = play(make(), steer_off)
    step = first_end(ended)
    assert abs(ended.obs[step, 20]) > 1 >= np.abs(ended.obs[:step, 20]).max()
    assert first_end(play(make(**NO_ENDS), steer_off)) is None


def test_each_end_has_its_constant():
    """1.2 of the half width, 60 degrees, and 4 s below 30 km/h: each ends a drive of its own."""
    env = make(off_track_end=1.2, backwards_end=60.0, slow_end=30.0, slow_time=4.0)
    off = play(env, constant(300, 0.1, 0.5, 0))
    step = first_end(off)
    assert abs(off.obs[step, 20]) > 1.2 >= np.abs(off.obs[:step, 20]).max()
    turned = play(env, [*constant(100, 0, 1, 0), *constant(200, 1, 1, 0)])
    step = first_end(turned)
    assert abs(turned.obs[step, 0]) > 1 / 3 >= np.abs(turned.obs[:step, 0]).max()
    assert first_end(play(env, constant(250, 0, -1, 0))) == 199


def test_it_ends_without_progress_for_10_s_on_end():
    waiting = constant(700, 0, -1, 0)
    assert first_end(play(make(), waiting)) == 499
    # A second above 5 km/h begins the count again.
    moving = np.concatenate([waiting[:400], constant(50, 0, 0.5, 0), constant(300, 0, -1, 1)])
    assert first_end(play(make(), moving)) is None


def test_nothing_but_the_task_ends_it(driven):
    assert not driven[1].done.any()


def test_distance_laps_and_lap_time(driven):
    """The lap time is that of the crossing between two control steps, to a tenth of a step."""
    env, states = driven
    distance = np.asarray(states.metrics["distance"])
    length = STADIUM.length
    assert (np.diff(distance) >= 0).all() and distance[-1] > 2 * length
    np.testing.assert_array_equal(states.metrics["laps"], distance // length)
    times = np.interp([length, 2 * length], distance, env.dt * np.arange(1, 4501))
    for lap, expected in ((1, times[0]), (2, times[1] - times[0])):
        first = np.argmax(np.asarray(states.metrics["laps"]) == lap)
        assert states.metrics["last_lap_time"][first - 1] != states.metrics["last_lap_time"][first]
        assert states.metrics["last_lap_time"][first] == pytest.approx(expected, abs=0.002)


def test_distance_is_progress_integrated(driven):
    """Along the middle, on which the driver stays within 2 m of 50: 2 % in bends."""
    env, states = driven
    integral = np.cumsum(states.reward) * 300 / 3.6 * env.dt
    np.testing.assert_allclose(states.metrics["distance"], integral, rtol=0.02, atol=1.0)


def test_backwards_over_the_line_is_no_lap():
    env = make(**NO_ENDS)
    state = programs(env)[0](KEY)
    turned = state.pipeline_state.car.replace(heading=jnp.float32(np.pi))
    state = state.replace(pipeline_state=state.pipeline_state.replace(car=turned))
    metrics = roll(env, state, lambda *_: (0, 0, 0), 100).metrics
    assert metrics["distance"][-1] < -5
    assert not metrics["laps"].any() and not metrics["last_lap_time"].any()


def test_off_track_share():
    states = play(make(**NO_ENDS), constant(300, 0.3, 0.5, 0))
    off = np.abs(states.obs[:, 20]) > 1
    expected = np.cumsum(off) / np.arange(1, 301)
    np.testing.assert_allclose(states.metrics["off_track"], expected, rtol=1e-6)


def test_grass_holds_less_than_asphalt():
    """Full brakes beside the track: friction 0.4 / 1.2 of that on it."""

    env = make(**NO_ENDS)

    def stop(to_left):
        state = programs(env)[0](KEY)
        car = state.pipeline_state.car.replace(
            y=jnp.float32(to_left), velocity_x=jnp.float32(15.0), wheel_speed=jnp.full(4, 45.5)
        )
        state = state.replace(pipeline_state=state.pipeline_state.replace(car=car))
        return 15.0 - float(roll(env, state, lambda *_: (0, -1, 1), 20).pipeline_state.speed[-1])

    # 10 %: less load transfer on grass, and rolling resistance of 0.01.
    assert stop(12.0) == pytest.approx(stop(0.0) / 3, rel=0.1)


def test_a_bank_drives_like_its_tracks():
    """A batch with another track in each instance; the same numbers as on the track alone."""
    bank, alone = make(track=("speedway", "town", "eight")), make(track="town")
    swerve = np.stack([0.05 * np.sin(np.arange(150) / 9), np.ones(150), -np.ones(150)], -1)
    states = jax.jit(jax.vmap(bank.reset))(jax.random.split(KEY, 3), jnp.arange(3))
    step = jax.jit(jax.vmap(bank.step, (0, None)))
    for expected in play(alone, swerve).obs:
        states = step(states, np.float32(swerve[int(states.pipeline_state.steps[0])]))
        np.testing.assert_allclose(states.obs[1], expected, rtol=0, atol=1e-4)
    np.testing.assert_array_equal(states.pipeline_state.track, [0, 1, 2])
    assert len(np.unique(states.obs[:, 10])) == 3


def test_a_reset_draws_a_track_or_takes_one():
    """Any of them, without compiling again."""
    env = make(track=("speedway", "town", "eight"))
    drawn = jax.jit(jax.vmap(env.reset))(jax.random.split(KEY, 64)).pipeline_state.track
    assert set(np.asarray(drawn)) == {0, 1, 2}
    compiled = []

    @jax.jit
    def reset(track):
        compiled.append(track)
        return cast(Drive, env.reset(KEY, track).pipeline_state).track

    assert [int(reset(i)) for i in range(3)] == [0, 1, 2] and len(compiled) == 1
    with pytest.raises(ValueError, match="track must be an index below 3, got 3"):
        env.reset(KEY, track=3)


def test_starts_anywhere_are_uniform_along_the_middle():
    """p < 1e-6 comes once in a million runs, and the keys are fixed."""
    env = make(track="town", start="anywhere")
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(KEY, 1000))
    length = env.tracks[0].length
    uniform = scipy.stats.uniform(0, length)
    assert scipy.stats.kstest(states.pipeline_state.start, uniform.cdf).pvalue > 1e-6
    # On the chords of the middle line, whose heading turns along the cell.
    np.testing.assert_allclose(states.obs[:, 20], 0, atol=0.02)
    np.testing.assert_allclose(states.obs[:, 0], 0, atol=0.02)
    assert (states.metrics["distance"] == 0).all() and not states.obs[:, 21:28].any()


def test_starts_at_the_line_by_default():
    drive = programs(make())[0](KEY).pipeline_state
    assert drive.x == drive.y == drive.heading == drive.speed == drive.start == 0


def test_episodes_reset_what_ended_and_nothing_else():
    env = envs.with_episodes(make(), 150)
    keys = jax.random.split(KEY, 4)
    actions = jnp.float32([[0.3, 0.5, 0], [0, 0.2, 0], [-0.3, 0.5, 0], [0, 1, -1]])

    step, reset = (
        jax.jit(jax.vmap(function), compiler_options=oracles.AS_IN_TRAINING)
        for function in (env.step, env.reset)
    )
    start = state = reset(keys)
    states = []
    for _ in range(150):
        state = step(state, actions)
        states.append(state.replace(info={k: v for k, v in state.info.items() if k != "key"}))
    states = jax.tree.map(lambda *leaves: np.stack(leaves), *states)
    terminated = np.asarray(states.info["terminated"])
    assert terminated[:, [0, 2]].sum() >= 2 and not terminated[:, [1, 3]].any()
    assert not states.info["truncated"][:-1].any()
    assert states.info["truncated"][-1].tolist() == [False, True, False, True]
    t = np.argmax(terminated[:, 0])
    np.testing.assert_array_equal(states.obs[t, 0], start.obs[0])
    assert abs(states.info["final_observation"][t, 0, 20]) > 1
    assert states.pipeline_state.steps[t, 0] == 0


def test_actions_that_are_no_numbers_touch_nobody_else():
    env = make(**NO_ENDS)
    rng = np.random.default_rng(0)
    clean = rng.uniform(-1, 1, (100, 8, 3)).astype(np.float32)
    spoilt = clean.copy()
    spoilt[10:, 2] = rng.choice([np.nan, np.inf, -np.inf], (90, 3))
    step = jax.jit(jax.vmap(env.step))
    states = touched = jax.jit(jax.vmap(env.reset))(jax.random.split(KEY, 8))
    others = np.arange(8) != 2
    for t in range(100):
        states, touched = step(states, clean[t]), step(touched, spoilt[t])
        assert np.isfinite(touched.obs).all() and np.isfinite(touched.reward).all()
        np.testing.assert_array_equal(states.obs[others], touched.obs[others])


def test_any_actions_keep_it_finite():
    """Over grass, backwards and round in circles, wherever they lead in 20 s."""
    env = make(track=("town", "eight"), control_hz=5, **NO_ENDS)
    values = jnp.array([-1.0, -0.2, 0.0, 0.4, 1.0])
    actions = jax.random.choice(jax.random.key(5), values, (100, 32, 3))

    @jax.jit
    def run(keys):
        def step(state, action):
            state = jax.vmap(env.step)(state, action)
            return state, (state.obs, state.reward, state.metrics)

        return jax.lax.scan(step, jax.vmap(env.reset)(keys), actions)[1]

    obs, reward, metrics = run(jax.random.split(KEY, 32))
    for leaf in jax.tree.leaves((obs, reward, metrics)):
        assert np.isfinite(leaf).all()
    assert (np.abs(obs[..., 0]) <= 1).all()
    rays = obs[..., 1:20]
    assert (((rays >= 0) & (rays <= 1)) | (rays == -1 / 200)).all()


def test_the_control_rate_leaves_the_physics_alone():
    """Two seconds of full throttle are the same drive, however often they are asked for."""
    ends = [
        play(make(control_hz=hz, **NO_ENDS), constant(2 * hz, 0, 1, 0)).pipeline_state
        for hz in (5, 50, 400)
    ]
    for end in ends[1:]:
        np.testing.assert_allclose(end.x[-1], ends[0].x[-1], rtol=1e-5)
        np.testing.assert_allclose(end.speed[-1], ends[0].speed[-1], rtol=1e-5)
    assert np.hypot(end.x[-1] - end.x[0], end.y[-1] - end.y[0]) > 5  # m


def test_the_work_of_a_step_does_not_depend_on_the_length_of_the_track():
    """Four times the length, of the same bends: the same program but for the table's size."""

    def flops(chicanes):
        side = chicanes * "S100 L60/40 R60/80 L60/40 " + "S100 L60/90 "
        track = from_segments("square", parse_segments(4 * side), 12.0)
        env = make(track=track)
        state = jax.eval_shape(jax.vmap(env.reset), jax.random.split(KEY, 16))
        actions = jax.ShapeDtypeStruct((16, 3), jnp.float32)
        lowered = jax.jit(jax.vmap(env.step)).lower(state, actions)
        return track.length, env.bank.reach, (lowered.cost_analysis() or {})["flops"]

    (short, short_reach, short_work), (long, long_reach, long_work) = flops(1), flops(6)
    assert long > 3.5 * short
    assert (long_reach, long_work) == (short_reach, short_work)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"track": "speedwy"}, r"unknown track 'speedwy'; known are speedway, road"),
        ({"track": ()}, r"track must name at least one track, got none"),
        ({"reward": "fast"}, r"unknown reward 'fast'; known are progress, progress_kmh, gym_torcs"),
        ({"sensors": "lidar"}, r"unknown sensors 'lidar'; known are snakeoil, scr"),
        ({"start": "pits"}, r"unknown start 'pits'; known are line, anywhere"),
        ({"control_hz": 30}, r"1/30 s is not a whole number of physics steps of 0\.0025 s"),
        ({"control_hz": 0}, r"control_hz must be above 0 and physics_dt in \(0, 0\.005\] s"),
        ({"physics_dt": 0.01}, r"physics_dt in \(0, 0\.005\] s, got 50\.0 and 0\.01"),
        ({"off_track_end": -1}, r"off_track_end must be above 0 or None, got -1"),
        ({"speed": 1}, r"driving has no option 'speed'; it has track, control_hz, reward"),
    ],
)
def test_bad_input_is_named(options, message):
    with pytest.raises(ValueError, match=message):
        envs.make("driving", **options)
