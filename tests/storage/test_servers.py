"""Servers that hang, drip, reset, lie or say no: each ends in time, as what it is, and says nothing that is secret."""

import contextlib
import errno
import re
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest
import synthetic
from botocore.exceptions import ClientError
from tiny import run_main

import gen2d
from gen2d.core.errors import ConfigError, DamagedError, Error, FolderError, UnreachableError
from gen2d.storage import retries
from gen2d.storage.paths import Url, place
from gen2d.storage.retries import Network

TIMEOUT, DEADLINE = 0.3, 1.0


class Server:
    """A web server of a folder that misbehaves for paths with some part."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.fault, self.part = folder, "", ""
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.requests: list[str] = []
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.listener.getsockname()[1]}"

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self.listener.accept()
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError), connection:
            data = b""
            while b"\r\n\r\n" not in data:
                part = connection.recv(65536)
                if not part:
                    return
                data += part
            head = data.decode()
            method, path = head.split()[:2]
            self.requests.append(path)
            found = re.search(r"[Rr]ange: bytes=(\d+)-(\d+)", head)
            self._answer(connection, method, path.partition("?")[0], tuple(map(int, found.groups())) if found else None)

    def _answer(self, connection: socket.socket, method: str, path: str, part: tuple[int, ...] | None) -> None:
        fault = self.fault if self.part in path else ""
        file = self.folder / path.lstrip("/")
        content = file.read_bytes() if file.is_file() else None
        status = 200 if content is not None else 404
        if fault.isdigit():
            status, content = int(fault), b""
        content = content or b""
        if part and status == 200:
            status, content = 206, content[part[0] : part[1] + 1]
        length = len(content) + (1000 if fault == "cut" else 0)
        if fault == "wrong":
            content = bytes(255 - byte for byte in content)
        if fault == "longer":
            content, length = content + bytes(5000), length + 5000
        head = f"HTTP/1.1 {status} X\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n".encode()
        if fault == "reset":
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\x00\x00\x00\x00\x00\x00\x00")
            return
        if fault == "hang":
            time.sleep(30)
        if fault == "garbage":
            head = b"\x00\xff" * 100
        if fault == "drip":
            for byte in head + content:
                connection.sendall(bytes([byte]))
                time.sleep(0.1)
        if fault == "stuck":
            connection.sendall(head + content[: len(content) // 2])
            time.sleep(30)
        if fault == "endless":
            connection.sendall(b"HTTP/1.1 200 X\r\nConnection: close\r\n\r\n")
            while True:
                connection.sendall(bytes(2**20))
        connection.sendall(head if method == "HEAD" else head + content)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("served")
    synthetic.make(synthetic.dataset(folder / "toy", train=3))
    made = Server(folder)
    yield made
    made.listener.close()


@pytest.fixture(autouse=True)
def _quick(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retries, "PAUSE", 0.01)
    server.fault, server.requests = "", []


FAULTS: dict[str, type[Error]] = {
    **dict.fromkeys(("hang", "drip", "stuck", "reset", "cut", "garbage", "500", "503", "429", "408"), UnreachableError),
    **dict.fromkeys(("403", "401", "404", "410", "longer"), FolderError),
    "wrong": DamagedError,
}


@pytest.mark.parametrize("part", ["manifest.json", "index/", "shards/"])
@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_ends_in_time_as_what_it_is(server: Server, fault: str, part: str) -> None:
    server.fault, server.part = fault, part
    expected = DamagedError if (fault, part) == ("longer", "manifest.json") else FAULTS[fault]
    began = time.monotonic()
    with pytest.raises(expected) as caught:
        gen2d.open(f"http://{server.address}/toy", fields="*", timeout=TIMEOUT, deadline=DEADLINE)[0]
    assert time.monotonic() - began < DEADLINE + 1
    assert server.address in str(caught.value)
    asked = [path for path in server.requests if part in path]
    is_tried_again = len(asked) > len(set(asked))
    assert is_tried_again == (fault in ("reset", "cut", "500", "503", "429", "408", "hang", "stuck")), asked


@pytest.mark.parametrize("part", ["manifest.json", "index/", "shards/"])
def test_an_answer_without_end_is_cut(server: Server, part: str) -> None:
    server.fault, server.part = "endless", part
    with pytest.raises(Error, match=r"larger than|parts of files"):
        gen2d.open(f"http://{server.address}/toy", fields="*", timeout=TIMEOUT, deadline=5)[0]


@pytest.mark.parametrize(("fault", "code"), [("hang", 3), ("503", 3), ("404", 2), ("403", 2), ("wrong", 1)])
def test_the_command_line_has_a_code_for_each(server: Server, fault: str, code: int) -> None:
    server.fault, server.part = fault, "manifest.json"
    for verb in (("info",), ("verify", "--level", "quick"), ("preview",)):
        limits = ("--timeout", TIMEOUT, "--deadline", DEADLINE)
        done = run_main(verb[0], f"http://{server.address}/toy", *verb[1:], *limits)
        assert done.returncode == (1 if (verb[0], fault) == ("verify", "404") else code), (verb, done)  # incomplete
        assert (done.stderr + done.stdout).count("\n") <= 2


def test_a_plain_server_without_listings_is_enough(server: Server, tmp_path: Path) -> None:
    url = f"http://{server.address}/toy"
    assert len(gen2d.open(url, fields="*")[:]["frames"]) == 3
    for words in (("info", url), ("verify", url), ("preview", url, "--out", tmp_path)):
        done = run_main(*words)
        assert done.returncode == 0, done
    assert gen2d.verify(url) == []


@pytest.mark.parametrize("what", ["password", "query"])
def test_what_is_secret_is_never_shown(server: Server, what: str) -> None:
    secret = "hunter2isnotsecret"
    start = f"http://user:{secret}@{server.address}/toy" if what == "password" else f"http://{server.address}/toy"
    url = start + (f"?sig={secret}" if what == "query" else "")
    ds = gen2d.open(url, fields="*")
    assert len(ds[:]["frames"]) == 3
    assert all(secret in path for path in server.requests) == (what == "query")
    shown = [repr(ds), str(ds.root), repr(ds.root), f"{place(url)!r}"]
    for fault in ("503", "404", "wrong", "garbage", "reset"):
        server.fault, server.part = fault, "/"
        with pytest.raises(Error) as caught:
            gen2d.open(url, timeout=TIMEOUT, deadline=DEADLINE)
        shown.append(str(caught.value))
        assert caught.value.__cause__ is None or secret not in str(caught.value.__cause__)
        for verb in ("info", "verify", "preview", "clean"):
            done = run_main(verb, url, "--timeout", TIMEOUT, "--deadline", DEADLINE)
            shown += [done.stdout, done.stderr]
    with pytest.raises(Error) as caught:
        place(f"nope://me:{secret}@x/y")
    shown.append(str(caught.value))
    assert not any(secret in text for text in shown), shown
    assert any("***" in text for text in shown)


def test_a_deadline_is_for_all_attempts_together() -> None:
    waits = iter((0.8, 30.0))

    def call(system: Any, path: str) -> None:
        time.sleep(next(waits))
        raise ConnectionResetError

    began = time.monotonic()
    with pytest.raises(UnreachableError, match="no answer within the deadline"):
        retries.attempt(Url("memory://x", network=Network(TIMEOUT, DEADLINE)), call)
    assert time.monotonic() - began < 1.5


def answer(status: int, code: str = "") -> Exception:
    """The error of botocore for an answer of S3."""
    return ClientError({"Error": {"Code": code}, "ResponseMetadata": {"HTTPStatusCode": status}}, "GetObject")


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        *((error, UnreachableError) for error in (ConnectionResetError(), TimeoutError(), OSError(errno.EPIPE, "x"))),
        *((error, UnreachableError) for error in (aiohttp.ServerDisconnectedError(), aiohttp.ClientPayloadError())),
        *((answer(status), UnreachableError) for status in (408, 429, 500, 502, 503)),
        (answer(400, "RequestTimeout"), UnreachableError),
        (answer(400, "InvalidRequest"), OSError),
        (answer(403), PermissionError),
        (answer(404), FileNotFoundError),
        *((kind("x"), kind) for kind in (TypeError, AttributeError, KeyError, IndexError, NameError, AssertionError)),
        *((kind("x"), kind) for kind in (ZeroDivisionError, RuntimeError, RecursionError, ImportError, MemoryError)),
        *((kind("x"), OSError) for kind in (ValueError, NotImplementedError)),
    ],
    ids=lambda value: value.__name__ if isinstance(value, type) else " ".join(f"{value!r}".split())[:60],
)
def test_only_failures_of_servers_are_tried_again(error: Exception, expected: type[Exception]) -> None:
    calls = []

    def request(system: object, path: str) -> None:
        calls.append(path)
        raise error

    with pytest.raises(expected) as caught:
        retries.attempt(Url("memory://a/b"), request)
    assert len(calls) == (retries.ATTEMPTS if expected is UnreachableError else 1)
    assert (caught.value is error) == (isinstance(error, expected) and not isinstance(error, OSError))


def test_limits_are_numbers_above_zero() -> None:
    cases: list[dict[str, Any]] = [
        {"timeout": 0},
        {"deadline": -1},
        {"timeout": float("nan")},
        {"deadline": "soon"},
        {"timeout": True},
    ]
    for limits in cases:
        with pytest.raises(ConfigError, match="must be a number of seconds above 0"):
            gen2d.open("http://127.0.0.1:9/x", **limits)
    assert place("memory://a/b", Network(1, 2)) == Url("memory://a/b")
    assert Network() == Network(timeout=30, deadline=300)
