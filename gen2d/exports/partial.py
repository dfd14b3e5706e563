"""The folder beside an export in which its parts are collected, so that an export that was stopped can go on."""

import contextlib
import os
import time
from pathlib import Path

from gen2d.core.errors import FolderError, argument
from gen2d.storage.atomic import publish, remove_tree
from gen2d.storage.leases import exclusive_lock
from gen2d.storage.sealed import JSON_BYTES, as_json, parse_json, read_bytes

NOTES = "notes"
SECONDS = 5.0  # between two notes of the parts that are done, each after all files are flushed to the disk


class PartialExport:
    """Context with the folder `.NAME.partial` beside the output NAME, which one process at a time uses.

    `files` is the folder of the files, `notes` that of `Source.notes`, and `done` the first places of the parts that
    are there. What another export has left, by `identity`, is removed. If the block fails, the folder stays;
    `remove` removes it.
    """

    def __init__(self, out: Path, identity: str) -> None:
        self.out, self.identity = out, identity
        self.folder = out.with_name(f".{out.name}.partial")
        self.files, self.notes, self._done = self.folder / "files", self.folder / NOTES, self.folder / "done.json"
        self.done: set[int] = set()
        self._open, self._noted = contextlib.ExitStack(), 0.0

    def __enter__(self) -> "PartialExport":
        self.folder.mkdir(exist_ok=True)
        try:
            self._open.enter_context(exclusive_lock(self.folder / "lock", 0.0))
        except TimeoutError:
            raise FolderError(
                f"{self.out} is being written by another process: wait, or choose another {argument('out')}"
            ) from None
        for path in self.folder.glob(".part-*"):  # of processes that were killed
            remove_tree(path)
        with contextlib.suppress(OSError):
            stated = parse_json(read_bytes(self._done, JSON_BYTES)) or {}
            if stated.get("identity") == self.identity and self.files.is_dir() and self.notes.is_dir():
                self.done = set(stated["done"])
        if not self.done:
            for folder in (self.files, self.notes):
                remove_tree(folder)
                folder.mkdir()
        self._noted = time.monotonic()
        return self

    def add(self, part: int) -> None:
        """Note that a part is done, now or within some seconds."""
        self.done.add(part)
        if time.monotonic() - self._noted >= SECONDS:
            self._note()

    def _note(self) -> None:
        os.sync()
        publish(self._done, as_json({"identity": self.identity, "done": sorted(self.done)}))
        self._noted = time.monotonic()

    def remove(self) -> None:
        """Remove the folder."""
        remove_tree(self.folder)

    def __exit__(self, *_: object) -> None:
        with self._open:
            if self.folder.is_dir() and self.files.is_dir():
                if self.done:
                    self._note()
                else:
                    self.remove()
