"""A local S3 server behind a proxy that records requests and injects faults, and plain web servers.

The proxy also serves the files of a folder, as plain web servers do, with or without byte ranges.
"""

import contextlib
import http.client
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import NamedTuple

import s3fs

BUCKET = "bucket"


class Request(NamedTuple):
    """A request as the server received it."""

    method: str
    path: str
    range: str  # as in the header; empty: the whole file


Fault = Callable[[Request], str]  # "fail" (503), "deny" (403), "cut" (half of the body) or "" (none)


class Server(ThreadingHTTPServer):
    """The proxy. `behind` is the port of the S3 server."""

    daemon_threads = True

    def __init__(self, behind: int) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.behind = behind
        self.requests: list[Request] = []
        self.fault: Fault = lambda request: ""
        self.folder = Path()  # served as /files/
        self.has_ranges = True

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def reset(self) -> None:
        """Forget all requests and inject no more faults."""
        self.requests, self.fault = [], lambda request: ""

    def of(self, method: str, part: str = "") -> list[Request]:
        """Recorded requests with this method and this part in their path."""
        return [request for request in self.requests if request.method == method and part in request.path]

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore errors: clients may disconnect."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def answer(self) -> None:
        proxy = self.server
        assert isinstance(proxy, Server)
        request = Request(self.command, self.path, self.headers.get("Range", ""))
        proxy.requests.append(request)
        content = self._content()
        fault = proxy.fault(request)
        if fault in ("fail", "deny"):
            return self._send(503 if fault == "fail" else 403, [], b"", cut=False)
        if request.path.startswith("/files/"):
            path = proxy.folder / request.path.removeprefix("/files/")
            return self._send_file(path, request.range if proxy.has_ranges else "")
        upstream = http.client.HTTPConnection("127.0.0.1", proxy.behind, timeout=30)
        headers = {key: value for key, value in self.headers.items() if key.lower() != "transfer-encoding"}
        upstream.request(self.command, self.path, content, headers)
        reply = upstream.getresponse()
        self._send(reply.status, reply.getheaders(), reply.read(), fault == "cut")
        upstream.close()

    do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = answer

    def _content(self) -> bytes:
        if self.headers.get("Transfer-Encoding") != "chunked":
            return self.rfile.read(int(self.headers.get("Content-Length") or 0))
        content = b""
        while size := int(self.rfile.readline(), 16):
            content += self.rfile.read(size)
            self.rfile.readline()
        self.rfile.readline()
        return content

    def _send_file(self, path: Path, part: str) -> None:
        if not path.is_file():
            return self._send(404, [], b"", cut=False)
        content = path.read_bytes()
        if not part:
            return self._send(200, [("Content-Length", str(len(content)))], content, cut=False)
        first, last = map(int, part.removeprefix("bytes=").split("-"))
        self._send(206, [], content[first : last + 1], cut=False)

    def _send(self, status: int, headers: list[tuple[str, str]], content: bytes, cut: bool) -> None:
        self.send_response_only(status)
        for key, value in headers:
            if key.lower() not in ("connection", "transfer-encoding", "content-length"):
                self.send_header(key, value)
        length = {key.lower(): value for key, value in headers}.get("content-length", str(len(content)))
        self.send_header("Content-Length", length if self.command == "HEAD" else str(len(content)))
        self.end_headers()
        self.wfile.write(content[: len(content) // 2] if cut else content)
        if cut:
            self.close_connection = True

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


class Files(ThreadingHTTPServer):
    """A plain web server: files of a folder, with byte ranges but without listings."""

    daemon_threads = True

    def __init__(self, folder: Path) -> None:
        super().__init__(("127.0.0.1", 0), _FilesHandler)
        self.folder = folder

    def url(self, path: Path) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/{path.relative_to(self.folder)}"

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore errors: clients may disconnect."""


class _FilesHandler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        server = self.server
        assert isinstance(server, Files)
        path, range_header = server.folder / self.path.lstrip("/"), self.headers.get("Range", "")
        if not path.is_file() or path.is_symlink():
            return self._answer(404, 0)
        size = path.stat().st_size
        first, last = map(int, range_header.removeprefix("bytes=").split("-")) if range_header else (0, size - 1)
        if range_header and first >= size:
            return self._answer(416, 0)
        last = min(last, size - 1)
        self._answer(206 if range_header else 200, last + 1 - first)
        if self.command == "GET":
            with path.open("rb") as file:
                file.seek(first)
                while first <= last:
                    first += self.wfile.write(file.read(min(2**20, last + 1 - first)))

    do_HEAD = do_GET

    def _answer(self, status: int, length: int) -> None:
        self.send_response_only(status)
        self.send_header("Content-Length", str(length))
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


@contextlib.contextmanager
def serving_files(folder: Path) -> Iterator[Files]:
    """Context manager: a plain web server of the folder, in a thread."""
    with Files(folder) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


@contextlib.contextmanager
def serving() -> Iterator[Server]:
    """Context manager: the proxy of an S3 server with one empty bucket; `environment` leads clients to it."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-W", "ignore", "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as moto:
        try:
            _make_bucket(port)
            with Server(port) as proxy:
                threading.Thread(target=proxy.serve_forever, daemon=True).start()
                yield proxy
                proxy.shutdown()
        finally:
            moto.terminate()


def environment(server: Server) -> dict[str, str]:
    """Environment variables that lead S3 clients to this server only."""
    names = {"ACCESS_KEY_ID": "some", "SECRET_ACCESS_KEY": "one", "DEFAULT_REGION": "us-east-1"}
    names |= {"ENDPOINT_URL": server.address, "EC2_METADATA_DISABLED": "true"}
    names |= {"MAX_ATTEMPTS": "1"}  # gen2d has its own retries
    names |= {"CONFIG_FILE": os.devnull, "SHARED_CREDENTIALS_FILE": os.devnull}
    return {f"AWS_{name}": value for name, value in names.items()}


def _make_bucket(port: int) -> None:
    deadline = time.monotonic() + 60
    while True:
        try:
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
            connection.request("PUT", f"/{BUCKET}")
            assert connection.getresponse().status == 200
            connection.close()
            return
        except ConnectionError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


def tree(url: str) -> dict[str, bytes]:
    """Bytes of every published object below the URL, by relative name."""
    system = s3fs.S3FileSystem(use_listings_cache=False)
    paths = {name.removeprefix(url.removeprefix("s3://") + "/"): name for name in system.find(url)}
    content = {name: system.cat_file(path) for name, path in paths.items() if not name.startswith(".gen2d")}
    return {name: data for name, data in content.items() if isinstance(data, bytes)}


def copy_dataset(root: Path, url: str) -> None:
    """Copy the dataset in the folder to the URL."""
    s3fs.S3FileSystem().put(str(root), url, recursive=True)
