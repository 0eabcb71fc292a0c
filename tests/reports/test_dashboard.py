"""The page that follows runs: what it tells, to whom, and in a browser."""

import contextlib
import http.client
import json
import re
import threading
import time

import pytest

from mapg_jax.reports import dashboard, live_runs
from mapg_jax.runs.folder import RunFolder
from mapg_jax.training.config import preset


def write_rows(folder, rows):
    """`rows` of a step, a return and a spread."""
    lines = ["env_steps,return_mean,spread", *(",".join(map(str, row)) for row in rows)]
    folder.metrics.write_text("\n".join(lines) + "\n")


@pytest.fixture
def root(tmp_path):
    """Two runs, one of which has a score, a video and a name that would end a script."""
    for name, heads in (("</script><b>", 1), ("b", 7)):
        folder = RunFolder.create(tmp_path / name.replace("/", "_"), preset("smoke", heads=heads))
        write_rows(folder, [(step, -step, "nan") for step in range(0, 5_000, heads)])
    folder.evaluation.write_text(json.dumps({"returns": [1.0, 4.0]}))
    (folder.path / "video.gif").write_bytes(b"GIF89a")
    return tmp_path


def test_it_tells_what_is_in_the_files(root):
    told = live_runs.snapshot([root, root / "b"])
    assert told["problems"] == []
    one, seven = told["runs"]  # each once
    assert seven["name"] == str(root / "b") and seven["config"]["heads"] == "7"
    assert seven["score"] == {"mean": 2.5, "episodes": 2} and one["score"] is None
    assert seven["video"]["name"] == "video.gif" and one["video"] is None
    assert len(seven["history"]) == 1 and "mapg" in seven["history"][0]
    for run, last in ((one, 4_999), (seven, 4_998)):
        columns = run["columns"]
        steps = columns["env_steps"]
        assert steps[0] == 0 and steps[-1] == last and 700 < len(steps) <= 1_001
        assert columns["return_mean"] == [-step for step in steps]
        assert set(columns["spread"]) == {None}
    json.dumps(told, allow_nan=False)


def test_a_damaged_run_is_told_beside_the_others(root):
    (root / "b" / "metrics.csv").write_text("env_steps,return_mean\n1,x\n")
    told = live_runs.snapshot([root])
    assert [run["config"]["heads"] for run in told["runs"]] == ["1"]
    (problem,) = told["problems"]
    assert problem.startswith(str(root / "b" / "metrics.csv")) and "damaged" in problem


def test_the_file_needs_no_other_and_no_name_ends_its_script(root):
    page = dashboard.page([root])
    assert len(page) > 1_000_000  # plotly is inside
    ours = page[page.rindex('"use strict"') :]
    assert ours.count("</script>") == 1
    seen = json.loads(re.search(r"let seen = (.*);\n", ours)[1])
    assert seen["runs"][1]["video"]["content"].startswith("data:image/gif;base64,R0lG")
    assert "const seconds = 0;" in ours
    assert not re.search(r"<(script|link)[^>]*(src|href)=.?https?:", page)


@contextlib.contextmanager
def served(root):
    server = dashboard.server([root], 0)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_it_is_served_to_this_machine_alone(root):
    with served(root) as server:
        assert server.server_address[0] == "127.0.0.1"

        def get(path, host=None):
            connection = http.client.HTTPConnection(*server.server_address, timeout=20)
            connection.request("GET", path, headers={"Host": host} if host else {})
            answer = connection.getresponse()
            return answer.status, answer.read()

        status, content = get("/runs.json")
        assert (status, len(json.loads(content)["runs"])) == (200, 2)
        assert get("/video/1?5") == (200, b"GIF89a")
        assert get("/", "localhost:80")[0] == 200
        for path in ("/video/0", "/video/7", "/../config.json", "/b/config.json", "/video/-1"):
            assert get(path)[0] == 404
        assert get("/runs.json", "evil.example")[0] == 403


def test_what_it_cannot_do_is_named(root):
    with pytest.raises(ValueError, match=r"there is no .*none"):
        dashboard.page([root / "none"])
    with pytest.raises(ValueError, match=r"there is no folder .*none for page\.html"):
        dashboard.write([root], root / "none" / "page.html")
    with pytest.raises(ValueError, match="port 70000 cannot be had"):
        dashboard.server([root], 70_000)
    with served(root) as server, pytest.raises(ValueError, match="choose another --port"):
        dashboard.server([root], server.server_port)


@pytest.mark.browser
@pytest.mark.parametrize("live", [True, False])
def test_a_browser_draws_filters_and_draws_again(root, browser, live, monkeypatch):
    monkeypatch.setattr(dashboard, "SECONDS", 1)
    with served(root) as server:
        if live:
            browser.get(f"http://127.0.0.1:{server.server_port}/")
        else:
            (root / "page.html").write_text(dashboard.page([root]))
            browser.get((root / "page.html").as_uri())

        def curves():
            """Points of each curve of the first plot."""
            return browser.execute_script(
                "return document.querySelector('.plot').data.map(trace => trace.x.length)"
            )

        def state():
            return browser.find_element("id", "state").text

        whole = curves()
        assert len(whole) == 2 and state().startswith("2 of 2 runs")
        assert len(browser.find_elements("css selector", "#table tr")) == 3
        browser.find_element("id", "filter").send_keys("heads=7")
        assert curves() == whole[1:] and state().startswith("1 of 2 runs")
        before = len(browser.find_elements("css selector", ".plot"))
        browser.find_element("css selector", "#columns input[value=spread]").click()
        assert len(browser.find_elements("css selector", ".plot")) == before - 1
        if live:
            write_rows(RunFolder.open(root / "b"), [(0, 1, 2), (7, 1, 2), (9, 1, 2)])
            until = time.monotonic() + 20
            while curves() != [3] and time.monotonic() < until:
                time.sleep(0.2)
            assert curves() == [3]
        severe = [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
        assert severe == []
