"""A page that follows runs while they go on: one HTML file, or served on this machine."""

import base64
import http.server
import json
import mimetypes
import os
import pathlib
import re
from collections.abc import Sequence
from string import Template
from typing import Any

from mapg_jax.reports import live_runs
from mapg_jax.runs.folder import refuse_nowhere

PAGE = pathlib.Path(__file__).with_name("dashboard.html")
ADDRESS = "127.0.0.1"
SECONDS = 5
"""Between two looks at the runs."""


def page(paths: Sequence[str | os.PathLike], live: bool = False) -> str:
    """The page, which needs no network and no other file.

    Args:
      paths: of run folders, and folders of them.
      live: asks its server for news; else the newest videos are inside of it.

    Raises:
      ValueError: if a path holds no run, or plotly is missing.
    """
    seen = live_runs.snapshot(paths)
    if not live:
        _enclose_videos(seen["runs"])
    # A name may hold any text; "</" would end the script.
    told = json.dumps(seen, separators=(",", ":")).replace("</", "<\\/")
    return Template(PAGE.read_text(encoding="utf-8")).substitute(
        plotly=_plotly(), seen=told, seconds=SECONDS if live else 0
    )


def write(paths: Sequence[str | os.PathLike], out: pathlib.Path) -> None:
    """The page as a file.

    Args:
      paths: as of `page`.
      out: the file, whose folder must be there.

    Raises:
      ValueError: as `page`, or if there is no such folder.
    """
    refuse_nowhere(out)
    out.write_text(page(paths), encoding="utf-8")


def server(paths: Sequence[str | os.PathLike], port: int) -> http.server.ThreadingHTTPServer:
    """Serves the page on 127.0.0.1; `serve_forever` begins.

    Args:
      paths: as of `page`.
      port: 0 takes a free one.

    Raises:
      ValueError: as `page`, or if the port cannot be had.
    """
    page(paths, live=True)  # what is wrong is said before anything is served

    class Handler(_Handler):
        runs = paths

    try:
        return http.server.ThreadingHTTPServer((ADDRESS, port), Handler)
    except (OSError, OverflowError) as error:
        raise ValueError(f"port {port} cannot be had: {error}; choose another --port") from None


class _Handler(http.server.BaseHTTPRequestHandler):
    runs: Sequence[str | os.PathLike] = ()

    def do_GET(self) -> None:
        host = self.headers.get("Host", "").rsplit(":", 1)[0]
        if host not in (ADDRESS, "localhost"):  # a foreign page that goes by another name
            self.send_error(403)
        elif self.path == "/":
            self._send("text/html; charset=utf-8", page(self.runs, live=True).encode())
        elif self.path == "/runs.json":
            self._send("application/json", json.dumps(live_runs.snapshot(self.runs)).encode())
        elif video := re.fullmatch(r"/video/(\d{1,6})(\?.*)?", self.path):
            self._send_video(int(video[1]))
        else:
            self.send_error(404)

    def _send_video(self, number: int) -> None:
        folder = live_runs.folder_of(self.runs, number)
        file = folder and live_runs.newest_video(folder)
        if file:
            self._send(_kind(file), file.read_bytes())
        else:
            self.send_error(404)

    def _send(self, kind: str, content: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: the console says where the page is, and no more."""


def _plotly() -> str:
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise ValueError(
            "the dashboard needs plotly; install it by: pip install 'mapg-jax[dashboard]'"
        ) from None
    return get_plotlyjs()


def _enclose_videos(runs: Sequence[dict[str, Any]]) -> None:
    for run in runs:
        if run["video"]:
            file = pathlib.Path(run["name"]) / run["video"]["name"]
            content = base64.b64encode(file.read_bytes()).decode()
            run["video"]["content"] = f"data:{_kind(file)};base64,{content}"


def _kind(file: pathlib.Path) -> str:
    return mimetypes.guess_type(file.name)[0] or "application/octet-stream"
