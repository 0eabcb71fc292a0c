"""What the tasks with a point have in common: its place in the plane, goals, and their drawing."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float32

from envs.base import Action, Env, State
from envs.frames import Canvas, Painter, Picture
from envs.points.drawing import Plane, animate, draw
from envs.recording import Episode, Player


class Point(Env):
    """A point that is moved through a plane; the physics state and the observation are its place.

    What a task says of itself: `start`, `move` and `payoff`, and the fields below.
    """

    goals: Float32[np.ndarray, "G 2"]
    radius: float
    """An episode ends nearer than this to a goal."""
    plane: Plane
    """What is drawn below the paths."""

    action_high = np.ones(2, np.float32)

    @property
    def observation_bounds(  # pyright: ignore[reportIncompatibleVariableOverride]
        self,
    ) -> tuple[np.ndarray, np.ndarray]:
        return self.plane.low, self.plane.high

    @property
    def observation_size(self) -> int:
        return 2

    @property
    def action_size(self) -> int:
        return 2

    @property
    def backend(self) -> str:
        return "jax"

    def start(self, rng: jax.Array) -> Float32[Array, "2"]:
        """A place to begin at."""
        raise NotImplementedError

    def move(self, place: Float32[Array, "2"], action: Float32[Array, "2"]) -> Float32[Array, "2"]:
        """The place after a step."""
        raise NotImplementedError

    def payoff(
        self, place: Float32[Array, "2"], action: Float32[Array, "2"], goal: Float32[Array, ""]
    ) -> Float32[Array, ""]:
        """The reward of a step to `place`, which is at that goal, from 1 on, or at none (0)."""
        raise NotImplementedError

    def reset(self, rng: jax.Array) -> State:
        return self.reset_to(self.start(rng))

    def reset_to(self, place) -> State:
        """Start at a place [2]."""
        place, zero = jnp.asarray(place, jnp.float32), jnp.zeros(())
        return State(cast(Any, place), place, zero, zero, {"goal": zero}, {})

    def step(self, state: State, action: Action) -> State:
        action = self.clipped(action)
        place = self.move(jnp.asarray(state.pipeline_state), action)
        goal = self.goal_at(place)
        return state.replace(
            pipeline_state=place,
            obs=place,
            reward=self.payoff(place, action, goal),
            done=(goal > 0).astype(jnp.float32),
            metrics={**state.metrics, "goal": goal},
        )

    def goal_at(self, place: Float32[Array, "2"]) -> Float32[Array, ""]:
        """The number, from 1 on, of the goal nearer than `radius`; 0 where there is none."""
        distance = jnp.linalg.norm(place[None] - self.goals, axis=-1)
        nearest = jnp.argmin(distance)
        return jnp.where(distance[nearest] < self.radius, nearest + 1, 0).astype(jnp.float32)

    def painter(self, width: int, height: int) -> Painter:
        """The point, the goals and the walls."""
        plane = self.plane

        def paint(place: Any) -> Picture:
            canvas = Canvas(plane.low, plane.high, width, height)
            half = plane.wall_size / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
            for wall in plane.walls:
                canvas.polygon(wall + half, "#777777")
            for goal in plane.goals:
                canvas.disc(goal, plane.radius, "#7ec29b")
            canvas.disc(np.asarray(place), 0.015 * max(plane.high - plane.low), "#b3402a")
            return canvas.picture()

        return paint

    def render(self, episodes: Sequence[Episode], player: Player, folder: Path) -> list[Path]:
        """The paths over the critic's values as paths.png, and moving as paths.html."""
        picture, animation = folder / "paths.png", folder / "paths.html"
        draw(self.plane, episodes, player, picture)
        animate(self.plane, episodes, player, animation)
        return [picture, animation]
