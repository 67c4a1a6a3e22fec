"""A real S3 server in a process of its own, and a proxy before it that answers late, with 503, or by a reset.

The proxy: ``python -m tests.support.damage.object_store PORT BEHIND --delay 0.03 --busy-every 100 --lost-every 100``.
"""

import argparse
import contextlib
import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count
from pathlib import Path
from threading import Lock
from typing import Any
from urllib.parse import unquote

from tests.support.ranks import ROOT, free_port

BUCKET = "s3://datasets"
_VARIABLES = {"AWS_ACCESS_KEY_ID": "k", "AWS_SECRET_ACCESS_KEY": "s", "AWS_DEFAULT_REGION": "us-east-1"}
_BUSY = b"<Error><Code>SlowDown</Code><Message>Reduce your request rate.</Message></Error>"
_RESET = struct.pack("ii", 1, 0)  # SO_LINGER: what is not sent yet is thrown away, and the other side is told


@contextlib.contextmanager
def s3_server() -> Iterator[subprocess.Popen[bytes]]:
    """An S3 server with a bucket, named by the environment while the block runs."""
    import boto3

    port = free_port()
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    with _process(command) as process, _environment({**_VARIABLES, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}"}):
        client = boto3.client("s3")
        _when_there(lambda: client.create_bucket(Bucket=BUCKET.removeprefix("s3://")))
        yield process


class Proxy:
    """A proxy before the server that the environment names; what passed it is counted by its log."""

    def __init__(self, log: Path) -> None:
        self._log = log

    def requests(self, word: str = "") -> list[str]:
        """``METHOD PATH`` of every request so far whose path has a word in it."""
        return [line for line in self._log.read_text(encoding="utf-8").splitlines() if word in line]


@contextlib.contextmanager
def proxied(log: Path, *, delay: float = 0.0, busy_every: int = 0, lost_every: int = 0) -> Iterator[Proxy]:
    """A proxy in a process of its own, in the place of the server that the environment names while the block runs.

    Parameters
    ----------
    delay
        Seconds that each request waits.
    busy_every, lost_every
        One request of so many is answered by 503, or by a reset: in turn before and within the answer. 0: none.
    """
    port, behind = free_port(), os.environ["AWS_ENDPOINT_URL"].rsplit(":", 1)[1]
    log.touch()
    options = {"--delay": delay, "--busy-every": busy_every, "--lost-every": lost_every, "--log": log}
    words = [str(word) for option in options.items() for word in option]
    command = [sys.executable, "-m", "tests.support.damage.object_store", str(port), behind, *words]
    with _process(command), _environment({"AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}"}):
        _when_there(lambda: socket.create_connection(("127.0.0.1", port)).close())
        yield Proxy(log)


@contextlib.contextmanager
def _process(command: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@contextlib.contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    import s3fs

    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    s3fs.S3FileSystem.clear_instance_cache()  # they know the address of before
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
        s3fs.S3FileSystem.clear_instance_cache()


def _when_there(ask: Any) -> None:
    for attempt in count():
        try:
            ask()
            return
        except Exception:
            assert attempt < 480, "the server does not start"
            time.sleep(0.25)


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__(("127.0.0.1", options.port), _Handler)
        self.options, self._numbers, self._guard = options, count(1), Lock()

    def number(self, request: str) -> int:
        """The number of a request, which is noted."""
        with self._guard, self.options.log.open("a", encoding="utf-8") as log:
            log.write(f"{request}\n")
            return next(self._numbers)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    server: _Server
    _behind: HTTPConnection | None = None

    def _pass_on(self) -> None:
        options, length = self.server.options, int(self.headers.get("Content-Length") or 0)
        number, body = self.server.number(f"{self.command} {unquote(self.path)}"), self.rfile.read(length)
        time.sleep(options.delay)
        if options.busy_every and number % options.busy_every == options.busy_every // 2:
            self._answer(503, {}, _BUSY)
            return
        lost = options.lost_every and number % options.lost_every == 0
        if lost and number // options.lost_every % 2:
            self._reset()
            return
        self._behind = self._behind or HTTPConnection("127.0.0.1", options.behind, timeout=30)
        headers = {name: value for name, value in self.headers.items() if name.lower() not in ("expect", "connection")}
        self._behind.request(self.command, self.path, body, headers)
        answer = self._behind.getresponse()
        content = answer.read()
        self._answer(answer.status, dict(answer.headers), content[: len(content) // 2] if lost else content)
        if lost:
            self._reset()

    def _answer(self, status: int, headers: dict[str, str], body: bytes) -> None:
        self.send_response_only(status)
        for name, value in headers.items():
            if name.lower() not in ("transfer-encoding", "connection", "content-length"):
                self.send_header(name, value)
        self.send_header("Content-Length", headers.get("Content-Length", str(len(body))))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def _reset(self) -> None:
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        os.close(self.connection.detach())
        self.close_connection = True

    do_GET = do_PUT = do_HEAD = do_POST = do_DELETE = _pass_on

    def log_message(self, *_: object) -> None:
        pass


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("port", type=int)
    parser.add_argument("behind", type=int, help="port of the server")
    parser.add_argument("--delay", type=float, default=0.0)
    parser.add_argument("--busy-every", type=int, default=0)
    parser.add_argument("--lost-every", type=int, default=0)
    parser.add_argument("--log", type=Path, required=True)
    _Server(parser.parse_args()).serve_forever()
