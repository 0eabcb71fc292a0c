"""results/README.md and the tables in the project's README, from what is in the results."""

import collections
import pathlib
from collections.abc import Mapping, Sequence

from experiments import carryover, claims, fig2, reference, rows, scores, table2
from experiments.catalogue import TITLES, Name, experiment, runs
from experiments.plan import FIRST_SEED, SEEDS, SEEDS_OF_HUMANOID, Plan, is_the_papers
from experiments.verdicts import CONTRADICTED, SUPPORTED, UNDECIDED, Verdict
from mapg_jax.reports.document import Table
from mapg_jax.reports.results import Result
from mapg_jax.runs.whole_file import whole_file

FILE = "README.md"
HEAD = """# Results

**Question.** The actor of MAPG has M heads: each proposes an action for the state, one, drawn
uniformly, acts, and it alone learns. Does that do what its paper says? The paper trained once for
each task and algorithm, a cell of its Table 2.

**Method.** Every cell has the seeds that [the protocol](../experiments/protocol.md), version 2,
named before the first of them, from {first} on: for the claims {core} of DDPG and M = 10, {others}
of the other arms, on Humanoid {core_of_humanoid} and {others_of_humanoid}. A run has {steps:,}
steps, of C3 {short:,} and of C10 {half:,}, and a score over {episodes} episodes. Scores are
compared by exact permutation tests, P and C2a have a bootstrap's interval, a number that each seed
has (C3, C4, C6, C8) Student's over seeds, and C7 over rounds of timing. A claim is judged when all
its runs are there or have diverged; what was made or judged anew, and why, stands under the
protocol's Changes.

**Answer.** {answer}

**Limits.** {done} of {wanted} runs are there. Tasks are Gymnasium's v5, not the v1 of 2017; driving
stands in for TORCS. That scores are equal is never concluded. Beside what is undecided, power is
printed. [Version 1](version_1/README.md) is kept apart. `make results` makes this page from
[scores.csv](scores.csv) and what else was measured, in `measured`."""


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
    page, shown = plan.results / FILE, with_all_seeds(plan)
    ledger = claims.ledger(shown)
    text = "\n\n".join([abstract(shown, ledger), *sections.values(), earlier(plan), diverged(plan)])
    with whole_file(page) as file:
        file.write(text.rstrip() + "\n")
    if is_the_papers(plan):
        write_headline(shown, ledger, pathlib.Path("README.md"))
    return page


def answer(ledger: Sequence[Verdict]) -> str:
    """The claims by their verdicts: in words where there is one."""
    waiting = [v.claim for v in ledger if v.verdict.startswith("not yet")]
    judged = [v for v in ledger if v.claim not in waiting]
    kinds = dict.fromkeys([SUPPORTED, CONTRADICTED, UNDECIDED, *(v.verdict for v in judged)])
    sentences = [
        f"{kind.capitalize()}: {'; '.join(_in_words(of))}."
        for kind in kinds
        if (of := [v for v in judged if v.verdict == kind])
    ]
    return " ".join([*sentences, *([f"Not yet judged: {', '.join(waiting)}."] if waiting else [])])


def _in_words(verdicts: Sequence[Verdict]) -> list[str]:
    """What is claimed; two forms of a claim in one."""
    forms: dict[str, list[Verdict]] = {}
    for verdict in verdicts:
        forms.setdefault(verdict.text.partition(", ")[0], []).append(verdict)
    found = []
    for text, of in forms.items():
        how = " and ".join(v.text.partition(", ")[2] for v in of)
        found.append(f"{text}{how and f', {how}'} ({', '.join(v.claim for v in of)})")
    return found


def abstract(plan: Plan, ledger: Sequence[Verdict]) -> str:
    """Ten lines: question, method, answer, limits."""
    wanted = runs(plan, list(TITLES))
    return HEAD.format(
        first=FIRST_SEED,
        **SEEDS,
        **{f"{arm}_of_humanoid": n for arm, n in SEEDS_OF_HUMANOID.items()},
        steps=plan.base.steps,
        short=fig2.runs(plan)[0].steps,
        half=carryover.steps(plan),
        episodes=plan.base.final_episodes,
        answer=answer(ledger),
        done=len(scores.of(plan, wanted)),
        wanted=len(wanted),
    )


def earlier(plan: Plan) -> str:
    """The verdicts of version 1, as they were recorded."""
    columns = ("claim", "text", "evidence", "verdict")
    found = rows.read(plan.results / claims.EARLIER, columns)
    if not found:
        return ""
    lines = [[row[k] for k in columns] for row in found]
    return (
        "## Version 1\n\nBy its own rules, on its own seeds (0 to 9); all of it is "
        "[kept](version_1/README.md) as it was recorded.\n\n"
        + Table(("", "claim", "evidence", "verdict"), lines).markdown()
        + f"\n\nMade by `mapg paper all{plan.flags}` from [{claims.EARLIER}]({claims.EARLIER})."
    )


def with_all_seeds(plan: Plan) -> Plan:
    """A comparison uses every seed there is, whatever was trained last."""
    most = max((result.seed - FIRST_SEED + 1 for result in scores.read(plan)), default=0)
    return plan if plan.seeds is None else plan._replace(seeds=max(plan.seeds, most))


def write_headline(plan: Plan, ledger: Sequence[Verdict], readme: pathlib.Path) -> None:
    """Puts Table 2 and the verdicts where the project's README has its comments for them."""
    verdicts = [(v.claim, v.text, claims.earlier(plan, v.claim), v.verdict) for v in ledger]
    verdict_table = Table(("", "claim", "version 1", "version 2"), verdicts)
    parts = {
        "table 2": table2.beside_the_paper(plan).markdown(),
        "claims": verdict_table.markdown(),
        "reference": reference.table(plan).markdown(),
        "answer": answer(ledger),
    }
    if readme.exists():
        text = readme.read_text()
        for name, shown in parts.items():
            begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
            before, found, rest = text.partition(begin)
            if found and end in rest:
                text = f"{before}{begin}\n{shown}\n{end}{rest.partition(end)[2]}"
        with whole_file(readme) as file:
            file.write(text)


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
    counts = collections.Counter(_machine(result) for result in found)
    machines = next(iter(counts))
    if len(counts) > 1:
        machines = ", ".join(f"{count} on {machine}" for machine, count in sorted(counts.items()))
    return f"{text}, {steps} steps each; {versions}; {machines}; {days[0]}{until}."


def _machine(result: Result) -> str:
    """Its processor, and the last of the instructions that are recorded: bits differ by them."""
    newest = result.instructions.split()[-1:]
    return f"{result.processor} ({newest[0]})" if newest else result.processor


def diverged(plan: Plan) -> str:
    """The runs that count as missing because they diverged."""
    lines = [
        f"- {row['env']}, {row['algorithm']}, M = {row['heads']}, seed {row['seed']}"
        f"{', ' + row['settings'] if row['settings'] else ''}: {row['reason']}"
        for row in rows.read(plan.measured / rows.DIVERGED)
    ]
    text = "\n".join(["## Diverged", "", *(lines or ["No run has diverged."])])
    return f"{text}\n\nMade by `mapg paper all{plan.flags}`, whose runs these are."
