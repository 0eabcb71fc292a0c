"""Where several actions pay: the runs, and what is shown of them."""

import pytest
from written import result

from experiments import pictures, scores, several
from experiments.plan import make_plan
from mapg_jax.reports import inference
from mapg_jax.reports.results_csv import append_csv


@pytest.fixture
def plan(tmp_path, monkeypatch):
    monkeypatch.setattr(inference, "RESAMPLES", 200)
    return make_plan("paper", None, None, tmp_path / "runs", tmp_path / "results")


def test_repulsion_ends_half_way(plan):
    for name in several.TASKS:
        for label in ("diverse", "TD3, diverse"):
            for config in several.arm(plan, name, label):
                updates = config.steps * config.updates_per_step
                assert config.repulsion_updates == round(updates / 2)


def test_what_is_found_is_shown(plan):
    for label, shares in (("DDPG", [1, 0, 0, 0]), ("diverse", [0.25, 0.25, 0.25, 0.25])):
        numbers = {"goals_reached": sum(x > 0 for x in shares), "goal_entropy": 0.5}
        numbers |= {f"goal_{i}_share": x for i, x in enumerate(shares, 1)}
        for config in several.arm(plan, "multi_goal", label)[:3]:
            append_csv(scores.path(plan), [result(config, -11, metrics=numbers, physics="jax")])
    plan.results.mkdir(exist_ok=True)
    text = several.section(plan)
    assert "| multi_goal | diverse | -11.00 (-11.00 to -11.00) | 4.00 (4.00 to 4.00) |" in text
    assert (plan.results / "several.png").exists()
    plotted = (plan.results / pictures.FOLDER / "several.csv").read_text().splitlines()
    assert len(plotted) == 1 + 2 * 4 * 3  # two panels of four parts of three bars
    tops = [float(line.split(",")[3]) for line in plotted[1:]]
    assert tops == [1.0] * 12 + [0.25] * 3 + [0.5] * 3 + [0.75] * 3 + [1.0] * 3


def test_what_keeping_heads_apart_costs_is_compared_once_every_task_has_both_arms(plan):
    def add(name, label, values):
        for config, score in zip(several.arm(plan, name, label), values, strict=False):
            append_csv(scores.path(plan), [result(config, score)])

    plan.results.mkdir(parents=True, exist_ok=True)
    for name in several.ONE_BEST[1:]:
        add(name, "DDPG", [1, 2])
        add(name, "diverse", [3, 4])
    assert "Where one action is the best" not in several.section(plan)
    add("pendulum", "DDPG", [5, 6])
    add("pendulum", "diverse", [3, 4])
    text = several.section(plan)
    line = next(x for x in text.splitlines() if x.startswith("| DDPG |"))
    cells = line.strip("| ").split(" | ")[1:]
    assert [cell.split(" ")[0] for cell in cells] == ["0.00", "1.00", "1.00", "1.00", "0.75"]
    # All four pairs of a task go one way in two of the 6 ways to rank two of four. Over four tasks
    # `diverse` is above in 12 of 16: of the 6⁴ = 1296 ways, those with as many or more.
    tails = sum(_ways(4, 16 - lost) for lost in range(5))
    p = [*4 * [f"{2 / 6:.2g}"], f"{2 * tails / 1296:.2g}"]
    assert [cell.split(", p = ")[1] for cell in cells] == p
    assert "| M = 10 | 0" not in text


def _ways(tasks: int, total: int) -> int:
    """In which the better pairs of two against two, summed over tasks, are so many."""
    if tasks == 0:
        return int(total == 0)
    of_one = (0, 1, 2, 2, 3, 4)  # of the six ways to choose two ranks of four
    return sum(_ways(tasks - 1, total - pairs) for pairs in of_one)
