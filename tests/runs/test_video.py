"""Videos: every state beside what its heads propose; what cannot be filmed is refused."""

import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import envs
from envs import frames
from envs.driving import drawing
from envs.driving.drawing import picture_of_car
from envs.interop import brax
from mapg_jax.runs import video
from mapg_jax.runs.folder import RunFolder

RED = np.array([0xB3, 0x40, 0x2A])


def red(picture):
    """The middle of the red pixels, as x and y."""
    y, x = np.nonzero((picture == RED).all(-1))
    return np.array([x.mean(), y.mean()])


def test_a_pendulum_hangs_where_its_angle_is():
    env = envs.make("pendulum")
    paint = env.painter(260, 260)
    for angle in (0.0, 1.0, np.pi / 2, np.pi, -1.0):
        picture = paint(np.asarray(env.reset_to(angle, 0.0).pipeline_state))
        assert picture.shape == (260, 260, 3) and picture.dtype == np.uint8
        across, down = (red(picture) - 130) / 100  # 100 pixels a metre; angles turn to the left
        found = np.arctan2(-across, -down)
        assert abs((found - angle + np.pi) % (2 * np.pi) - np.pi) < 0.05


def test_a_point_is_where_it_is():
    env = envs.make("multi_goal")
    low, high = env.plane.low, env.plane.high
    paint = env.painter(300, 300)
    for place in ([0.0, 0.0], [3.0, -2.0]):
        share = (red(paint(np.array(place))) - 0.5) / 299
        expected = (np.array(place) - low) / (high - low)
        np.testing.assert_allclose([share[0], 1 - share[1]], expected, atol=0.01)


def test_a_car_is_in_the_middle_of_its_road():
    env = envs.make("driving")
    state = env.reset(envs.base.jax.random.key(0)).pipeline_state
    picture = env.painter(200, 200)(state)
    np.testing.assert_allclose(red(picture), [99.5, 99.5], atol=2)
    assert (picture == 0xC8).all(-1).mean() > 0.1  # road


def test_a_road_is_marked_so_that_a_car_is_seen_to_move():
    """A white dash of 8 m every 20 m in the middle of a straight, seen along it."""
    env = envs.make("driving")
    track = env.tracks[0]
    picture = picture_of_car(track, track.x[0], track.y[0], 0.0, 500, 500)  # 10 pixels a metre
    dashes = drawing._dashes(track)
    np.testing.assert_allclose(np.linalg.norm(dashes[:, 1] - dashes[:, 0], axis=-1), 8, rtol=0.02)
    apart = np.linalg.norm(dashes[1:3, 0] - dashes[:2, 0], axis=-1)
    np.testing.assert_allclose(apart, 20, rtol=0.02)
    ((x, y),) = np.mean(dashes[1], 0, keepdims=True) - [track.x[0], track.y[0]]
    assert (picture[round(250 - 10 * y), round(250 + 10 * x)] == 255).all()


@pytest.mark.parametrize("name", ["two_mode_bandit", "four_bump_bandit"])
def test_a_bandit_shows_the_action(name):
    env = envs.make(name)
    paint = env.painter(220, 220)  # 100 pixels for 1
    for action in ([-0.7, 0.3], [0.5, -0.5]):
        picture = paint(np.float32(action[: env.action_size]))
        np.testing.assert_allclose(red(picture)[: env.action_size] - 110,
                                   100 * np.array([action[0], -action[1]])[: env.action_size],
                                   atol=2)  # fmt: skip


def test_a_brax_environment_is_drawn_by_mujoco(monkeypatch):
    monkeypatch.setattr(brax, "mujoco_painter", lambda model, data_of, *_: data_of)
    env = envs.make("brax:inverted_pendulum")
    data = env.painter(64, 64)(SimpleNamespace(q=np.array([0.25, 0.5]), qd=np.zeros(2)))
    np.testing.assert_array_equal(data.qpos, [0.25, 0.5])
    with pytest.raises(ValueError, match="Fast has no bodies"):
        envs.make("brax:fast").painter(64, 64)


