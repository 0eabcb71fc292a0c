"""Grids: products, equal cells, names."""

import dataclasses

import pytest

from mapg_jax.sweeps import grid
from mapg_jax.training.config import Config

BASE = Config(env="hopper")


def test_a_grid_is_the_product_with_seeds_slowest():
    cells = grid.expand(BASE, {"heads": (1, 5), "seed": (0, 1, 2), "hidden": ((8, 8), (16, 16))})
    assert len(cells) == 12 == grid.size({"heads": (1, 5), "seed": (0, 1, 2), "hidden": (1, 2)})
    assert [cell.seed for cell in cells] == [0] * 4 + [1] * 4 + [2] * 4
    assert {(c.heads, c.hidden) for c in cells[:4]} == {
        (1, (8, 8)), (1, (16, 16)), (5, (8, 8)), (5, (16, 16)),
    }  # fmt: skip
    same = dataclasses.replace(BASE, heads=1, seed=0, hidden=(8, 8))
    assert cells[0] == same


def test_no_values_are_one_cell():
    assert grid.expand(BASE, {}) == [BASE]
    assert grid.names([BASE]) == ["hopper"]


def test_equal_cells_are_one():
    assert len(grid.expand(BASE, {"heads": (1, 5, 1)})) == 2
    # A3C proposes one action, whatever M is given.
    cells = grid.expand(BASE, {"algorithm": ("mapg", "a3c"), "heads": (1, 5)})
    assert [(c.algorithm, c.heads) for c in cells] == [("mapg", 1), ("mapg", 5), ("a3c", 1)]
    assert grid.names(cells) == ["hopper-mapg-m1", "hopper-mapg-m5", "hopper-a3c"]


def test_an_empty_grid_is_refused():
    with pytest.raises(ValueError, match="the grid is empty: heads has no values"):
        grid.expand(BASE, {"heads": ()})


def test_a_cell_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="heads must be at least 1, got 0"):
        grid.expand(BASE, {"heads": (1, 0)})


def test_names_say_what_varies_and_differ():
    cells = grid.expand(BASE, {"heads": (1, 10), "seed": (0, 3), "noise_scale": (0.1, 0.2)})
    found = grid.names(cells)
    assert found[0] == "hopper-m1-noise_scale=0.1-s0"
    assert len(set(found)) == len(cells)
    options = (("track=a/b",), ("track=a-b",), ())
    found = grid.names(grid.expand(BASE, {"env_options": options}))
    assert len(set(found)) == 3
    assert not any("/" in name for name in found)
    assert grid.names(grid.expand(BASE, {"env": ("brax:ant", "hopper")})) == ["brax-ant", "hopper"]
