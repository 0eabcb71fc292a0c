"""Nonsense is refused at once, with the numbers; fields are those of the algorithm; presets."""

import dataclasses
import math
import typing

import pytest

import envs
from mapg_jax.algorithms import registry
from mapg_jax.algorithms.a3c import A3cOptions
from mapg_jax.training.config import (
    PRESETS,
    Config,
    ReplayConfig,
    RolloutConfig,
    config_type,
    fields,
    preset,
    presets_of,
)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"heads": 0}, "heads must be at least 1, got 0"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"heads": 2**31}, "heads must be at most 2147483647, got 2147483648"),
        ({"hidden": (64, 10**30)}, "hidden must be at most 2147483647, got a number of more than"),
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
        ({"time_limit": 0}, "time_limit must be at least 1, got 0"),
        ({"evaluate_every": 0}, "evaluate_every must be at least 1, got 0"),
        ({"checkpoint_seconds": 0.0}, "checkpoint_seconds must be above 0, got 0.0"),
        ({"checkpoints_kept": 0}, "checkpoints_kept must be at least 1, got 0"),
        ({"env_options": ("g",)}, "env_options are written name=value, or .*, got 'g'"),
    ],
)
def test_nonsense_is_refused_with_the_numbers(changes, message):
    with pytest.raises(ValueError, match=message):
        Config(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rollout_steps": 0}, "rollout_steps must be at least 1, got 0"),
        ({"entropy_weight": -1.0}, "entropy_weight must be at least 0, got -1.0"),
        ({"actor_learning_rate": 0.0}, "actor_learning_rate must be above 0, got 0.0"),
        ({"critic_learning_rate": math.inf}, "critic_learning_rate must be finite, got inf"),
        ({"max_gradient_norm": 0.0}, "max_gradient_norm must be above 0, got 0.0"),
        ({"discount": 1.0}, r"discount must be in \[0, 1\), got 1.0"),
    ],
)
def test_nonsense_is_refused_of_a3c_as_well(changes, message):
    with pytest.raises(ValueError, match=message):
        Config(algorithm="a3c", **changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"algorithm": "a4c"},
            f"algorithm must be one of {', '.join(registry.names())}, got 'a4c'",
        ),
        ({"gradient": "al"}, "gradient must be one of stored, resampled, all, got 'al'"),
        ({"target": "best"}, "target must be one of mean, sampled, max, got 'best'"),
        ({"truncation": "end"}, "truncation must be one of bootstrap, terminal, got 'end'"),
        ({"noise": "pink"}, "noise must be one of ou, gaussian, none, got 'pink'"),
    ],
)
def test_unknown_choices_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Config(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"heads": 3.0}, "heads must be int, got 3.0"),
        ({"heads": True}, "heads must be int, got True"),
        ({"heads": "3"}, "heads must be int, got '3'"),
        ({"tau": "0.1"}, "tau must be float, got '0.1'"),
        ({"normalize": 1}, "normalize must be bool, got 1"),
        ({"hidden": 64}, r"hidden must be tuple\[int, ...\], got 64"),
        ({"hidden": (64, 0.5)}, r"hidden must be tuple\[int, ...\], got \(64, 0.5\)"),
        ({"time_limit": 0.5}, r"time_limit must be int \| None, got 0.5"),
        ({"env": None}, "env must be str, got None"),
    ],
)
def test_values_of_another_type_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Config(**changes)


# ----- the fields of an algorithm


def test_a_run_has_what_all_have_and_what_its_algorithm_brings():
    for name, options, other in (
        ("mapg", registry.find("mapg").Options, RolloutConfig),
        ("a3c", A3cOptions, ReplayConfig),
    ):
        cls = type(Config(algorithm=name))
        assert cls is config_type(name)
        assert issubclass(cls, (Config, options))
        assert not issubclass(cls, other)
    assert {"rollout_steps", "entropy_weight"} <= fields(config_type("a3c")).keys()
    assert not {"tau", "noise", "replay_size", "heads"} & fields(config_type("a3c")).keys()
    assert not {"rollout_steps", "entropy_weight"} & fields(config_type("mapg")).keys()


def owners(name: str) -> str:
    """The algorithms that have an option, as a sentence lists them."""
    *several, last = [x for x in registry.names() if name in fields(config_type(x))]
    return f"{', '.join(several)} and {last}"


@pytest.mark.parametrize(
    ("algorithm", "name", "message"),
    [
        *[
            ("a3c", name, f"{name} is an option of {owners(name)}, not of a3c")
            for name in ("tau", "heads", "batch_size")
        ],
        ("mapg", "rollout_steps", "rollout_steps is an option of a3c, ppo and trpo, not of mapg"),
        ("mapg", "entropy_weight", "entropy_weight is an option of a3c, not of mapg"),
        ("mapg", "stepz", "stepz is no option of a run; mapg has .*steps"),
    ],
)
def test_fields_of_another_algorithm_say_whose_they_are(algorithm, name, message):
    for make in (Config, preset):
        with pytest.raises(ValueError, match=message):
            make(algorithm=algorithm, **{name: 1})