def test_a_critic_of_states_has_no_bars():
    seen = np.zeros((3, 2), np.float32)
    v = envs.Player(lambda o: None, lambda o, a: np.zeros(a.shape[:2]))
    q = envs.Player(lambda o: None, lambda o, a: a.sum(-1))
    assert not video._tells_actions_apart(v, seen, 2) and video._tells_actions_apart(q, seen, 2)
    one, other = (video.panel(np.zeros((2, 1)), np.array([1.0, 1.0]), np.zeros(1), told)
                  for told in (True, False))  # fmt: skip
    colour = [int(video.COLOURS[0][i : i + 2], 16) for i in (1, 3, 5)]
    assert (one[100:] == colour).all(-1).any() and not (other[100:] == colour).all(-1).any()


def test_marks_and_bars_are_those_of_the_heads():
    """A mark of each colour at its action, and a bar of the length of its value."""
    proposals = np.array([[-1.0, 0.5], [1.0, 0.5], [0.0, -0.5]])
    picture = video.panel(proposals, np.array([0.0, 1.0, 0.5]), np.array([0.25, 0.25]))
    lengths = []
    for colour in video.COLOURS[:3]:
        rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        y, x = np.nonzero((picture == rgb).all(-1))
        bar = y > 120  # marks are above
        lengths.append(np.ptp(x[bar]) + 1)
    assert lengths[0] < lengths[2] < lengths[1]
    np.testing.assert_allclose(lengths, [0.05 * 220, 220, 0.525 * 220], atol=3)
    marked = [np.nonzero((picture[38] == [int(c[i : i + 2], 16) for i in (1, 3, 5)]).all(-1))[0]
              for c in video.COLOURS[:3]]  # fmt: skip
    np.testing.assert_allclose([x.mean() for x in marked], [20, 240, 130], atol=1.5)


def test_a_video_has_a_frame_a_step_and_the_end(finished_run, tmp_path):
    file = video.film(finished_run, tmp_path / "video.gif", steps=7, episodes=2)
    with Image.open(file) as film:
        assert (film.n_frames, film.size) == (16, (video.SIZE + video.PANEL, video.SIZE))


def test_what_cannot_be_filmed_is_refused(finished_run, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"written as \.mp4 or \.gif, got video\.avi"):
        video.film(finished_run, tmp_path / "video.avi")
    with pytest.raises(ValueError, match="at least 1, got 0 and 1"):
        video.film(finished_run, tmp_path / "video.gif", steps=0)
    with monkeypatch.context() as context:
        context.setattr(envs.make("pendulum").__class__, "painter", envs.Env.painter)
        with pytest.raises(ValueError, match="a run of pendulum, which has no pictures"):
            video.film(RunFolder.open(finished_run.path), tmp_path / "video.gif")
    with pytest.raises(ValueError, match=r"there is no folder .*none for video\.gif"):
        video.film(finished_run, tmp_path / "none" / "video.gif")
    with pytest.raises(ValueError, match=r"gym:Pendulum-v1 has no pictures.*load_policy"):
        envs.make("gym:Pendulum-v1").painter(64, 64)
    assert not list(tmp_path.iterdir())


def test_without_a_renderer_it_says_what_to_install(monkeypatch):
    def fails(*_):
        raise RuntimeError("no display")

    monkeypatch.setattr(frames, "_renderer", fails)
    with pytest.raises(ValueError, match="libosmesa6"):
        envs.make("hopper").painter(64, 48)


def test_a_way_of_drawing_that_there_is_not_is_one_line(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "bogus")
    done = subprocess.run(
        [sys.executable, "-m", "mapg_jax", "watch", "run"], capture_output=True, text=True
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert done.stderr.startswith("mapg: MUJOCO_GL=bogus cannot be used")
