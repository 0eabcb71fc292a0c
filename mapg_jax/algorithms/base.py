"""What the rest of the house knows of an algorithm.

Axis letters, here and everywhere: `B` batch, `N` environments, `T` time, `M` heads (actions per
state), `D` observation, `A` action, `C` replay slots, `E` episodes, `K` anything else. `*B` is any
number of axes in front.
"""

import dataclasses
import typing
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from mapg_jax.algorithms.options import Options

Experience = Literal["replay", "rollouts"]
"""What an update learns from: a batch of stored steps, or the steps just taken."""


class Transition(NamedTuple):
    """One environment step. Leaves have axes in front: [B] from replay, [T, N] from rollouts."""

    observation: jax.Array  # [D]; raw where it is stored, normalised where an update reads it
    extra: Any  # what `explore` notes of its choice: the head that acted, say
    action: jax.Array  # [A], executed, in [-1, 1]
    reward: jax.Array  # []
    terminal: jax.Array  # [] bool, no bootstrap
    next_observation: jax.Array  # [D], before any reset; of a terminal step from replay, its own


class Rollout(NamedTuple):
    """T steps of N environments, in order."""

    steps: Transition  # leaves [T, N, ...]
    ended: jax.Array  # [T, N] bool, the next row is of another episode


class Explored(NamedTuple):
    """What an algorithm does in training, in every environment."""

    action: jax.Array  # [N, A], in [-1, 1]
    extra: Any  # leaves [N, ...], stored with the transition
    explorer: Any  # leaves [N, ...], the carry


@runtime_checkable
class Algorithm(Protocol):
    """An algorithm: its static part, and pure functions. One file, and one line in `registry`.

    All that an update changes is in a learner state (a pytree with the field `updates`, [] i32);
    all numbers that it only reads are in `Hyper`.
    """

    Options: ClassVar[Any]
    """A dataclass derived from `options.Options`: its own numbers beside what all have."""
    Hyper: ClassVar[Any]
    """A pytree of the traced numbers, `heads` ([] i32) among them, named as in `Options`: runs that
    differ in these alone can share a compiled program. For as many steps as `hold` ([] i32) says,
    if it has that number, evaluation gives `act` the same key, so that what was drawn stays."""
    Metrics: ClassVar[Any]
    """A NamedTuple of scalars that an update reports; when one of them is not finite, the run has
    diverged."""
    experience: ClassVar[Experience]
    selects: ClassVar[tuple[str, ...]]
    """The ways in which `act` can make one action of a state's proposals; runs are scored by
    `uniform`, which must be among them."""
    presets: ClassVar[Any]
    """By preset, the options in which it departs from its defaults."""

    @classmethod
    def make(cls, options: Any, action_size: int) -> "Algorithm":
        """The algorithm with those options, for actions of A numbers."""
        ...

    @classmethod
    def hyper(cls, options: Any) -> Any:
        """The traced numbers of those options; see `traced`."""
        ...

    @staticmethod
    def label(heads: int) -> str:
        """Its name in tables and pictures."""
        ...

    @staticmethod
    def slug(heads: int) -> str:
        """Its name in CSV files and names of folders."""
        ...

    def init(self, key: PRNGKeyArray, observation_size: int) -> Any:
        """A fresh learner."""
        ...

    def explorer(self, environments: int) -> Any:
        """The carry of `explore` at the start of an episode, leaves [N, ...]; () if there is none.

        It is put back for an environment whose episode has ended.
        """
        ...

    def explore(
        self,
        learner: Any,
        hyper: Any,
        explorer: Any,
        observation: Float[Array, "N D"],
        key: PRNGKeyArray,
    ) -> Explored:
        """Acts in training."""
        ...

    def act(
        self,
        learner: Any,
        hyper: Any,
        observation: Float[Array, "*B D"],
        key: PRNGKeyArray,
        select: Any,
    ) -> Float[Array, "*B A"]:
        """Acts in evaluation, in one of the ways of `selects`."""
        ...

    def proposals(
        self, learner: Any, hyper: Any, observation: Float[Array, "*B D"]
    ) -> tuple[Float[Array, "*B M A"], Float[Array, "*B M"]]:
        """The M actions proposed for a state, and the critic's value of each."""
        ...

    def q_values(
        self,
        learner: Any,
        hyper: Any,
        observation: Float[Array, "*B D"],
        actions: Float[Array, "*B K A"],
    ) -> Float[Array, "*B K"]:
        """The critic's values of any K actions a state; V(s) where it values states alone."""
        ...

    def update(self, learner: Any, hyper: Any, batch: Any, key: PRNGKeyArray) -> tuple[Any, Any]:
        """One update.

        Args:
          learner: its state.
          hyper: its numbers.
          batch: a `Transition` with leaves [B, ...], or a `Rollout`; observations are normalised.
          key: for what it draws.
        """
        ...


def traced(hyper: type, options: Options, **numbers: float | None) -> Any:
    """The `Hyper` of some options: float32, and int32 where the option is whole.

    Args:
      hyper: its type.
      options: have a number for each of its fields,
      numbers: but for these.
    """
    hints = typing.get_type_hints(type(options))

    def number(name: str) -> jax.Array:
        value = numbers.get(name, getattr(options, name))
        kinds = typing.get_args(hints[name]) or (hints[name],)
        return jnp.asarray(value, jnp.float32 if float in kinds else jnp.int32)

    return hyper(**{field.name: number(field.name) for field in dataclasses.fields(hyper)})
