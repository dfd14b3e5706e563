"""The server of `gen2d view` answers to this machine alone, and only with what the page needs."""

import http.client
import json
import re
import subprocess
import threading
import time
import urllib.parse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import synthetic
import tiny

from gen2d.core.errors import UserError
from gen2d.dataset.manifest import describe, read_manifest
from gen2d.dataset.manifest_parser import ShardTable
from gen2d.storage.sealed import as_json, sha256
from gen2d.tools.view import Library, serving


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, int]]:
    """A dataset and the port of its server."""
    root = tmp_path_factory.mktemp("served") / "toy"
    synthetic.make(synthetic.dataset(root, train=40))
    with serving(Library(root), 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield root, server.server_port
        server.shutdown()
        thread.join()


def ask(port: int, path: str, host: str | None = None, method: str = "GET") -> tuple[int, bytes]:
    """Status and content of the answer to a request."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
    connection.putheader("Host", f"127.0.0.1:{port}" if host is None else host)
    connection.endheaders()
    answer = connection.getresponse()
    status, content = answer.status, answer.read()
    connection.close()
    return status, content


def test_the_page_and_its_videos_are_served(served: tuple[Path, int]) -> None:
    root, port = served
    status, content = ask(port, "/")
    assert (status, content[:15]) == (200, b"<!doctype html>")
    status, content = ask(port, "/video?split=train&number=39")
    assert status == 200
    assert json.loads(content)["number"] == 39
    assert root.name == "toy"


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "localhost", "127.0.0.1:1", "", "0.0.0.0:{port}"]
)
def test_another_name_of_the_host_is_refused(served: tuple[Path, int], host: str) -> None:
    _, port = served
    assert ask(port, "/", host.format(port=port))[0] == 403
    assert ask(port, "/video?split=train&number=0", host.format(port=port))[0] == 403
    assert ask(port, "/", f"localhost:{port}")[0] == 200


PATHS = (
    *("/manifest.json", "/../toy/manifest.json", "/shards/train-00000.h5", "//etc/passwd", "/%2e%2e/", "/index.html"),
    *("/video", "/video?split=train", "/video?split=none&number=0", "/video?split=train&number=40"),
    *("/video?split=train&number=-1", "/video?split=train&number=1e3", "/video?split=train&number=%D9%A3"),
    "/video?split=train&number=99999999999999999999999999",
    *("/videos?split=train&offset=0", "/videos?split=train&offset=0&rules=", "/videos?split=train&offset=0&rules=[1]"),
    '/videos?split=train&offset=0&rules=[["objects/mass","0","1"]]',
    '/videos?split=train&offset=0&rules=[["quality/contacts","nan","1"]]',
    "/videos?split=train&offset=-1&rules=[]",
)


@pytest.mark.parametrize("path", PATHS)
def test_nothing_else_is_served(served: tuple[Path, int], path: str) -> None:
    assert ask(served[1], path.replace('"', "%22"))[0] == 404
    assert ask(served[1], "/", method="POST")[0] == 501


def test_filters_find_the_videos_whose_values_lie_within(served: tuple[Path, int]) -> None:
    root, port = served
    values = synthetic.stored(root)["quality/contacts"]
    low, high = np.sort(values)[[8, 30]].tolist()
    rules = urllib.parse.quote(json.dumps([["quality/contacts", str(low), str(high)], ["index", "-Infinity", "30"]]))
    found = json.loads(ask(port, f"/videos?split=train&offset=0&rules={rules}")[1])
    expected = [number for number, value in enumerate(values) if low <= value <= high and number <= 30]
    assert found == {"numbers": expected[:24], "total": len(expected), "of": 40}
    assert 0 < len(expected) < 30
    later = json.loads(ask(port, "/videos?split=train&offset=24&rules=[]")[1])
    assert later == {"numbers": list(range(24, 40)), "total": 40, "of": 40}


def test_damage_is_one_sentence(tmp_path: Path) -> None:
    synthetic.make(synthetic.dataset(tmp_path))
    with (tmp_path / "shards" / "train-00000.h5").open("r+b") as file:
        file.truncate(1000)
    with serving(Library(tmp_path), 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        status, content = ask(server.server_port, "/video?split=train&number=0")
        server.shutdown()
        thread.join()
    assert status == 500
    assert b"train-00000.h5" in content
    assert content.count(b"\n") == 0


def test_with_json_the_address_is_one_object(served: tuple[Path, int]) -> None:
    words, environment = tiny.command("view", served[0], "--port", 0, "--json")
    with subprocess.Popen(
        words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as server:
        assert server.stdout is not None
        about = json.loads(server.stdout.readline())
        status, _ = ask(urllib.parse.urlsplit(about["url"]).port or 0, "/")
        server.terminate()
    assert (status, about["event"], about["dataset"]) == (200, "serving", str(served[0]))


def test_a_busy_port_is_one_sentence(served: tuple[Path, int]) -> None:
    root, port = served
    done = tiny.run_main("view", root, "--port", port)
    assert done.returncode == 2
    assert re.fullmatch(rf"gen2d: port {port} is in use: choose another with --port, or 0 .*\n", done.stderr)
    assert tiny.run_main("view", root, "--port", 70000).returncode == 2
    assert tiny.run_main("view", root / "nothing.yaml").returncode == 2
    with pytest.raises(UserError, match="in use"), serving(Library(root), port):
        pass


def test_a_million_videos_open_at_once(tmp_path: Path) -> None:
    spec = synthetic.make(synthetic.small(tmp_path, {"train": 8}))
    manifest = read_manifest(tmp_path)
    count, size = 10**6, manifest.videos_per_shard
    content = bytes(manifest.shard_type.itemsize * (count // size))
    (tmp_path / f"index/train-{count}.npy").write_bytes(content)
    table = ShardTable(f"index/train-{count}.npy", sha256(content), count // size, 10**9, 10**6)
    grown = describe(spec, {"train": count}, {"train": table}, manifest.stats, manifest.files)
    (tmp_path / "manifest.json").write_bytes(as_json(grown.plain))
    began = time.perf_counter()
    library = Library(tmp_path)
    assert b"1,000,000 videos" in library.page()
    assert json.loads(library.numbers("train", "999990", "[]"))["numbers"] == list(range(999_990, count))
    assert time.perf_counter() - began < 2
