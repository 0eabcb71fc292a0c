"""Pictures of single states, for videos: MuJoCo's by its own renderer, the others drawn."""

import contextlib
import ctypes.util
import importlib
import os
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from jaxtyping import UInt8

try:
    import mujoco
    from mujoco.rendering.classic import gl_context
except Exception as error:  # imported, MuJoCo takes up OpenGL by the way that MUJOCO_GL names
    if (way := os.environ.get("MUJOCO_GL")) is None:
        raise
    raise ValueError(
        f"MUJOCO_GL={way} cannot be used ({error}): osmesa draws by software (Debian: libosmesa6), "
        "egl by a GPU, glfw on a display; unset, one that works is chosen"
    ) from error

Picture = UInt8[np.ndarray, "H W 3"]
Painter = Callable[[Any], Picture]
"""Of a physics state, `State.pipeline_state` of one instance."""

Shown = Callable[[Any, str, str], bool]
"""Shows a physics state in a window, with two columns of text; False once it is closed."""

FONT, CORNER = mujoco.mjtFontScale.mjFONTSCALE_150, mujoco.mjtGridPos.mjGRID_BOTTOMLEFT
FARTHEST = 3.5
"""Metres, of the camera: floors and rails make some models larger than what moves."""
HELP = (
    "MuJoCo cannot draw here without a display: install a software renderer (Debian: libosmesa6) "
    "and set MUJOCO_GL=osmesa, or with a GPU MUJOCO_GL=egl"
)


def mujoco_painter(
    model: mujoco.MjModel, data_of: Callable[[Any], mujoco.MjData], width: int, height: int
) -> Painter:
    """Follows the first body from the side.

    Args:
      model: what is drawn; its offscreen buffer grows to the picture's size.
      data_of: the simulation of a physics state.
      width: of a picture, in pixels.
      height: likewise.

    Raises:
      ValueError: if there is nothing to draw with.
    """
    vis = model.vis.global_
    vis.offwidth, vis.offheight = max(vis.offwidth, width), max(vis.offheight, height)
    camera = mujoco.MjvCamera()
    _follow(camera, model)
    try:
        with warnings.catch_warnings():  # asked without a display, GLFW warns beside its answer
            warnings.simplefilter("ignore")
            renderer = _renderer(model, height, width)
    except Exception as error:  # OpenGL's bindings raise many kinds
        raise ValueError(HELP) from error

    def paint(state: Any) -> Picture:
        renderer.update_scene(data_of(state), camera)
        return renderer.render().copy()

    return paint


def mujoco_viewer(
    model: mujoco.MjModel, data_of: Callable[[Any], mujoco.MjData]
) -> contextlib.AbstractContextManager[Shown]:
    """MuJoCo's own viewer, a window that is there within the block.

    Args:
      model: what is shown.
      data_of: the simulation of a physics state.

    Raises:
      ValueError: if there is no display.
    """
    import glfw

    with warnings.catch_warnings():  # as above
        warnings.simplefilter("ignore")
        if not glfw.init():  # MuJoCo would wait for its window for ever
            raise ValueError("--live needs a display; leave it out for a video")
    return _window(model, data_of)


@contextlib.contextmanager
def _window(model: mujoco.MjModel, data_of: Callable[[Any], mujoco.MjData]) -> Iterator[Shown]:
    import mujoco.viewer

    data = mujoco.MjData(model)
    with mujoco.viewer.launch_passive(
        model, data, show_left_ui=False, show_right_ui=False
    ) as window:
        with window.lock():
            _follow(window.cam, model)

        def show(state: Any, left: str, right: str) -> bool:
            if not window.is_running():
                return False
            with window.lock():
                mujoco.mj_copyData(data, model, data_of(state))
            window.set_texts((FONT, CORNER, left, right))
            window.sync()
            return True

        yield show


def _follow(camera: mujoco.MjvCamera, model: mujoco.MjModel) -> None:
    """The first body, from the side."""
    camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
    camera.trackbodyid = 1  # 0 is the world
    camera.distance = min(1.1 * model.stat.extent, FARTHEST)
    camera.elevation, camera.azimuth = -15.0, 90.0


def _renderer(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    """By the way that MUJOCO_GL names, or by one that works without a display."""
    if not os.environ.get("MUJOCO_GL") and not os.environ.get("DISPLAY"):
        # MuJoCo chose a way as it was imported, which needs a display.
        software = ctypes.util.find_library("OSMesa") is not None
        module = importlib.import_module("mujoco.osmesa" if software else "mujoco.egl")
        gl_context.GLContext = module.GLContext
    return mujoco.Renderer(model, height, width)


class Canvas:
    """A rectangle of the plane, drawn by Pillow; y points upwards."""

    def __init__(self, low: Any, high: Any, width: int, height: int):
        """Fits the rectangle between two corners into a picture."""
        from PIL import Image, ImageDraw  # slow to import

        self._low, self._high = np.asarray(low, float), np.asarray(high, float)
        self.scale = min(np.array([width, height]) / (self._high - self._low))
        self._offset = (np.array([width, height]) - self.scale * (self._high - self._low)) / 2
        self._image = Image.new("RGB", (width, height), "white")
        self._height = height
        self.draw = ImageDraw.Draw(self._image)

    def at(self, points: Any) -> list[tuple[float, float]]:
        """Points [N, 2] in pixels."""
        x, y = (self._offset + self.scale * (np.reshape(points, (-1, 2)) - self._low)).T
        return list(zip(x.tolist(), (self._height - y).tolist(), strict=True))

    def line(self, points: Any, colour: str, width: float) -> None:
        """Through points [N, 2], of a width in the plane's unit."""
        self.draw.line(self.at(points), colour, max(1, round(width * self.scale)), joint="curve")

    def polygon(self, points: Any, colour: str) -> None:
        self.draw.polygon(self.at(points), colour)

    def disc(self, centre: Any, radius: float, colour: str) -> None:
        ((x, y),), r = self.at(centre), max(2.0, radius * self.scale)
        self.draw.ellipse((x - r, y - r, x + r, y + r), colour)

    def picture(self) -> Picture:
        return np.asarray(self._image).copy()
