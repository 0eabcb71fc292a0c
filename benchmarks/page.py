"""benchmarks/results.md, of which a section can be made anew by itself."""

import datetime

from benchmarks import commands

FILE = commands.ROOT / "benchmarks/results.md"


def renew(section: str) -> None:
    """Puts a section in the place of the one of its title, or at the end of the page."""
    today = f"Written by itself on {datetime.date.today()}."
    title, _, rest = section.removeprefix("## ").partition("\n")
    parts = FILE.read_text().rstrip().split("\n\n## ")
    titles = [part.partition("\n")[0] for part in parts]
    place = titles.index(title) if title in titles else len(parts)
    parts[place : place + 1] = [f"{title}\n\n{today}\n{rest}"]
    FILE.write_text("\n\n## ".join(parts) + "\n")
