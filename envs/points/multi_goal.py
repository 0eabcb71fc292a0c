"""Multi-goal: a point that may go to any of several goals, all equally good."""

import math
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from envs.points.drawing import Plane
from envs.points.point import Point
from envs.scored import reached

BOUND = 7.0  # the plane is [-BOUND, BOUND]²
ACTION_COST, GOAL_REWARD = 30.0, 10.0
START_SCALE = 0.1  # σ of the start, where it is drawn
GOALS = {
    "four": np.array([[5, 0], [-5, 0], [0, 5], [0, -5]], np.float32),
    "three": np.array([[5, 0], [-4, 3], [-4, -3]], np.float32),
}
RADIUS = {"four": 1.0, "three": 0.5}


class MultiGoal(Point):
    """A point that may go to any goal, of Soft Q-Learning (`four`) and of S2AC (`three`).

    action       [2] displacement; ±1 is ±1
    observation  [2] place, in [-7, 7]²
    reward       c · (-30 · ‖action‖² - min_g ‖place' - g‖², + 10 at a goal), c = reward_scale
    start        four: normal around the centre with σ = 0.1; three: the centre
    end          nearer than 1 (four) or 0.5 (three) to a goal

    Lengths have no unit. The goals are (±5, 0) and (0, ±5), numbered 1 to 4 in the order (5, 0),
    (-5, 0), (0, 5), (0, -5); with `three`, 1 to 3: (5, 0), (-4, 3), (-4, -3), so that two of them
    lie to the left.

    Args:
      goals: "four" or "three".
      reward_scale: c; Soft Q-Learning trains with 0.1.
    """

    drawn_episodes = 20
    scored_metrics = reached("goal", "goals", 4)

    def __init__(self, goals: Literal["four", "three"] = "four", reward_scale: float = 0.1):
        if goals not in GOALS:
            raise ValueError(f"unknown goals {goals!r}; known are {', '.join(GOALS)}")
        if not (reward_scale > 0 and math.isfinite(reward_scale)):
            raise ValueError(f"reward_scale must be above 0 and finite, got {reward_scale}")
        self.goals, self.radius = GOALS[goals], RADIUS[goals]
        self.scored_metrics = reached("goal", "goals", len(self.goals))
        corner = np.full(2, BOUND)
        self.plane = Plane(f"multi_goal, {goals} goals", -corner, corner, self.goals, self.radius)
        self._start_scale = START_SCALE if goals == "four" else 0.0
        self._scale = reward_scale

    def start(self, rng):
        return jnp.clip(self._start_scale * jax.random.normal(rng, (2,)), -BOUND, BOUND)

    def move(self, place, action):
        return jnp.clip(place + action, -BOUND, BOUND)

    def payoff(self, place, action, goal):
        to_goals = jnp.square(place[None] - self.goals).sum(-1)
        cost = ACTION_COST * jnp.square(action).sum() + to_goals.min()
        return self._scale * (jnp.where(goal > 0, GOAL_REWARD, 0.0) - cost)
