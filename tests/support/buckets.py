"""An S3 server on this machine, and before it a proxy that notes what is asked and fails when told to.

The proxy also gives the files of a folder, as plain web servers do, with or without parts of them.
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
    """What was asked of the server."""

    method: str
    path: str
    range: str  # as in the header; empty if all was asked for


Fault = Callable[[Request], str]  # "fail" (503), "deny" (403), "cut" (half of the answer), or "" for an honest answer


class Server(ThreadingHTTPServer):
    """The proxy."""

    daemon_threads = True

    def __init__(self, behind: int) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.behind = behind
        self.asked: list[Request] = []
        self.fault: Fault = lambda request: ""
        self.folder = Path()  # of what lies under /files/
        self.gives_parts = True

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def reset(self) -> None:
        """Forgets what was asked, and is honest again."""
        self.asked, self.fault = [], lambda request: ""

    def of(self, method: str, part: str = "") -> list[Request]:
        """What was asked with this method of paths with this part."""
        return [request for request in self.asked if request.method == method and part in request.path]

    def handle_error(self, request: object, client_address: object) -> None:
        """Says nothing: clients may go away."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def answer(self) -> None:
        proxy = self.server
        assert isinstance(proxy, Server)
        asked = Request(self.command, self.path, self.headers.get("Range", ""))
        proxy.asked.append(asked)
        content = self._content()
        fault = proxy.fault(asked)
        if fault in ("fail", "deny"):
            return self._send(503 if fault == "fail" else 403, [], b"", cut=False)
        if asked.path.startswith("/files/"):
            path = proxy.folder / asked.path.removeprefix("/files/")
            return self._send_file(path, asked.range if proxy.gives_parts else "")
        back = http.client.HTTPConnection("127.0.0.1", proxy.behind, timeout=30)
        headers = {key: value for key, value in self.headers.items() if key.lower() != "transfer-encoding"}
        back.request(self.command, self.path, content, headers)
        reply = back.getresponse()
        self._send(reply.status, reply.getheaders(), reply.read(), fault == "cut")
        back.close()

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
        """Says nothing."""


class Files(ThreadingHTTPServer):
    """A plain web server: the files of a folder, by ranges, and nothing about what is in it."""

    daemon_threads = True

    def __init__(self, folder: Path) -> None:
        super().__init__(("127.0.0.1", 0), _FilesHandler)
        self.folder = folder

    def url(self, path: Path) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/{path.relative_to(self.folder)}"

    def handle_error(self, request: object, client_address: object) -> None:
        """Says nothing: clients may go away."""


class _FilesHandler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        server = self.server
        assert isinstance(server, Files)
        path, asked = server.folder / self.path.lstrip("/"), self.headers.get("Range", "")
        if not path.is_file() or path.is_symlink():
            return self._answer(404, 0)
        size = path.stat().st_size
        first, last = map(int, asked.removeprefix("bytes=").split("-")) if asked else (0, size - 1)
        if asked and first >= size:
            return self._answer(416, 0)
        last = min(last, size - 1)
        self._answer(206 if asked else 200, last + 1 - first)
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
        """Says nothing."""


@contextlib.contextmanager
def serving_files(folder: Path) -> Iterator[Files]:
    """A plain web server of the folder."""
    with Files(folder) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


@contextlib.contextmanager
def serving() -> Iterator[Server]:
    """The proxy before a server with one empty bucket; the environment says where it is."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = [sys.executable, "-W", "ignore", "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as moto:
        try:
            _make_bucket(port)
            with Server(port) as proxy:
                threading.Thread(target=proxy.serve_forever, daemon=True).start()
                yield proxy
                proxy.shutdown()
        finally:
            moto.terminate()


def environment(server: Server) -> dict[str, str]:
    """The variables that lead S3 clients to the server, and nowhere else."""
    names = {"ACCESS_KEY_ID": "some", "SECRET_ACCESS_KEY": "one", "DEFAULT_REGION": "us-east-1"}
    names |= {"ENDPOINT_URL": server.address, "EC2_METADATA_DISABLED": "true"}
    names |= {"MAX_ATTEMPTS": "1"}  # trying again is for gen2d
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
    """Every published object below the URL and its bytes."""
    system = s3fs.S3FileSystem(use_listings_cache=False)
    found = {name.removeprefix(url.removeprefix("s3://") + "/"): name for name in system.find(url)}
    content = {name: system.cat_file(path) for name, path in found.items() if not name.startswith(".gen2d")}
    return {name: data for name, data in content.items() if isinstance(data, bytes)}


def copied(root: Path, url: str) -> None:
    """Returns when the dataset in the folder is at the URL too."""
    s3fs.S3FileSystem().put(str(root), url, recursive=True)
