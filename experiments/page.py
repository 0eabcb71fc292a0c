"""results/README.md and the tables in the project's README, from what is in the results."""

import pathlib
from collections.abc import Mapping

from experiments import claims, rows, scores, table2
from experiments.catalogue import TITLES, Name, experiment, runs
from experiments.plan import FIRST_SEED, Plan, is_the_papers
from mapg_jax.reports.document import Table

FILE = "README.md"
HEAD = """# Results

Every number and picture here was written by a command; how runs are made and claims judged was
fixed beforehand, in [experiments/protocol.md](../experiments/protocol.md). What is not there yet is
shown as missing. Scores of all runs: [scores.csv](scores.csv); what else was measured on them:
[measured](measured)."""


def sections(plan: Plan) -> dict[Name, str]:
    """Every experiment, from every seed in the results; the pictures are written."""
    plan.results.mkdir(parents=True, exist_ok=True)
    found: dict[Name, str] = {}
    shown = with_all_seeds(plan)
    for name, title in TITLES.items():
        text = experiment(name).section(shown)
        found[name] = f"## {title}\n\n{text}\n\n{provenance(shown, name)}"
    return found


def write(plan: Plan, sections: Mapping[Name, str]) -> pathlib.Path:
    """The page, and the tables of the project's README."""
    page = plan.results / FILE
    page.write_text("\n\n".join([HEAD, *sections.values(), diverged(plan)]).rstrip() + "\n")
    if is_the_papers(plan):
        write_headline(with_all_seeds(plan), pathlib.Path("README.md"))
    return page


def with_all_seeds(plan: Plan) -> Plan:
    """A comparison uses every seed there is, whatever was trained last."""
    most = max((result.seed - FIRST_SEED + 1 for result in scores.read(plan)), default=0)
    return plan if plan.seeds is None else plan._replace(seeds=max(plan.seeds, most))


def write_headline(plan: Plan, readme: pathlib.Path) -> None:
    """Puts Table 2 and the verdicts where the project's README has its comments for them."""
    verdicts = [(v.claim, v.text, v.verdict) for v in claims.ledger(plan)]
    tables = {
        "table 2": table2.beside_the_paper(plan),
        "claims": Table(("", "claim", "verdict"), verdicts),
    }
    if readme.exists():
        text = readme.read_text()
        for name, table in tables.items():
            begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
            before, found, rest = text.partition(begin)
            if found and end in rest:
                text = f"{before}{begin}\n{table.markdown()}\n{end}{rest.partition(end)[2]}"
        readme.write_text(text)


def provenance(plan: Plan, name: Name) -> str:
    """The command of a section, and the runs, versions and days behind it."""
    wanted = runs(plan, [name])
    text = f"Made by `mapg paper {name}{plan.flags}`"
    if not wanted:
        return f"{text}."
    found = scores.of(plan, wanted)
    text = f"{text}: {len(found)} of {len(wanted)} runs finished"
    if not found:
        return f"{text}."
    days = sorted({result.date for result in found})
    versions = " and ".join(sorted({result.versions for result in found}))
    until = f" to {days[-1]}" if len(days) > 1 else ""
    steps = " or ".join(f"{n:,}" for n in sorted({result.steps for result in found}))
    return f"{text}, {steps} steps each; {versions}; {days[0]}{until}."


def diverged(plan: Plan) -> str:
    """The runs that count as missing because they diverged."""
    lines = [
        f"- {row['env']}, {row['algorithm']}, M = {row['heads']}, seed {row['seed']}"
        f"{', ' + row['settings'] if row['settings'] else ''}: {row['reason']}"
        for row in rows.read(plan.measured / rows.DIVERGED)
    ]
    return "\n".join(["## Diverged", "", *(lines or ["No run has diverged."])])
