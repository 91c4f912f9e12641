"""Rerun's web viewer on this machine, and nowhere else: its files from its own server, under a policy of ours.

The page as Rerun ships it fetches a font and reports its use; Rerun has no switch for that. Here its first page goes
out without foreign links and with a policy that lets the browser speak to this machine alone.
"""

from __future__ import annotations

import http.client
import re
import shutil
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Self
from urllib.parse import quote, urlsplit

from mechanics.yaml_input import InputError, Problem

HOST = "127.0.0.1"
_TIMEOUT = 20.0
_FOREIGN = re.compile(r"<link\b[^>]*\bhref=\"https?://[^>]*>", re.IGNORECASE)
_HEAD = re.compile(r"<head\b[^>]*>", re.IGNORECASE)
_PASSED = ("content-type", "content-length", "rerun-final-length")

# what the policy would refuse is not even asked for, so that the console stays quiet
_QUIET = """<script>
  (() => {
    const fetched = window.fetch.bind(window);
    const here = ["127.0.0.1", "localhost", ""];
    window.fetch = (what, how) => {
      const url = new URL(what instanceof Request ? what.url : what, window.location.href);
      return here.includes(url.hostname) ? fetched(what, how) : Promise.resolve(new Response(null, { status: 204 }));
    };
  })();
</script>"""


def policy(data_port: int) -> str:
    """The Content-Security-Policy of the page: this machine, and data from ``data_port`` of it."""
    data = f"http://{HOST}:{data_port} http://localhost:{data_port}"
    return (
        "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob:; "
        f"style-src 'self' 'unsafe-inline'; connect-src 'self' data: blob: {data}; worker-src 'self' blob:; "
        "form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
    )


def tamed(page: str) -> str:
    """Rerun's first page without links to elsewhere, and with a ``fetch`` that stays here."""
    page = _FOREIGN.sub("", page)
    return _HEAD.sub(lambda head: head[0] + _QUIET, page, count=1)


class Page:
    """A server at ``http://127.0.0.1:port/`` as a context manager; its threads end with it.

    ``source`` is the port of Rerun's own web server, ``data`` that of its data. Raises InputError for a port that is
    taken.
    """

    def __init__(self, port: int, source: int, data: int):
        try:
            self._server = ThreadingHTTPServer((HOST, port), _handler(source, data))
        except OSError as error:
            wrong = f"port {port} of {HOST} cannot be had: {error.strerror}"
            raise InputError([Problem("view", None, "--port", wrong, "another port")]) from None
        self._server.daemon_threads = True  # a browser keeps its connections open
        self.url = f"http://{HOST}:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, name="web viewer", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(_TIMEOUT)


def _handler(source: int, data: int) -> type[BaseHTTPRequestHandler]:
    start = f"/?url={quote(f'rerun+http://{HOST}:{data}/proxy', safe='')}&hide_welcome_screen=1"

    class Handler(BaseHTTPRequestHandler):
        timeout = _TIMEOUT

        def do_GET(self) -> None:
            asked = urlsplit(self.path)
            if urlsplit(f"//{self.headers.get('Host', '')}").hostname not in (HOST, "localhost"):
                self.send_error(403, "this page is for this machine")  # a name of elsewhere that points here
            elif asked.path == "/" and "url=" not in asked.query:
                self.send_response(302)
                self.send_header("Location", start)
                self.send_header("Content-Length", "0")
                self.end_headers()
            else:
                try:
                    self._pass_on(asked.path)
                except (OSError, http.client.HTTPException):
                    self.close_connection = True  # the browser has gone, or the viewer has ended

        def _pass_on(self, path: str) -> None:
            inner = http.client.HTTPConnection(HOST, source, timeout=_TIMEOUT)
            try:
                inner.request("GET", path)
                found = inner.getresponse()
                self.send_response(found.status)
                self.send_header("Content-Security-Policy", policy(data))
                self.send_header("Referrer-Policy", "no-referrer")
                if found.getheader("content-type", "").startswith("text/html"):
                    page = tamed(found.read().decode()).encode()
                    self.send_header("Content-Type", "text/html; charset=utf-8")
                    self.send_header("Content-Length", str(len(page)))
                    self.end_headers()
                    self.wfile.write(page)
                    return
                for name in _PASSED:
                    if (value := found.getheader(name)) is not None:
                        self.send_header(name, value)
                self.end_headers()
                shutil.copyfileobj(found, self.wfile)
            finally:
                inner.close()

        def log_message(self, format: str, *args: object) -> None:
            return

    return Handler
