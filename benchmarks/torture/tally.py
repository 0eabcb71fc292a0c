"""The figures of all tortures so far, and the table of docs/reliability.md that is made of them."""

import collections
import json
import pathlib

from mapg_jax.reports.document import Table

FILE = pathlib.Path("benchmarks/torture.json")
PAGE = pathlib.Path("docs/reliability.md")
BEGIN, END = "<!-- torture -->", "<!-- /torture -->"


class Tally:
    """How often each outcome came, by kind of torture; the seed of the next scenario."""

    def __init__(self, path: pathlib.Path = FILE):
        self._path = path
        found = json.loads(path.read_text()) if path.exists() else {}
        self._counts = {kind: collections.Counter(counts) for kind, counts in found.items()}

    def seeds(self, group: str) -> int:
        """How many scenarios of a group there were: the next ones go on from there."""
        kinds = (counts for kind, counts in self._counts.items() if kind.startswith(f"{group}: "))
        return sum(sum(counts.values()) for counts in kinds)

    def add(self, kind: str, outcome: str) -> None:
        """Counts a scenario, and writes the file."""
        self._counts.setdefault(kind, collections.Counter())[outcome] += 1
        self._path.write_text(json.dumps(self._counts, indent=2, sort_keys=True) + "\n")

    def table(self) -> str:
        """In Markdown."""
        lines = []
        for kind, counts in sorted(self._counts.items()):
            outcomes = "; ".join(f"{outcome}: {n}" for outcome, n in counts.most_common())
            lines.append([kind, str(sum(counts.values())), outcomes])
        return Table(("", "scenarios", "outcomes"), lines).markdown()

    def write_page(self, page: pathlib.Path = PAGE) -> None:
        """Puts the table where the page has its comments for it."""
        before, _, rest = page.read_text().partition(BEGIN)
        page.write_text(f"{before}{BEGIN}\n{self.table()}\n{END}{rest.partition(END)[2]}")