def test_equal_runs_are_equal_configurations():
    """However they are written; and runs of two algorithms are never one."""
    one = Config(hidden=[8, 8], env_options={"g": 9.81})
    assert one == Config(algorithm="mapg", hidden=(8, 8), env_options=("g=9.81",))
    assert hash(one) == hash(Config(hidden=(8, 8), env_options=["g=9.81"]))
    assert one != dataclasses.replace(one, hidden=(8, 9))
    assert Config(algorithm="a3c") == Config(algorithm="a3c", rollout_steps=10)
    assert Config(algorithm="a3c") != Config(heads=1)
    assert len({Config(heads=1), Config(algorithm="a3c"), Config(algorithm="a3c")}) == 2


def test_lists_and_dicts_of_a_notebook_are_taken():
    config = Config(hidden=[8, 8], env_options={"g": 9.81})
    assert (config.hidden, config.env_options) == ((8, 8), ("g=9.81",))
    assert config.parsed_env_options() == {"g": 9.81}
    assert config.make_env().g == 9.81


def test_replace_changes_a_field_but_not_the_algorithm():
    config = dataclasses.replace(Config(algorithm="a3c", rollout_steps=5), steps=400)
    assert config == Config(algorithm="a3c", rollout_steps=5, steps=400)
    for one, other in (("mapg", "a3c"), ("a3c", "mapg")):
        with pytest.raises(ValueError, match=f"{one} cannot become one of {other}; make it by"):
            dataclasses.replace(Config(algorithm=one), algorithm=other)


@pytest.mark.parametrize("algorithm", registry.names())
def test_every_option_has_its_help_text_and_a_default_within_its_bounds(algorithm):
    """The bounds are those that refuse: what lies just beyond each is no value of the option."""
    config, known = Config(algorithm=algorithm), fields(config_type(algorithm))
    assert {"env", "steps", "seed", "discount"} < known.keys()
    for name, field in known.items():
        assert len(field.metadata["help"].split()) > 1, name
        assert getattr(config, name) == field.default, name
        for words, bound in field.metadata["bounds"].items():
            beyond = {
                "at least": bound - 1, "above": bound, "at most": bound + 1, "below": bound,
            }[words]  # fmt: skip
            with pytest.raises(ValueError, match=f"^{name} must be "):
                dataclasses.replace(config, **{name: beyond})


@pytest.mark.parametrize(
    ("name", "algorithm"), [(name, x) for x in registry.names() for name in presets_of(x)]
)
def test_an_algorithm_takes_of_a_preset_what_it_has(name, algorithm):
    """What it adds itself, and what is given, win."""
    config, own = preset(name, algorithm), registry.find(algorithm).presets.get(name, {})
    for field in fields(config_type(algorithm)).keys() - {"algorithm"}:
        default = getattr(Config(algorithm=algorithm), field)
        assert getattr(config, field) == own.get(field, PRESETS[name].get(field, default)), field
    assert preset(name, algorithm, steps=400) == dataclasses.replace(config, steps=400)


def test_an_unknown_preset_is_refused():
    with pytest.raises(
        ValueError,
        match="preset must be one of paper, diverse, reference, parallel, smoke, got 'pap'",
    ):
        preset("pap")


def test_a_preset_is_refused_by_an_algorithm_that_has_no_part_of_it():
    """Heads that stay apart take rules for it."""
    without = [x for x in registry.names() if "diverse" not in presets_of(x)]
    assert without == [x for x in registry.names() if x not in ("mapg", "td3")]
    for algorithm in without:
        message = f"diverse is a preset of mapg and td3, not of {algorithm}"
        with pytest.raises(ValueError, match=message):
            preset("diverse", algorithm)
        assert set(presets_of(algorithm)) == PRESETS.keys() - {"diverse"}


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
    paper = preset("paper")
    assert paper == preset() == Config()
    assert (paper.hidden, paper.batch_size, paper.replay_size) == ((64, 64), 64, 1_000_000)
    assert (paper.actor_learning_rate, paper.critic_learning_rate) == (1e-4, 1e-3)
    assert (paper.discount, paper.tau, paper.critic_l2) == (0.99, 0.01, 1e-2)
    assert (paper.noise, paper.noise_scale, paper.layer_norm) == ("ou", 0.2, True)
    assert paper.environments * paper.updates_per_step == 8
    assert (paper.steps, paper.final_episodes) == (2_000_000, 100)


def test_presets_are_those_of_their_type():
    from mapg_jax.training.config import Preset

    assert tuple(PRESETS) == typing.get_args(Preset)
