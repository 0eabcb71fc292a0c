"""benchmarks/results.md, of which a section can be made anew by itself."""

import datetime

from benchmarks import commands

FILE = commands.ROOT / "benchmarks/results.md"


def renew(section: str) -> None:
    """Puts a section in the place of the one of its title, or at the end of the page."""
    today = f"Written by itself on {datetime.date.today()}."
    title, _, rest = section.partition("\n")
    page = FILE.read_text().rstrip().split("\n\n## ")
    kept = [part for part in page if part.partition("\n")[0] != title.removeprefix("## ")]
    FILE.write_text("\n\n## ".join([*kept, f"{title[3:]}\n\n{today}{rest}"]) + "\n")
