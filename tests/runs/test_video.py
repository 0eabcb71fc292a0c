"""Videos: every state beside what its heads propose; what cannot be filmed is refused."""

import numpy as np
import pytest
from PIL import Image

import envs
from envs import frames
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


def test_a_video_has_a_frame_a_step(finished_run, tmp_path):
    file = video.film(finished_run, tmp_path / "video.gif", steps=7, episodes=2)
    with Image.open(file) as film:
        assert (film.n_frames, film.size) == (14, (video.SIZE + video.PANEL, video.SIZE))


def test_what_cannot_be_filmed_is_refused(finished_run, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"written as \.mp4 or \.gif, got video\.avi"):
        video.film(finished_run, tmp_path / "video.avi")
    with pytest.raises(ValueError, match="at least 1, got 0 and 1"):
        video.film(finished_run, tmp_path / "video.gif", steps=0)
    with monkeypatch.context() as context:
        context.setattr(envs.make("pendulum").__class__, "painter", envs.Env.painter)
        with pytest.raises(ValueError, match="a run of pendulum, which has no pictures"):
            video.film(RunFolder.open(finished_run.path), tmp_path / "video.gif")
    assert not list(tmp_path.iterdir())


def test_without_a_renderer_it_says_what_to_install(monkeypatch):
    def fails(*_):
        raise RuntimeError("no display")

    monkeypatch.setattr(frames, "_renderer", fails)
    with pytest.raises(ValueError, match="libosmesa6"):
        envs.make("hopper").painter(64, 48)
