"""Bandits: one action an episode, and a reward with several optima."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32

from envs.bandits.drawing import draw_line, draw_plane, paint_line, paint_plane
from envs.base import Action, Env, State
from envs.frames import Painter
from envs.recording import Episode, Player
from envs.scored import reached

NEAR = 0.05
"""An action lies at an optimum within this distance, a fortieth of an action's range."""


class Bandit(Env):
    r"""One step, paid $r(a) = \max_i h_i - \frac{\lVert a - c_i \rVert^2}{2 \sigma_i^2}$ (RPG).

    action       [A] what is paid for; ±1 is ±1
    observation  [A] 0.5 each at the start, as published; then the action
    reward       r(a); each centre c_i is an optimum, worth h_i
    start        always the same
    end          after one step
    """

    name: ClassVar[str]
    optima: ClassVar[Float32[np.ndarray, "K A"]]
    """The centres c_i."""
    heights: ClassVar[Float32[np.ndarray, "K"]]
    widths: ClassVar[Float32[np.ndarray, "K"]]
    """The σ_i."""

    observation_bounds = (-1.0, 1.0)
    drawn_episodes = 100

    @property
    def action_high(self) -> np.ndarray:  # pyright: ignore[reportIncompatibleVariableOverride]
        return np.ones(self.action_size, np.float32)

    @property
    def observation_size(self) -> int:
        return self.action_size

    @property
    def action_size(self) -> int:
        return self.optima.shape[1]

    @property
    def backend(self) -> str:
        return "jax"

    def bumps(self, action: Float[Array, "A"]) -> Float[Array, "K"]:
        """What each bump would pay."""
        squares = jnp.square(action[None] - self.optima).sum(-1)
        return -squares / (2 * self.widths**2) + self.heights

    def payoff(self, action: Float[Array, "A"]) -> Float[Array, ""]:
        """r(a)."""
        return self.bumps(action).max()

    def optimum_at(self, action: Float[Array, "A"]) -> Float[Array, ""]:
        """The number, from 1 on, of the optimum that pays for the action, if it is near; else 0."""
        i = jnp.argmax(self.bumps(action))
        distance = jnp.linalg.norm(action - jnp.asarray(self.optima)[i])
        return jnp.where(distance <= NEAR, i + 1, 0).astype(jnp.float32)

    def reset(self, rng: jax.Array) -> State:
        place, zero = jnp.full(self.action_size, 0.5), jnp.zeros(())
        return State(cast(Any, place), place, zero, zero, {"optimum": zero}, {})

    def step(self, state: State, action: Action) -> State:
        action = self.clipped(action)
        return state.replace(
            pipeline_state=action,
            obs=action,
            reward=self.payoff(action),
            done=jnp.ones(()),
            metrics={**state.metrics, "optimum": self.optimum_at(action)},
        )

    def painter(self, width: int, height: int) -> Painter:
        """What actions are worth, and the state as a disc: the start, then the action."""
        if self.action_size == 1:
            return paint_line(self._payoffs, self.optima, width, height)
        return paint_plane(self.optima, self.heights, self.widths, width, height)

    def render(self, episodes: Sequence[Episode], player: Player, folder: Path) -> list[Path]:
        """Reward, critic's values and proposals over the actions as actions.png."""
        picture = folder / "actions.png"
        draw = draw_line if self.action_size == 1 else draw_plane
        draw(self.name, self._payoffs, self.optima, episodes, player, picture)
        return [picture]

    def _payoffs(self, actions: Float[np.ndarray, "*N A"]) -> Float[np.ndarray, "*N"]:
        return np.asarray(jnp.vectorize(self.payoff, signature="(a)->()")(actions))


class TwoModeBandit(Bandit):
    """Two optima on a line, both worth 0: a broad one and a narrow one."""

    name = "two_mode_bandit"
    optima = np.array([[-0.6], [0.6]], np.float32)
    heights = np.zeros(2, np.float32)
    widths = np.sqrt(np.array([1 / 2, 1 / 6], np.float32))
    scored_metrics = reached("optimum", "optima", 2)


class FourBumpBandit(Bandit):
    """Four optima in a plane, nearly equal; the best is far from the others."""

    name = "four_bump_bandit"
    optima = np.array([[-0.2, 0], [-0.15, 0], [0.15, 0], [0.7, 0]], np.float32)
    heights = np.array([0.21, 0.21, 0.20, 0.23], np.float32)
    widths = np.full(4, 0.08, np.float32)
    scored_metrics = reached("optimum", "optima", 4)
