"""Nonsense is refused at once, with the numbers; presets run."""

import ast
import dataclasses
import inspect
import math
import typing

import pytest

import envs
from mapg_jax.training.config import PRESETS, Config


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"heads": 0}, "heads must be at least 1, got 0"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"seed": 2**31}, "seed must be at most 2147483647, got 2147483648"),
        ({"steps": 0}, "steps must be at least 1, got 0"),
        ({"steps": 3_000_000_000}, "steps must be at most 2000000000, got 3000000000"),
        ({"environments": 0}, "environments must be at least 1, got 0"),
        ({"updates_per_step": 0.0}, "updates_per_step must be at least 1e-05, got 0.0"),
        ({"updates_per_step": 1e-6}, "updates_per_step must be at least 1e-05, got 1e-06"),
        ({"updates_per_step": math.inf}, "updates_per_step must be finite, got inf"),
        ({"learning_starts": -1}, "learning_starts must be at least 0, got -1"),
        ({"batch_size": 0}, "batch_size must be at least 1, got 0"),
        ({"batch_size": 65, "replay_size": 64}, "a batch of 65 is larger than the replay of 64"),
        (
            {"environments": 9, "replay_size": 8, "batch_size": 1},
            "9 environments do not fit a replay of 8",
        ),
        ({"hidden": (64,)}, r"hidden must be two widths or more, .* got \(64,\)"),
        ({"hidden": (64, 0)}, r"hidden must be two widths or more, .* got \(64, 0\)"),
        ({"observation_clip": 0.0}, "observation_clip must be above 0, got 0.0"),
        ({"actor_learning_rate": 0.0}, "actor_learning_rate must be above 0, got 0.0"),
        ({"critic_learning_rate": math.nan}, "critic_learning_rate must be finite, got nan"),
        ({"critic_l2": -0.1}, "critic_l2 must be at least 0, got -0.1"),
        ({"discount": 1.0}, r"discount must be in \[0, 1\), got 1.0"),
        ({"discount": math.nan}, "discount must be finite, got nan"),
        ({"tau": 0.0}, "tau must be above 0, got 0.0"),
        ({"tau": 1.5}, "tau must be at most 1, got 1.5"),
        ({"max_gradient_norm": 0.0}, "max_gradient_norm must be above 0, got 0.0"),
        ({"noise_scale": -0.2}, "noise_scale must be at least 0, got -0.2"),
        ({"noise_scale_last": -0.2}, "noise_scale_last must be at least 0, got -0.2"),
        ({"a3c_rollout_steps": 0}, "a3c_rollout_steps must be at least 1, got 0"),
        ({"a3c_entropy_weight": -1.0}, "a3c_entropy_weight must be at least 0, got -1.0"),
        ({"a3c_actor_learning_rate": 0.0}, "a3c_actor_learning_rate must be above 0, got 0.0"),
        ({"a3c_max_gradient_norm": 0.0}, "a3c_max_gradient_norm must be above 0, got 0.0"),
        ({"time_limit": 0}, "time_limit must be at least 1, got 0"),
        ({"evaluate_every": 0}, "evaluate_every must be at least 1, got 0"),
        ({"checkpoint_seconds": 0.0}, "checkpoint_seconds must be above 0, got 0.0"),
        ({"checkpoints_kept": 0}, "checkpoints_kept must be at least 1, got 0"),
        ({"env_options": ("g",)}, "env_options are written name=value, got 'g'"),
    ],
)
def test_nonsense_is_refused_with_the_numbers(changes, message):
    with pytest.raises(ValueError, match=message):
        Config(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"algorithm": "ppo"}, "algorithm must be one of mapg, a3c, got 'ppo'"),
        ({"gradient": "al"}, "gradient must be one of stored, resampled, all, got 'al'"),
        ({"target": "max"}, "target must be one of mean, sampled, got 'max'"),
        ({"truncation": "end"}, "truncation must be one of bootstrap, terminal, got 'end'"),
        ({"noise": "pink"}, "noise must be one of ou, gaussian, none, got 'pink'"),
    ],
)
def test_unknown_choices_are_refused(changes, message):
    """Under the tests' import hook the types would refuse them first."""
    config = object.__new__(Config)
    vars(config).update(dataclasses.asdict(Config()) | changes)
    with pytest.raises(ValueError, match=message):
        config.__post_init__()


def test_every_number_has_its_help_text():
    (cls,) = (x for x in ast.parse(inspect.getsource(Config)).body if isinstance(x, ast.ClassDef))
    for field, text in zip(cls.body, cls.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign):
            assert isinstance(text, ast.Expr), ast.unparse(field)
            assert isinstance(text.value, ast.Constant), ast.unparse(field)


def test_a_run_cannot_be_changed_by_accident():
    config = Config()
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.heads = 3
    assert hash(config) == hash(Config())


def test_options_are_read_as_python_values():
    config = Config(env_options=("g=9.81", "name=aux_1", "pair=(0.1, 2)", "on=False", "a=b=c"))
    assert config.parsed_env_options() == {
        "g": 9.81,
        "name": "aux_1",
        "pair": (0.1, 2),
        "on": False,
        "a": "b=c",
    }
    assert Config(env_options=("g=1.5",)).make_env().g == 1.5


def test_the_time_limit_is_gymnasiums_unless_it_is_given():
    assert Config(env="hopper").episode_steps() == envs.spec("hopper").time_limit == 1000
    assert Config(env="hopper", time_limit=7).episode_steps() == 7


def test_the_paper_is_the_default():
    """The numbers of the paper, and of the code it ran on where the paper gives none."""
    paper = PRESETS["paper"]
    assert paper == Config()
    assert (paper.hidden, paper.batch_size, paper.replay_size) == ((64, 64), 64, 1_000_000)
    assert (paper.actor_learning_rate, paper.critic_learning_rate) == (1e-4, 1e-3)
    assert (paper.discount, paper.tau, paper.critic_l2) == (0.99, 0.01, 1e-2)
    assert (paper.noise, paper.noise_scale, paper.layer_norm) == ("ou", 0.2, True)
    assert paper.environments * paper.updates_per_step == 8
    assert (paper.steps, paper.final_episodes) == (2_000_000, 100)


def test_presets_are_those_the_command_line_names():
    from mapg_jax.cli.main import Preset

    assert tuple(PRESETS) == typing.get_args(Preset)
