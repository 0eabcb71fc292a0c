"""Range finders and observations, against brute force and hand-made scenes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.driving import Driving, bank, circuits, from_segments, load_track, parse_segments, sensors

SCR = sensors.RAY_ANGLES["scr"]
TRACKS = (*circuits.NAMES, "random:1", "random:2")


def nearest_crossing(origin, angles, track, near_s):
    """m to the nearest piece of either edge, by trying all pieces within 400 m along the track.

    Beyond those the corridor cannot be seen, while a figure-eight's other leg could.
    """
    away = np.abs((track.s - near_s + track.length / 2) % track.length - track.length / 2)
    pieces = away < 400
    direction = np.stack([np.cos(angles), np.sin(angles)], -1)[:, None]  # [R, 1, 2]
    best = np.full(len(angles), bank.SIGHT)
    for edge in (track.left, track.right):
        start, end = edge[pieces], np.roll(edge, -1, 0)[pieces]
        along, to = end - start, start - origin
        # origin + t direction = start + u along
        parallel = direction[..., 0] * along[:, 1] - direction[..., 1] * along[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (to[:, 0] * along[:, 1] - to[:, 1] * along[:, 0]) / parallel
            u = (to[:, 0] * direction[..., 1] - to[:, 1] * direction[..., 0]) / parallel
        hits = (t >= 0) & (u >= 0) & (u <= 1) & np.isfinite(t)
        best = np.minimum(best, np.where(hits, t, np.inf).min(-1, initial=np.inf))
    return best


@pytest.mark.parametrize("name", TRACKS)
def test_rays_end_at_the_nearest_edge(name):
    """1e-2 m, at 2,000 poses of any heading: 38,000 rays a track."""
    track, rng = load_track(name), np.random.default_rng(1)
    n = 2000
    cell, share = rng.integers(0, len(track.s), n), rng.uniform(0.01, 0.99, n)
    across = rng.uniform(0.01, 0.99, n)
    left, right = (
        edge[cell] + share[:, None] * (np.roll(edge, -1, 0)[cell] - edge[cell])
        for edge in (track.left, track.right)
    )
    origin = (right + across[:, None] * (left - right)).astype(np.float32)
    heading = rng.uniform(-np.pi, np.pi, n).astype(np.float32)

    one = bank.make_bank([track])
    rays = jax.jit(
        jax.vmap(
            lambda cell, p, heading: sensors.range_finders(one, 0, cell, p[0], p[1], heading, SCR)
        )
    )(jnp.int32(cell), origin, heading)
    angles = heading[:, None] - np.deg2rad(SCR)
    for i in range(n):
        expected = nearest_crossing(origin[i].astype(float), angles[i], track, track.s[cell[i]])
        np.testing.assert_allclose(rays[i], expected, rtol=0, atol=1e-2)


def observe(env, s, to_left=0.0, turned=0.0):
    """The observation at a pose given along the track: m, m, rad."""

    @jax.jit
    def look(s):
        cell, x, y, heading = bank.point(env.bank, 0, s)
        x, y = x - to_left * jnp.sin(heading), y + to_left * jnp.cos(heading)
        drive = env.reset(jax.random.key(0)).pipeline_state
        car = drive.car.replace(x=x, y=y, heading=heading + turned)
        drive = drive.replace(car=car, cell=cell)
        return env._observe(drive, bank.place(env.bank, 0, cell, x, y))

    return np.asarray(look(jnp.float32(s)))


@pytest.fixture(scope="module")
def stadium():
    """Straights of 400 m, bends to the left of 50 m radius, 10 m wide."""
    segments = parse_segments("S400 L50/180 S400 L50/180")
    return Driving(from_segments("stadium", segments, 10.0), sensors="scr")


def test_signs_and_scales_on_a_straight(stadium):
    """2 m left of the middle, the car turned 0.1 rad to the right."""
    seen = observe(stadium, 100.0, to_left=2.0, turned=-0.1)
    assert seen.shape == (29,)
    assert seen[0] == pytest.approx(0.1 / np.pi, abs=1e-5)  # the track lies to its left
    assert seen[20] == pytest.approx(0.4, abs=1e-5)
    rays = 200 * seen[1:20]
    assert rays[0] == pytest.approx(3 / np.cos(0.1), abs=1e-3)  # -90 degrees is left
    assert rays[18] == pytest.approx(7 / np.cos(0.1), abs=1e-3)
    assert rays[9] == pytest.approx(7 / np.sin(0.1), abs=1e-3)
    assert not seen[21:28].any() and seen[28] == pytest.approx(0.0942, abs=1e-4)  # idle


def test_an_empty_straight_reads_200_m(stadium):
    assert observe(stadium, 50.0)[10] == 1.0


def test_a_bend_ends_the_sight_at_the_outer_edge(stadium):
    """√((R + w/2)² - R²) for a tangent from the middle, within the chords' sagitta of 5 cm, which
    a ray at this angle meets some 2.3 times further off."""
    expected = np.sqrt(55**2 - 50**2)
    assert 200 * observe(stadium, 480.0)[10] == pytest.approx(expected, abs=0.2)


def test_off_the_track_every_ray_reads_minus_1(stadium):
    seen = observe(stadium, 100.0, to_left=5.5)
    np.testing.assert_allclose(seen[1:20], -1 / 200)
    assert seen[20] == pytest.approx(1.1, abs=1e-4)


def test_the_road_that_crosses_is_not_seen():
    """In the middle of the crossing, rays to the sides end at the edges of the car's own road."""
    env = Driving("eight", sensors="scr")
    track = env.tracks[0]
    middle = np.stack([track.x, track.y], -1)
    apart = np.abs(track.s[:, None] - track.s)
    far = np.minimum(apart, track.length - apart) > 500
    meets = np.where(far, np.linalg.norm(middle[:, None] - middle, axis=-1), np.inf)
    s = track.s[np.unravel_index(np.argmin(meets), meets.shape)[0]]
    rays = 200 * observe(env, s)[1:20]
    np.testing.assert_allclose(rays[[0, 18]], track.width[0] / 2, atol=1e-3)


@pytest.mark.parametrize(
    ("sensors", "right"),
    [
        ("snakeoil", (0.5, 1, 1.7, 2.5, 4, 7, 12, 19, 45)),
        ("scr", (5, 10, 15, 20, 30, 45, 60, 75, 90)),
    ],
)
def test_rays_are_those_of_the_clients(sensors, right):
    """What a saved policy sees depends on them."""
    left = tuple(-angle for angle in right[::-1])
    assert Driving("speedway", sensors=sensors).ray_angles == (*left, 0, *right)
    if sensors == "snakeoil":
        assert Driving("speedway").ray_angles == (*left, 0, *right)
