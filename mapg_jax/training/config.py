"""Every number of a run, with its meaning; and the presets."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, cast

import envs
from envs import values
from mapg_jax.algorithms import registry
from mapg_jax.algorithms.base import Experience
from mapg_jax.algorithms.options import Options, option


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(Options):
    """One training run: what all runs have. Its algorithm brings further fields.

    `Config(algorithm="a3c", rollout_steps=20)` is of a type that has the fields of A3C too, and
    refuses those of others. The defaults are the preset `paper`.
    """

    env: str = option(
        "pendulum",
        "Environment: a name of `mapg envs`, brax:NAME, gym:NAME or playground:NAME.",
        known=envs.names,
    )
    env_options: tuple[str, ...] = option(
        (), "Options of the environment, as name=value; several values as name=[a,b]."
    )
    engine: str = option(
        "auto",
        "Physics engine: native (MuJoCo's C engine), mjx, mjx-warp, jax (pure JAX tasks), or auto.",
    )
    time_limit: int | None = option(
        None,
        "Steps after which an episode is truncated; by default that of `mapg envs`.",
        at_least=1,
    )
    truncation: Literal["bootstrap", "terminal"] = option(
        "bootstrap",
        "At the time limit: bootstrap, or treat it as an end as the 2017 code did.",
    )
    algorithm: str = option(
        "mapg",
        "What learns: mapg, which is DDPG where M = 1; another of docs/algorithms.md; or yours.",
        known=registry.names,
    )
    # Counters are int32, and so are seeds.
    seed: int = option(0, "Of every random draw of the run.", at_least=0, at_most=2**31 - 1)
    steps: int = option(
        2_000_000,
        "Environment steps, all environments together.",
        at_least=1,
        at_most=2_000_000_000,
    )
    environments: int = option(
        16, "N, environments stepped side by side; the paper had one.", at_least=1
    )
    shards: int = option(
        1,
        "S, parts of the run that can be on devices of their own, each with its environments, "
        "replay and share of the batch; S divides all three.",
        at_least=1,
    )

    normalize: bool = option(
        True, "Normalise observations by their running mean and standard deviation."
    )
    observation_clip: float = option(5.0, "Bound of normalised observations.", above=0)

    evaluate_every: int = option(
        20_000,
        "Environment steps between evaluations; rounded to whole turns of all environments.",
        at_least=1,
        host=True,
    )
    evaluation_episodes: int = option(10, "Episodes per evaluation.", at_least=1, host=True)
    evaluation_starts: Literal["fresh", "fixed"] = option(
        "fresh",
        "Starts, and draws of heads, of an evaluation: fresh ones, or those of every other one.",
        host=True,
    )
    final_episodes: int = option(
        100, "Episodes of the evaluation after training.", at_least=1, host=True
    )
    checkpoint_seconds: float = option(300.0, "Time between checkpoints.", above=0, host=True)
    checkpoints_kept: int = option(2, "Newest checkpoints kept.", at_least=1, host=True)

    if TYPE_CHECKING:  # the fields of an algorithm are known when its name is

        def __init__(self, **fields: Any): ...

    def __new__(cls, **fields: Any):
        """An instance of the type that has the algorithm's own fields, so that __init__ sets them.

        Raises:
          ValueError: if a field is none of that algorithm's.
        """
        if cls is Config:
            cls = config_type(fields.get("algorithm", cls.algorithm))
        for name in fields:
            refuse_foreign(cls, name)
        return object.__new__(cls)

    def __post_init__(self):
        """A dict of options of the environment becomes name=value.

        Raises:
          ValueError: if a value is of another type, out of bounds, or does not fit the others.
        """
        if isinstance(self.env_options, Mapping):
            written = tuple(f"{name}={value}" for name, value in self.env_options.items())
            object.__setattr__(self, "env_options", written)
        super().__post_init__()
        if self.algorithm != type(self).algorithm:
            raise ValueError(
                f"a configuration of {type(self).algorithm} cannot become one of "
                f"{self.algorithm}; make it by Config(algorithm={self.algorithm!r}, …)"
            )
        self.parsed_env_options()
        self._refuse_to_divide("environments")

    def _refuse_to_divide(self, *names: str) -> None:
        """Raises ValueError if one of those numbers is not the same in all shards."""
        for name in names:
            if (value := getattr(self, name)) % self.shards:
                nearest = max(1, round(value / self.shards)) * self.shards
                raise ValueError(
                    f"{self.shards} shards do not divide {name} = {value:,}; {nearest:,} is near"
                )

    def parsed_env_options(self) -> dict[str, Any]:
        """`env_options` as keyword arguments of `envs.make`."""
        options = {}
        for text in self.env_options:
            name, equals, value = text.partition("=")
            if not name or not equals:
                raise ValueError(
                    f"env_options are written name=value, or name=[a,b] for several values, "
                    f"got {text!r}"
                )
            if name == "engine":
                raise ValueError("the engine is no option of an environment; choose it by --engine")
            options[name] = values.read(value)
        return options

    def make_env(self, engine: str | None = None) -> envs.Env:
        """The bare environment of the run."""
        return envs.make(self.env, engine or self.engine, **self.parsed_env_options())

    def episode_steps(self) -> int:
        """The time limit in force."""
        return self.time_limit or envs.spec(self.env).time_limit

    @property
    def label(self) -> str:
        """Of its algorithm, for people: DDPG, M = 10, A3C."""
        return registry.find(self.algorithm).label(self.heads)

    @property
    def slug(self) -> str:
        """Of its algorithm, in CSV files and names of folders: ddpg, mapg, a3c."""
        return registry.find(self.algorithm).slug(self.heads)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReplayConfig(Config):
    """What learning from replay brings along."""

    updates_per_step: float = option(0.5, "Updates per environment step.", at_least=1e-5)
    learning_starts: int = option(100, "Environment steps before the first update.", at_least=0)
    replay_size: int = option(1_000_000, "C, transitions kept.", at_least=1)
    batch_size: int = option(64, "B, transitions per update.", at_least=1)
    save_replay: bool = option(
        True,
        "Save the replay with every checkpoint; a run that goes on without fills it anew.",
        host=True,
    )

    def __post_init__(self):
        super().__post_init__()
        if self.batch_size > self.replay_size:
            raise ValueError(
                f"a batch of {self.batch_size} is larger than the replay of {self.replay_size}"
            )
        if self.environments > self.replay_size:
            raise ValueError(
                f"{self.environments} environments do not fit a replay of {self.replay_size}"
            )
        self._refuse_to_divide("batch_size", "replay_size")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RolloutConfig(Config):
    """What learning from rollouts brings along."""

    rollout_steps: int = option(
        10, "n, steps of every environment between updates; N · n make a batch.", at_least=1
    )


_EXPERIENCES: Mapping[Experience, type[Config]] = {
    "replay": ReplayConfig,
    "rollouts": RolloutConfig,
}


def config_type(algorithm: str) -> type[Config]:
    """`Config` with the fields of that algorithm.

    Raises:
      ValueError: if there is no such algorithm.
    """
    return _config_type(algorithm, registry.find(algorithm))


@functools.cache
def _config_type(name: str, algorithm: Any) -> type[Config]:
    field = Config.__dataclass_fields__["algorithm"]
    own = dataclasses.field(default=name, metadata=field.metadata)
    bases = (algorithm.Options, _EXPERIENCES[algorithm.experience])
    made = dataclasses.make_dataclass(
        "Config", [("algorithm", str, own)], bases=bases, frozen=True, kw_only=True
    )
    return cast(type[Config], made)


@functools.cache  # configurations of a protocol are made by the thousand
def fields(cls: type[Config]) -> Mapping[str, dataclasses.Field]:
    """The fields that can be set, by name."""
    return {field.name: field for field in dataclasses.fields(cls) if field.init}


def owners_of(name: str) -> str:
    """The algorithms whose runs have that field, as a phrase; empty if there are none."""
    return _phrase([x for x in registry.names() if name in fields(config_type(x))])


def _phrase(names: Sequence[str]) -> str:
    *others, last = names or [""]
    return f"{', '.join(others)} and {last}" if others else last


def refuse_foreign(cls: type[Config], name: str) -> None:
    """Raises ValueError, which says whose it is, if a configuration has no such field."""
    if name in fields(cls):
        return
    if owners := owners_of(name):
        raise ValueError(f"{name} is an option of {owners}, not of {cls.algorithm}")
    raise ValueError(f"{name} is no option of a run; {cls.algorithm} has {', '.join(fields(cls))}")


Preset = Literal["paper", "diverse", "reference", "parallel", "smoke"]
PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    # The paper's, with heads that stay apart, for the algorithms that have rules for it.
    "diverse": {},
    "reference": {
        # What published settings share; what each algorithm adds stands in its own file.
        "steps": 1_000_000,
        "environments": 1,
        "updates_per_step": 1.0,
        "batch_size": 256,
        "hidden": (256, 256),
        "layer_norm": False,
        "normalize": False,
    },
    "parallel": {
        # Thousands of environments on an accelerator, 16 samples per environment step (Li et al.
        # 2023); what each algorithm adds stands in its own file.
        "steps": 50_000_000,
        "environments": 4096,
        "updates_per_step": 8 / 4096,
        "learning_starts": 4096 * 32,
        "replay_size": 2_000_000,
        "batch_size": 8192,
        "hidden": (256, 256),
        "evaluate_every": 2_000_000,
        "evaluation_episodes": 128,
    },
    "smoke": {
        "heads": 3,
        "steps": 2_000,
        "environments": 4,
        "replay_size": 10_000,
        "batch_size": 16,
        "hidden": (16, 16),
        "evaluate_every": 1_000,
        "evaluation_episodes": 2,
        "final_episodes": 4,
    },
}
"""By name, what differs from the defaults: the paper's set-up, the same with heads that stay apart,
published ones, one for accelerators, one that ends in seconds. An algorithm takes of it what it
has, and then its own `presets`."""

FITTED = frozenset({"parallel"})
"""Presets whose replay `mapg train` makes smaller where the device has no memory for it."""


def presets_of(algorithm: str) -> tuple[str, ...]:
    """The presets that an algorithm has: those that change what all share, and its own."""
    own = registry.find(algorithm).presets
    return tuple(x for x, shared in PRESETS.items() if x == "paper" or shared or x in own)


def preset(name: str = "paper", algorithm: str = "mapg", **changes: Any) -> Config:
    """The configuration of a preset, with some fields changed.

    Raises:
      ValueError: if there is no such preset, algorithm or field, or the algorithm has no such
        preset.
    """
    if name not in PRESETS:
        raise ValueError(f"preset must be one of {', '.join(PRESETS)}, got {name!r}")
    if name not in presets_of(algorithm):
        owners = _phrase([x for x in registry.names() if name in presets_of(x)])
        raise ValueError(f"{name} is a preset of {owners}, not of {algorithm}")
    known = fields(config_type(algorithm))
    common = {field: value for field, value in PRESETS[name].items() if field in known}
    own = registry.find(algorithm).presets.get(name, {})
    return Config(**{**common, **own, "algorithm": algorithm, **changes})
