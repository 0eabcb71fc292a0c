"""The heads: their Q-gap, the rules that keep them apart, the choice at test time."""

from experiments import curves, pictures, rows, scores, selects
from experiments.plan import MAPG, Plan
from mapg_jax.reports.document import Table
from mapg_jax.reports.plots import draw_curves
from mapg_jax.reports.results import run_key
from mapg_jax.runs.folder import RunFolder
from mapg_jax.training.config import Config


def runs(plan: Plan) -> list[Config]:
    return [*rule_runs(plan), *gap_runs(plan)]


def rule_runs(plan: Plan) -> list[Config]:
    """M = 10 under every rule."""
    return [
        config
        for env in plan.ruled
        for changes in ({}, *plan.rules().values())
        for config in plan.over_seeds(env, **MAPG, **changes)
    ]


def gap_runs(plan: Plan) -> list[Config]:
    """M = 10 on every task of Table 2, and on Pendulum."""
    return [config for env in (*plan.tasks, "pendulum") for config in plan.over_seeds(env, **MAPG)]


def measure(plan: Plan, folder: RunFolder) -> None:
    """Scores the last policy of M = 10 by every way to choose among its proposals."""
    if run_key(folder.config) in map(run_key, gap_runs(plan)):
        selects.measure(plan, folder, selects.HEADS)


def section(plan: Plan) -> str:
    """The picture and two tables."""
    found = {
        env: curves.of(plan, plan.over_seeds(env, **MAPG)) for env in (*plan.tasks, "pendulum")
    }
    found = {env: of_env for env, of_env in found.items() if of_env}
    if not found:
        return rows.missing(runs(plan))
    figure = draw_curves(
        {env: {"M = 10": curves_of_env} for env, curves_of_env in found.items()},
        "q_gap_relative",
        "Q-gap / deviation of Q",
    )
    for axes in figure.axes:
        axes.set_yscale("log")  # one early spike would squash the rest
    pictures.save(plan, figure, "heads")
    return "\n\n".join(
        (
            "![Q-gap of the heads over training](heads.png)",
            "Q-gap over the standard deviation of Q (docs/metrics.md), M = 10: the mean over "
            "seeds and, between thin lines, its 95 % interval. 0 would be proposals that the "
            "critic values alike.",
            "Score by rule, M = 10, with the bootstrap's 95 % interval over seeds: the paper's; "
            "`all`, every head gets the gradient of every sample; `wide`, heads that start in "
            "U(±1); `diverse`, the preset, whose head is held for an episode, in evaluation too, "
            "where the others draw one anew at every step:",
            rule_table(plan).markdown(),
            "Score of the same policies by the choice at test time, mean over all runs of a cell:",
            select_table(plan).markdown(),
        )
    )


def rule_table(plan: Plan) -> Table:
    """Mean score by rule."""
    lines = []
    rules = {"the paper's": {}, **plan.rules()}
    for env in plan.ruled:
        cells = [
            scores.of_cell(plan, plan.over_seeds(env, **MAPG, **changes))
            for changes in rules.values()
        ]
        lines.append([env, *cells])
    return Table(("task", *rules), lines)


def select_table(plan: Plan) -> Table:
    """Mean score of the same policies by the choice among their proposals."""
    lines = []
    for env in (*plan.tasks, "pendulum"):
        of_env = plan.over_seeds(env, **MAPG)
        cells = [scores.summary(selects.means(plan, of_env, s)) for s in selects.HEADS]
        lines.append([env, *cells])
    return Table(("task", *selects.HEADS), lines)
