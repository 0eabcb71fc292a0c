"""The scripted driver drives everywhere: the proof that the tracks, the car and the sensors fit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.driving import CIRCUIT_NAMES, drawing, scripted_driver


def drive(env, steps, tracks):
    """The last state of each track's drive, and what was recorded on the way."""
    policy = scripted_driver(env.ray_angles)

    def step(state, _):
        state = env.step(state, policy(state.obs))
        now = state.pipeline_state
        return state, (now.x, now.y, now.heading, now.speed, state.done)

    def run(track):
        return jax.lax.scan(step, env.reset(jax.random.key(0), track), length=steps)

    return jax.jit(jax.vmap(run))(jnp.asarray(tracks))


@pytest.fixture(scope="module")
def laps():
    """250 s on each circuit: more than one lap of the longest."""
    env = envs.make("driving", track=CIRCUIT_NAMES)
    return env, *drive(env, 12_500, range(len(CIRCUIT_NAMES)))


def test_it_completes_laps_of_every_circuit(laps):
    env, state, (*_, done) = laps
    assert not done.any()
    lap = state.metrics["last_lap_time"]
    lengths = np.array([track.length for track in env.tracks])
    assert (state.metrics["laps"] >= 1).all()
    assert (np.asarray(state.metrics["laps"]) == state.metrics["distance"] // lengths).all()
    # Between half the speed of a point mass at the limit on the middle line and that speed.
    assert (lengths / lap > 20).all() and (lengths / lap < 55).all()
    assert not np.asarray(state.metrics["off_track"]).any()


def test_it_drives_random_circuits_and_both_sets_of_rays():
    env = envs.make("driving", track=[f"random:{k}" for k in range(6)], sensors="scr")
    state, (*_, done) = drive(env, 5000, range(6))
    assert not done.any()
    assert (state.metrics["distance"] > 2000).all()


def test_halving_the_physics_step_changes_a_drive_of_20_s_by_less_than_1_percent():
    distances, speeds = [], []
    for physics_dt in (0.0025, 0.00125):
        env = envs.make("driving", track=("road", "town"), physics_dt=physics_dt)
        state, (_, _, _, speed, _) = drive(env, 1000, range(2))
        distances.append(np.asarray(state.metrics["distance"]))
        speeds.append(np.asarray(speed))
    np.testing.assert_allclose(distances[0], distances[1], rtol=0.01)
    np.testing.assert_allclose(speeds[0], speeds[1], atol=0.01 * speeds[0].max())


def test_a_drive_is_drawn_and_animated(laps, tmp_path):
    env, _, (x, y, heading, speed, _) = laps
    i = CIRCUIT_NAMES.index("eight")
    track, positions = env.tracks[i], np.stack([x[i], y[i]], -1)
    picture, page = tmp_path / "line.png", tmp_path / "drive.html"
    drawing.draw_line(track, positions, speed[i], picture)
    drawing.animate(track, positions, heading[i], speed[i], env.dt, page)
    assert picture.read_bytes().startswith(b"\x89PNG")
    text = page.read_text(encoding="utf-8")
    assert "http" not in text and "src=" not in text  # nothing from a network
    assert text.count("</script>") == 1
    assert len(text) < 500_000
