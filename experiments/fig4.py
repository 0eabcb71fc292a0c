"""Figure 4: DDPG and MAPG during training, with and without exploration noise (C5)."""

from experiments import rows, scores
from experiments.plan import DDPG, MAPG, NO_NOISE, Plan
from mapg_jax.config import Config

ENVS = ("pendulum", "halfcheetah")
ARMS = {
    "DDPG with noise": DDPG,
    "DDPG without": {**DDPG, **NO_NOISE},
    "M = 10 with noise": MAPG,
    "M = 10 without": {**MAPG, **NO_NOISE},
}


def runs(plan: Plan) -> list[Config]:
    return [
        config
        for env in ENVS
        for changes in ARMS.values()
        for config in plan.over_seeds(env, **changes)
    ]


def section(plan: Plan) -> str:
    """The picture, and the final scores."""
    if not scores.of(plan, runs(plan)):
        return rows.missing(runs(plan))
    draw(plan).savefig(plan.results / "fig4.png", dpi=120)
    lines = [f"| task | {' | '.join(ARMS)} |", "|---|" + "---|" * len(ARMS)]
    for env in ENVS:
        cells = [
            scores.summary(scores.means(plan, plan.over_seeds(env, **changes)))
            for changes in ARMS.values()
        ]
        lines.append(f"| {env} | {' | '.join(cells)} |")
    return (
        "![With and without noise](fig4.png)\n\n"
        f"Evaluations of {plan.base.evaluation_episodes} episodes without noise, mean over seeds. "
        "Final scores:\n\n"
    ) + "\n".join(lines)
