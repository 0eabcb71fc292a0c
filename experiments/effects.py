"""Effects over the tasks as a forest plot, performance profiles, and HalfCheetah's two humps."""

from experiments import claims, fig4, pictures, rows, scores, table2
from experiments.plan import Plan
from mapg_jax.reports import inference as statistics
from mapg_jax.reports.document import Table
from mapg_jax.reports.plots import draw_forest, draw_profiles
from mapg_jax.training.config import Config

HUMP = 2_200
"""HalfCheetah's lower hump ends below it."""


def runs(plan: Plan) -> list[Config]:
    """Those of Table 2 and Figure 4."""
    return [*table2.runs(plan), *fig4.runs(plan)]


def section(plan: Plan) -> str:
    """Two pictures and a table."""
    groups, profiles = forest(plan), profile(plan)
    if not groups:
        return rows.missing(runs(plan))
    label = "P, the probability of improvement"
    pictures.save(plan, draw_forest(groups, label), "effects")
    pictures.save(plan, draw_profiles(profiles), "profiles")
    text = (
        "![Probability of improvement by task](effects.png)\n\n"
        "P of the first named arm over the second, by task and, once all of them are there, over "
        "the tasks together (diamond; weighed as van Elteren's test weighs them), with 95 % "
        "intervals over seeds; n of both arms stands beside the task. The dashed line is ½: "
        "neither arm is the better one; the claimed side is the right one, of C9 the left one. An "
        "interval of no width only means that all pairs agree. Tasks that lack an arm are left "
        "out.\n\n"
        "![Performance profiles](profiles.png)\n\n"
        "The share of an arm's runs that score above x. A curve further right is better; n seeds."
    )
    shares = humps(plan)
    return f"{text}\n\n{shares}" if shares else text


def forest(plan: Plan) -> dict[str, dict[str, statistics.Estimate]]:
    """Claim → task → its effect."""
    groups = {}
    for comparison in claims.comparisons(plan):
        if pairs := comparison.pairs(plan):
            names = dict.fromkeys(name.split()[0] for name in comparison.claims)
            title = f"{', '.join(names)}: {comparison.text}"
            groups[title] = comparison.effects(pairs)
    return groups


def profile(plan: Plan) -> dict[str, dict[str, list[float]]]:
    """Task → arm → scores."""
    found = {}
    for env in plan.tasks:
        arms = {
            label: list(scores.means(plan, plan.over_seeds(env, **changes)))
            for label, changes in plan.arms().items()
        }
        if arms := {label: values for label, values in arms.items() if values}:
            found[env] = arms
    return found


def humps(plan: Plan) -> str:
    """The share of HalfCheetah's runs above HUMP, by arm; '' without runs."""
    arms = profile(plan._replace(tasks=("halfcheetah",))).get("halfcheetah", {})
    lines = []
    for label, values in arms.items():
        above = sum(bool(value > HUMP) for value in values)
        lines.append(
            [label, f"{statistics.share(above, len(values)):.0%}", f"{above} of {len(values)}"]
        )
    if not lines:
        return ""
    title = f"HalfCheetah, runs that score above {HUMP:,}, with Wilson's 95 % interval:"
    return f"{title}\n\n{Table(('arm', 'share', 'runs'), lines).markdown()}"
