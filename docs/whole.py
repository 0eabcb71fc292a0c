"""The site is whole: pages load nothing from elsewhere, and links have files behind them."""

import html.parser
import pathlib
import re
import urllib.parse

NOTEBOOKS_LINK = re.compile(r'(<a [^>]*href="(?!\w+:)[^"#]*)\.md(?=["#])')
MERMAID = re.compile(r'<script type="module">(?:(?!</script>).)*\bmermaid\b.*?</script>', re.DOTALL)


def on_page_content(content: str, **_) -> str:
    """Of mkdocs: mends notebooks, which link to sources of pages, and load diagrams from elsewhere
    though they have none."""
    return NOTEBOOKS_LINK.sub(r"\1.html", MERMAID.sub("", content))


def on_post_build(config, **_) -> None:
    """Of mkdocs: the end of the build, which fails if something is missing."""
    if problems := missing(pathlib.Path(config["site_dir"])):
        raise SystemExit("\n".join(problems))


def missing(site: pathlib.Path) -> list[str]:
    """A line for each address that a page of `site` loads from elsewhere, or that leads nowhere.

    404.html is left out: its addresses are those of a server.
    """
    paths = [path for path in sorted(site.resolve().rglob("*.html")) if path.name != "404.html"]
    pages = {path: _Page(path) for path in paths}
    problems = []
    for path, page in pages.items():
        name = path.relative_to(site.resolve())
        for address in page.loaded:
            if urllib.parse.urlsplit(address).netloc:
                problems.append(f"{name} loads {address}, which needs a network")
        for address in sorted(page.loaded | page.linked):
            url = urllib.parse.urlsplit(address)
            if url.scheme or url.netloc:
                continue
            target = (path.parent / urllib.parse.unquote(url.path)).resolve() if url.path else path
            if not target.is_file():
                problems.append(f"{name} links to {address}, where there is no file")
            elif target in pages and urllib.parse.unquote(url.fragment) not in pages[target].places:
                problems.append(f"{name} links to {address}, where there is no such heading")
    return problems


class _Page(html.parser.HTMLParser):
    """Addresses of a page."""

    def __init__(self, path: pathlib.Path):
        super().__init__()
        self.loaded: set[str] = set()
        self.linked: set[str] = set()
        self.places = {""}
        """Where links can lead within the page."""
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value for name, value in attrs if value}
        self.places |= {given[name] for name in ("id", "name") if name in given}
        if "src" in given:
            self.loaded.add(given["src"])
        if "href" in given:
            (self.linked if tag == "a" else self.loaded).add(given["href"])
