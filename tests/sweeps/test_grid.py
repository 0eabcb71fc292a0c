"""Grids: products, equal cells, names."""

import pytest

from mapg_jax.sweeps import grid
from mapg_jax.training.config import Config, preset

HOPPER = {"env": ("hopper",)}


def expand(**values):
    return grid.expand("paper", {**HOPPER, **values})


def names(**values):
    values = {**HOPPER, **values}
    return grid.names(grid.expand("paper", values), values)


def test_a_grid_is_the_product_with_seeds_slowest():
    values = {"heads": (1, 5), "seed": (0, 1, 2), "hidden": ((8, 8), (16, 16))}
    cells = expand(**values)
    assert len(cells) == 12 == grid.size(values)
    assert [cell.seed for cell in cells] == [0] * 4 + [1] * 4 + [2] * 4
    assert {(c.heads, c.hidden) for c in cells[:4]} == {
        (1, (8, 8)), (1, (16, 16)), (5, (8, 8)), (5, (16, 16)),
    }  # fmt: skip
    assert cells[0] == Config(env="hopper", heads=1, seed=0, hidden=(8, 8))


@pytest.mark.parametrize("name", ["paper", "parallel", "smoke"])
def test_no_values_are_one_cell(name):
    assert grid.expand(name, {}) == [preset(name)]
    assert grid.names([preset(name)], {}) == ["pendulum"]


def test_equal_cells_are_one():
    assert len(expand(heads=(1, 5, 1))) == 2
    # A3C proposes one action, whatever M is given.
    values = {"algorithm": ("mapg", "a3c"), "heads": (1, 5)}
    assert [(c.algorithm, c.heads) for c in expand(**values)] == [
        ("mapg", 1), ("mapg", 5), ("a3c", 1),
    ]  # fmt: skip
    assert names(**values) == ["hopper-mapg-m1", "hopper-mapg-m5", "hopper-a3c"]


def test_an_option_goes_to_the_algorithms_that_have_it():
    values = {"algorithm": ("a3c", "mapg"), "tau": (0.1, 0.2), "rollout_steps": (5, 20)}
    cells = expand(**values)
    assert cells == [
        *(Config(env="hopper", algorithm="a3c", rollout_steps=n) for n in (5, 20)),
        *(Config(env="hopper", tau=tau) for tau in (0.1, 0.2)),
    ]
    assert len(set(names(**values))) == 4


def test_an_option_that_no_algorithm_has_is_refused():
    with pytest.raises(ValueError, match=r"tau is an option of mapg, .* and .*, not of a3c"):
        expand(algorithm=("a3c",), tau=(0.1,))
    with pytest.raises(
        ValueError, match="rollout_steps is an option of a3c, ppo and trpo, not of mapg"
    ):
        expand(rollout_steps=(5, 20))
    with pytest.raises(ValueError, match="haeds is no option of a run; mapg has"):
        expand(haeds=(1,))


def test_an_empty_grid_is_refused():
    with pytest.raises(ValueError, match="the grid is empty: heads has no values"):
        expand(heads=())


def test_a_vast_grid_is_refused_before_it_is_listed():
    with pytest.raises(ValueError, match=r"the grid has 10,000,000,000 cells, more than 100,000"):
        expand(seed=range(100_000), heads=range(1, 100_001))


def test_a_cell_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="heads must be at least 1, got 0"):
        expand(heads=(1, 0))


def test_names_say_what_varies_and_differ():
    values = {"heads": (1, 10), "seed": (0, 3), "noise_scale": (0.1, 0.2)}
    found = names(**values)
    assert found[0] == "hopper-m1-noise_scale=0.1-s0"
    assert len(set(found)) == len(expand(**values))
    found = names(env=("driving",), env_options=(("track=a/b",), ("track=a-b",), ()))
    assert len(set(found)) == 3
    assert not any("/" in name for name in found)
    assert names(env=("brax:ant", "hopper")) == ["brax-ant", "hopper"]
