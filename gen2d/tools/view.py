"""A dataset's page with all its videos on demand, served to browsers on this machine."""

import contextlib
import errno
import json
import math
import tempfile
import threading
import urllib.parse
from collections.abc import Callable, Iterator, Mapping, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.core.errors import ConfigError, Error, UserError, argument
from gen2d.core.progress import Event, inform
from gen2d.dataset.manifest import Manifest, read_manifest
from gen2d.dataset.readme import card_split
from gen2d.loading.dataset import Dataset, ViewOptions
from gen2d.page.page import page
from gen2d.page.video import Detail, Videos, is_value
from gen2d.storage.paths import Url, place
from gen2d.storage.retries import Network

HOST, PORT = "127.0.0.1", 8017
DETAIL = Detail(frames=256, side=512, mask_side=256, quality=80, objects=256, contacts=1000)
PER_PAGE = 24  # videos in the gallery
SCANNED = 4096  # videos whose values are read at once
MAX_RULES = 20
CONFIG_VIDEOS = 24  # videos of a config


class NotFoundError(Exception):
    """A request for something that the server does not have."""


def view(
    source: str | Path | Url,
    port: int = PORT,
    *,
    seed: int | None = None,
    overrides: Sequence[str] = (),
    log: Callable[[str], None] = inform,
    timeout: float = 30.0,
    deadline: float = 300.0,
) -> None:
    """Serve the page of a dataset, or of a few videos of a config, until the process is interrupted.

    Parameters
    ----------
    source : str or path
        Folder or URL of a dataset, or the name or path of a config.
    port : int
        Port on this machine; 0 chooses a free one.
    seed : int, optional
        Seed of the videos of a config; by default that of the config.
    overrides : sequence of str
        Options of the config to change, such as 'video.height=128'.
    log : callable, optional
        Function that is called with the line that says where the page is, once it is served.
    timeout : float
        Limit in s of a server's silence, as in `open`.
    deadline : float
        Limit in s of a whole request, as in `open`.

    Raises
    ------
    UserError
        If the port is in use, or the source or an option is invalid.
    """
    if not 0 <= port < 2**16:
        raise ConfigError(f"{argument('port')} is {port}, but must be from 0 to 65535")
    with contextlib.ExitStack() as stack:
        root = place(source if isinstance(source, Url) else str(source), Network(timeout, deadline))
        if not (isinstance(root, Url) or root.is_dir()):
            from gen2d.generation.run import generate

            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="gen2d-view-"))
            root = Path(folder) / "videos"
            generate(str(source), n=CONFIG_VIDEOS, out=root, seed=seed, overrides=overrides)
        server = stack.enter_context(serving(Library(root), port))
        url = f"http://{HOST}:{server.server_port}/"
        log(Event.of(f"Showing {root} at {url} until you press Ctrl-C", "serving", dataset=f"{root}", url=url))
        server.serve_forever()


class Library:
    """The videos of a dataset: its page, single videos, and the numbers of those that match some rules."""

    def __init__(self, root: Any) -> None:
        self.manifest: Manifest = read_manifest(root)
        self.videos = {split: Videos(root, self.manifest, split) for split in self.manifest.splits}
        fields = self.manifest.fields
        values = [name for name, field in fields.items() if is_value(name, field, self.manifest)]
        self.numeric = [name for name in values if fields[name].axes == "n" and not fields[name].is_text]
        self.tables = {split: ValueTable(root, self.manifest, split) for split in self.manifest.splits}

    def page(self) -> bytes:
        """The page, which asks for videos."""
        return page(self.manifest, [], values=self.numeric, most=PER_PAGE, first=card_split(self.manifest))

    def video(self, split: str, number: str) -> bytes:
        """One video, as JSON."""
        if split not in self.videos or not number.isdecimal() or not number.isascii():
            raise NotFoundError
        if len(number) > 18 or int(number) >= len(self.videos[split]):
            raise NotFoundError
        return json.dumps(self.videos[split].video(int(number), DETAIL), allow_nan=False).encode()

    def numbers(self, split: str, offset: str, rules: str) -> bytes:
        """Numbers of a page of videos whose values lie within all bounds, as JSON; `rules` are names and two bounds."""
        if split not in self.videos or not offset.isdecimal() or not offset.isascii() or len(offset) > 18:
            raise NotFoundError
        count, first = len(self.videos[split]), int(offset)
        bounds = _bounds(rules, self.numeric)
        if bounds:
            matches = np.flatnonzero(self.tables[split].within(bounds))
            numbers, total = matches[first : first + PER_PAGE].tolist(), len(matches)
        else:
            numbers, total = list(range(first, min(count, first + PER_PAGE))), count
        return json.dumps({"numbers": numbers, "total": total, "of": count}).encode()


