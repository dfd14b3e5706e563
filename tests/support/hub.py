"""A stand-in for the Hugging Face Hub on this machine: repositories of files, as huggingface_hub and datasets ask.

As on the Hub, files of binary formats and large ones are uploaded by Git LFS, whole or in parts, and the others within
the commit. It does not speak Xet.
"""

import base64
import contextlib
import hashlib
import json
import re
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlparse

SHA = "0123456789abcdef" * 2 + "01234567"  # of every commit
LFS = (".h5", ".parquet", ".tar", ".mp4", ".mkv", ".npz", ".npy", ".zst")  # files that are always uploaded by Git LFS
LFS_BYTES = 10 * 2**20  # smallest size of other files that are


class Hub(ThreadingHTTPServer):
    """Files of each repository by name, and all that was asked."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.repositories: dict[str, dict[str, bytes]] = {}
        self.private: dict[str, bool] = {}
        self.objects: dict[str, bytes] = {}  # of Git LFS, by sha256
        self.parts: dict[str, dict[int, bytes]] = {}  # of objects that are not yet complete
        self.part_bytes = 0  # size of the parts in which objects are uploaded; 0: whole
        self.lfs_refusal = 0  # HTTP status of uploads of objects
        self.asked: list[str] = []
        self.refusal = 0  # HTTP status of all answers

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    server: Hub  # pyright: ignore[reportIncompatibleVariableOverride]
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""

    def answer(self, content: object, code: int = 200, **headers: str) -> None:
        body = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(code)
        headers.setdefault("Content-Type", "application/json")
        if "Content-Length" not in headers:
            headers["Content-Length"] = str(len(body))
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        path = urlparse(self.path).path
        self.server.asked.append(f"POST {path}")
        if self.server.refusal:
            self.answer({"error": "no"}, self.server.refusal)
        elif path == "/api/repos/create":
            asked = json.loads(body)
            name = f"{asked.get('organization') or 'me'}/{asked['name']}"
            if name in self.server.repositories:
                self.answer({"error": "there", "url": f"{self.server.url}/datasets/{name}"}, 409)
                return
            self.server.repositories[name], self.server.private[name] = (
                {".gitattributes": b""},
                bool(asked.get("private")) or asked.get("visibility") == "private",
            )
            self.answer({"url": f"{self.server.url}/datasets/{name}", "name": name, "id": SHA[:24]})
        elif path == "/api/validate-yaml":
            self.answer({"errors": [], "warnings": []})
        elif found := re.fullmatch(r"/api/datasets/(.+)/preupload/[^/]+", path):
            files = [
                {"path": file["path"], "uploadMode": _mode(file), "shouldIgnore": False, "oid": None}
                for file in json.loads(body)["files"]
            ]
            self.answer({"files": files})
        elif found := re.fullmatch(r"/api/datasets/(.+)/commit/[^/]+", path):
            files = self.server.repositories[found[1]]
            for line in map(json.loads, body.splitlines()):
                value = line["value"]
                if line["key"] == "file":
                    files[value["path"]] = base64.b64decode(value["content"])
                elif line["key"] == "lfsFile":
                    files[value["path"]] = self.server.objects[value["oid"]]
                elif line["key"] == "deletedFile":
                    del files[value["path"]]
            self.answer({"commitUrl": f"{self.server.url}/datasets/{found[1]}/commit/{SHA}", "commitOid": SHA})
        elif found := re.fullmatch(r"/datasets/(.+)\.git/info/lfs/objects/batch", path):
            self.answer({"transfer": "basic", "objects": [self._upload(each) for each in json.loads(body)["objects"]]})
        elif found := re.fullmatch(r"/lfs/complete/(\w+)", path):
            parts = self.server.parts.pop(found[1])
            self._keep(found[1], b"".join(parts[number["partNumber"]] for number in json.loads(body)["parts"]))
        elif found := re.fullmatch(r"/lfs/verify", path):
            self.answer({}, 200 if json.loads(body)["oid"] in self.server.objects else 404)
        elif found := re.fullmatch(r"/api/datasets/(.+)/paths-info/[^/]+", path):
            files, names = self.server.repositories[found[1]], self._names(body)
            self.answer([_entry(name, files[name]) for name in names if name in files])
        else:
            self.answer({}, 404)

    def _names(self, body: bytes) -> list[str]:
        if self.headers.get("Content-Type", "").startswith("application/json"):
            return json.loads(body)["paths"]
        return [unquote(part.removeprefix("paths=").replace("+", " ")) for part in body.decode().split("&")]

    def _upload(self, wanted: dict[str, Any]) -> dict[str, Any]:
        """Where an object of Git LFS is uploaded to, unless it is there."""
        oid, size, url, part = wanted["oid"], wanted["size"], self.server.url, self.server.part_bytes
        if oid in self.server.objects:
            return {"oid": oid, "size": size}
        upload: dict[str, Any] = {"href": f"{url}/lfs/whole/{oid}"}
        if part:
            urls = {str(number): f"{url}/lfs/part/{oid}/{number}" for number in range(1, -(-size // part) + 1)}
            upload = {"href": f"{url}/lfs/complete/{oid}", "header": {"chunk_size": str(part), **urls}}
        return {"oid": oid, "size": size, "actions": {"upload": upload, "verify": {"href": f"{url}/lfs/verify"}}}

    def _keep(self, oid: str, content: bytes) -> None:
        if hashlib.sha256(content).hexdigest() != oid:
            self.answer({"error": "other content"}, 422)
            return
        self.server.objects[oid] = content
        self.answer({}, ETag='"whole"')

    def do_PUT(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        self.server.asked.append(f"PUT {self.path}")
        if self.server.lfs_refusal:
            self.answer({"error": "no"}, self.server.lfs_refusal)
        elif found := re.fullmatch(r"/lfs/part/(\w+)/(\d+)", self.path):
            self.server.parts.setdefault(found[1], {})[int(found[2])] = body
            self.answer({}, ETag=f'"{found[2]}"')
        elif found := re.fullmatch(r"/lfs/whole/(\w+)", self.path):
            self._keep(found[1], body)
        else:
            self.answer({}, 404)

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        url = urlparse(self.path)
        path = unquote(url.path)
        self.server.asked.append(f"{self.command} {path}")
        if self.server.refusal:
            self.answer({"error": "no"}, self.server.refusal)
        elif path == "/api/whoami-v2":
            self.answer({"name": "me", "type": "user", "orgs": [], "auth": {}})
        elif found := re.fullmatch(r"/api/datasets/([^/]+/[^/]+)/tree/[^/]+(?:/(.*))?", path):
            self._tree(found[1], found[2] or "", "recursive=true" in url.query.lower())
        elif found := re.fullmatch(r"/api/datasets/([^/]+/[^/]+)(?:/revision/[^/]+)?", path):
            self._repository(found[1])
        elif found := re.fullmatch(r"/datasets/([^/]+/[^/]+)/resolve/[^/]+/(.+)", path):
            self._file(self.server.repositories.get(found[1], {}).get(found[2]))
        else:
            self.answer({}, 404)

    def _repository(self, name: str) -> None:
        files = self.server.repositories.get(name)
        if files is None:
            self.answer({"error": "Repository not found"}, 404, X_Error_Code="RepoNotFound")
            return
        siblings = [{"rfilename": file} for file in files]
        self.answer({"id": name, "sha": SHA, "private": False, "tags": [], "siblings": siblings, "downloads": 0})

    def _tree(self, name: str, folder: str, recursive: bool) -> None:
        files = self.server.repositories.get(name)
        if files is None:
            self.answer({"error": "Repository not found"}, 404, X_Error_Code="RepoNotFound")
            return
        prefix, entries, folders = f"{folder}/" if folder else "", [], set()
        for file, content in sorted(files.items()):
            if not file.startswith(prefix):
                continue
            first, slash, _ = file.removeprefix(prefix).partition("/")
            if slash and f"{prefix}{first}" not in folders:
                folders.add(f"{prefix}{first}")
                entries.append({"type": "directory", "oid": SHA, "size": 0, "path": f"{prefix}{first}"})
            if recursive or not slash:
                entries.append(_entry(file, content))
        if folder and not entries:
            self.answer({"error": "not found"}, 404, X_Error_Code="EntryNotFound")
            return
        self.answer(entries)

    def _file(self, content: bytes | None) -> None:
        if content is None:
            self.answer({"error": "Entry not found"}, 404, X_Error_Code="EntryNotFound")
            return
        headers = {"ETag": f'"{_oid(content)}"', "X_Repo_Commit": SHA, "Content-Type": "application/octet-stream"}
        headers["Accept_Ranges"] = "bytes"
        if found := re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", "")):
            begin, end = int(found[1]), min(int(found[2] or len(content)), len(content) - 1)
            headers["Content_Range"] = f"bytes {begin}-{end}/{len(content)}"
            self.answer(content[begin : end + 1], 206, **headers)
        else:
            self.answer(content, 200, **headers)


def _mode(file: dict[str, Any]) -> str:
    return "lfs" if file["path"].endswith(LFS) or file["size"] >= LFS_BYTES else "regular"


def _oid(content: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


def _entry(name: str, content: bytes) -> dict[str, object]:
    return {"type": "file", "oid": _oid(content), "size": len(content), "path": name}


@contextlib.contextmanager
def hub() -> Iterator[Hub]:
    """A running stand-in."""
    with Hub() as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield server
        finally:
            server.shutdown()
