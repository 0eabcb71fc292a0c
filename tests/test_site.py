"""The site that `make docs` builds: nothing is missing from it, and a browser needs no network."""

import importlib.util
import pathlib
import re
import subprocess
import time

import pytest

ROOT = pathlib.Path(__file__).parent.parent
SITE = ROOT / ".site" / "html"
spec = importlib.util.spec_from_file_location("whole", ROOT / "docs" / "whole.py")
whole = importlib.util.module_from_spec(spec)
spec.loader.exec_module(whole)


def test_what_a_page_links_to_is_carried_into_the_site():
    """Without the minute that it takes to build it."""
    said = subprocess.run(
        ["make", "--dry-run", "docs"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    (copied,) = re.findall(r"^cp -r --parents (.*) \.site/source$", said, re.M)
    carried = [ROOT / name for name in copied.split()]
    pages = [path for path in carried if path.suffix == ".md"]
    pages += [page for path in carried if path.is_dir() for page in path.rglob("*.md")]
    linked = {
        (page.parent / address).resolve()
        for page in pages
        for address in re.findall(r"\]\(([^()#:\s]+)(?:#[^()]*)?\)", page.read_text())
    }
    files = [path for path in linked if path.is_file()]
    assert len(files) > 20
    left = [path for path in files if not any(path.is_relative_to(x) for x in carried)]
    assert not left


def test_what_is_missing_is_named(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "other.html").write_text('<h2 id="of é">x</h2><a href="index.html#no">x</a>')
    (tmp_path / "index.html").write_text(
        '<link href="gone.css"><script src="https://else.where/x.js"></script>'
        '<a href="other.html#of%20%C3%A9">x</a> <a href="https://else.where">x</a>'
        '<a href="mailto:a@b">x</a> <a href="folder">x</a> <a href="#">x</a>'
    )
    assert whole.missing(tmp_path) == [
        "index.html loads https://else.where/x.js, which needs a network",
        "index.html links to folder, where there is no file",
        "index.html links to gone.css, where there is no file",
        "other.html links to index.html#no, where there is no such heading",
    ]
    with pytest.raises(SystemExit, match=r"gone\.css"):
        whole.on_post_build({"site_dir": str(tmp_path)})


def test_notebooks_are_mended():
    loader = '<script type="module">await import("https://else.where/mermaid.mjs")</script>'
    assert whole.on_page_content(f"<script>1</script>{loader}<p>") == "<script>1</script><p>"
    link = '<a class="x" href="{}">'
    for address, mended in (("../heads.md#a", "../heads.html#a"), ("https://b/c.md",) * 2):
        assert whole.on_page_content(link.format(address)) == link.format(mended)


@pytest.mark.browser
@pytest.mark.parametrize(
    "page", ["index.html", "docs/heads.html", "docs/tutorials/first_policy.html"]
)
def test_a_page_from_the_folder_searches_without_a_network(browser, page):
    browser.get((SITE / page).as_uri())
    field = browser.find_element("css selector", ".md-search__input")
    assert field.is_displayed()
    field.click()
    field.send_keys("repulsion")
    until = time.monotonic() + 20
    found = []
    while not found and time.monotonic() < until:
        time.sleep(0.1)
        found = browser.find_elements("css selector", ".md-search-result__link")
    assert found[0].get_attribute("href").startswith((SITE / "docs/heads.html").as_uri())
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