def _bounds(rules: str, names: Sequence[str]) -> list[tuple[str, float, float]]:
    """Name and bounds of each rule of a request."""
    try:
        given = json.loads(rules)
        bounds = [(str(name), float(low), float(high)) for name, low, high in given]
    except (ValueError, TypeError, RecursionError):
        raise NotFoundError from None
    if len(bounds) > MAX_RULES or any(
        name not in names or math.isnan(low) or math.isnan(high) for name, low, high in bounds
    ):
        raise NotFoundError
    return bounds


class ValueTable:
    """Values of all videos of a split, read when they are first asked for; all videos' frames stay unread."""

    def __init__(self, root: Any, manifest: Manifest, split: str) -> None:
        self.root, self.manifest, self.split = root, manifest, split
        self._values: dict[str, np.ndarray] = {}
        self._lock = threading.Lock()

    def within(self, bounds: Sequence[tuple[str, float, float]]) -> np.ndarray:
        """Whether the values of each video lie within all bounds, bool [n]."""
        found = np.ones(self.manifest.splits[self.split], bool)
        for name, low, high in bounds:
            values = self._column(name)
            found &= (values >= low) & (values <= high)
        return found

    def _column(self, name: str) -> np.ndarray:
        with self._lock:
            if name not in self._values:
                options = ViewOptions(self.split, (name,), None, 1, "first", "THWC", "uint8", "checksum")
                dataset, count = Dataset(self.root, self.manifest, options), self.manifest.splits[self.split]
                slices = (range(first, min(count, first + SCANNED)) for first in range(0, count, SCANNED))
                self._values[name] = np.concatenate([dataset.batch(numbers)[name] for numbers in slices])
            return self._values[name]


@contextlib.contextmanager
def serving(library: Library, port: int) -> Iterator[ThreadingHTTPServer]:
    """A server of the library at a port of this machine; raises UserError if that is in use."""

    class Handler(_Handler):
        pass

    Handler.library = library
    try:
        server = _Server((HOST, port), Handler)
    except OSError as error:
        if error.errno in (errno.EADDRINUSE, errno.EACCES):
            reason = "in use" if error.errno == errno.EADDRINUSE else "not allowed"
            raise UserError(
                f"port {port} is {reason}: choose another with {argument('port')}, or 0 for a free one"
            ) from None
        raise
    try:
        yield server
    finally:
        server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    allow_reuse_address = False  # a second server at the port must fail
    allow_reuse_port = False


class _Handler(BaseHTTPRequestHandler):
    """Answers to three paths; only to this machine's own names, so that no other web page can ask (DNS rebinding)."""

    library: Library
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "gen2d", ""
    timeout = 60

    def do_GET(self) -> None:
        assert isinstance(self.server, ThreadingHTTPServer)
        port = self.server.server_port
        if self.headers.get_all("Host") not in [[f"{name}:{port}"] for name in (HOST, "localhost")]:
            self._send(403, b"This server answers only to 127.0.0.1 and localhost.", "text/plain")
            return
        path, _, text = self.path.partition("?")
        try:
            query = dict(urllib.parse.parse_qsl(text, max_num_fields=10, strict_parsing=bool(text)))
            content, kind = self._answer(path, query)
            self._send(200, content, kind)
        except (NotFoundError, KeyError, ValueError):
            self._send(404, b"There is no such page.", "text/plain")
        except (Error, OSError) as error:
            self._send(500, str(error).encode("utf-8", "replace"), "text/plain")

    def _answer(self, path: str, query: Mapping[str, str]) -> tuple[bytes, str]:
        library, json_kind = self.library, "application/json"
        answers: dict[str, Callable[[], tuple[bytes, str]]] = {
            "/": lambda: (library.page(), "text/html"),
            "/video": lambda: (library.video(query["split"], query["number"]), json_kind),
            "/videos": lambda: (library.numbers(query["split"], query["offset"], query["rules"]), json_kind),
        }
        if path not in answers:
            raise NotFoundError
        return answers[path]()

    def _send(self, code: int, content: bytes, kind: str) -> None:
        self.send_response(code)
        headers = {
            "Content-Type": f"{kind}; charset=utf-8",
            "Content-Length": str(len(content)),
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            "Cross-Origin-Resource-Policy": "same-origin",
        }
        for name, value in headers.items():
            self.send_header(name, value)
        with contextlib.suppress(ConnectionError):  # the browser no longer waits for it
            self.end_headers()
            self.wfile.write(content)

    def log_message(self, format: str, *arguments: object) -> None:
        """Write nothing: the terminal shows only where the page is."""
