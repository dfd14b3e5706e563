"""Whatever a stranger's dataset holds, it is read, or refused in one sentence, and does no harm.

Each is tried in a process forked from a warm one, so that a signal that ends it is seen.
"""

import contextlib
import dataclasses
import io
import json
import os
import select
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import buckets
import crafted
import pytest
import synthetic

import gen2d
from gen2d.cli.main import main
from gen2d.core.errors import Error
from gen2d.storage import retries
from gen2d.storage.paths import place
from gen2d.storage.retries import Network
from gen2d.tools.view import Library, NotFoundError

SECONDS = 10.0  # for one action
MANY = int(os.environ.get("CRAFTED_DATASETS", "1000"))  # of the third tier: 10,000 take an hour and a half


def tried(root: str, folder: Path, writable: bool) -> Iterator[str]:
    """Does with a dataset what people do, and yields the name of each action before it; raises what none should."""
    levels = ("quick", "full", "regen") if writable else ("full",)
    verbs = [("verify", root, "--level", level) for level in levels]
    verbs += [("info", root), ("preview", root, "--videos", "1", "--out", str(folder / "pictures"))]
    verbs += [("export", root, "--to", "npz", "--overwrite", "--out", str(folder / "npz"))]
    verbs += [("preview", root, "--videos", "1", "--out", root)] if writable else []
    verbs += [("verify", root, "--repair"), ("clean", root)] if writable else []
    for split in (None, "test"):
        yield f"open {split}"
        with contextlib.suppress(Error):
            ds = gen2d.open(root, split, "*", timeout=2, deadline=4)
            for number in (0, -1):
                with contextlib.suppress(Error):
                    ds[number]
            ds[:]
    yield "view"
    with contextlib.suppress(Error):
        library = Library(place(root, Network(2, 4)))
        library.page()
        for split in ("train", "test"):
            with contextlib.suppress(Error, NotFoundError):
                library.numbers(split, "0", '[["index", "0", "3"]]')
                library.video(split, "0")
    for words in verbs:
        yield " ".join(words)
        out, errors = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
            try:
                code = main([*words, "--timeout", "2", "--deadline", "4"])
            except SystemExit as end:
                code = end.code
        assert code in (0, 1, 2, 3), code
        assert "Traceback" not in errors.getvalue()
        assert all(c.isprintable() or c == "\n" for c in out.getvalue() + errors.getvalue()), out.getvalue()
        assert errors.getvalue().count("\n") <= 1 or code == 0, errors.getvalue()


@dataclasses.dataclass
class Trial:
    """A forked process that tries datasets one after the other; another takes its place when it ends."""

    pristine: Path
    home: Path
    server: buckets.Files
    process: int = 0

    def start(self) -> None:
        questions, answers = os.pipe(), os.pipe()
        self.process = os.fork()
        if not self.process:
            for number in (questions[1], answers[0]):
                os.close(number)
            self._serve(questions[0], answers[1])
            os._exit(0)
        for number in (questions[0], answers[1]):
            os.close(number)
        self.ask, self.answer = questions[1], answers[0]

    def stop(self) -> int:
        """How the process ended; it is ended if it has not."""
        os.close(self.ask)
        os.close(self.answer)
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.process, signal.SIGKILL)
        return os.waitstatus_to_exitcode(os.waitpid(self.process, 0)[1])

    def _serve(self, questions: int, answers: int) -> None:
        with os.fdopen(questions) as lines, os.fdopen(answers, "w") as out:
            for line in lines:
                seed = int(line)
                folder = self.home / f"{seed}"
                folder.mkdir()
                damage = fault = ""
                try:
                    damage = crafted.craft(self.pristine, folder / "data", seed)
                    for root, writable in ((self.server.url(folder / "data"), False), (str(folder / "data"), True)):
                        for action in tried(root, folder, writable):
                            print(json.dumps({"doing": action, "what": damage}), file=out, flush=True)
                except BaseException as error:
                    fault = f"{type(error).__name__}: {error}"
                print(json.dumps({"done": True, "fault": fault, "what": damage}), file=out, flush=True)

    def faults(self, seed: int) -> list[str]:
        """What went wrong with the dataset of this seed."""
        os.write(self.ask, f"{seed}\n".encode())
        doing, buffer, began = "", b"", time.monotonic()
        while True:
            if not select.select([self.answer], [], [], max(0.0, began + SECONDS - time.monotonic()))[0]:
                self.stop()
                self.start()
                return [f"{seed}: {doing} hung"]
            part = os.read(self.answer, 2**16)
            if not part:
                code = self.stop()
                self.start()
                return [f"{seed}: {doing} ended the process: {code}"]
            buffer += part
            *lines, buffer = buffer.split(b"\n")
            for line in lines:
                about: dict[str, Any] = json.loads(line)
                if about.get("done"):
                    return [f"{seed}: {about['what']}: {doing}: {about['fault']}"] if about["fault"] else []
                doing, began = f"{about['what']}: {about['doing']}", time.monotonic()


def outside(home: Path, seed: int, known: set[str]) -> list[str]:
    """Files that something wrote where nothing may be written."""
    folder, away = home / f"{seed}", home / f"{seed}" / "away"
    allowed = {"data", "pictures", "npz", "evil.py", "away", "victim"}
    victim = folder / "victim"
    if victim.exists() and victim.read_bytes() != b"precious":
        return [f"{seed}: a file outside was overwritten"]
    found = [f"{seed}: {path} was written" for path in folder.iterdir() if path.name not in allowed]
    return found + [f"{seed}: {path} was written" for path in away.rglob("*") if path.name not in known]


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.folder(synthetic.make(synthetic.dataset(tmp_path_factory.mktemp("pristine") / "data", train=10)))


@pytest.mark.parametrize(
    "count", [60, pytest.param(200, marks=pytest.mark.full), pytest.param(MANY, marks=pytest.mark.slow)]
)
def test_a_crafted_dataset_does_no_harm(
    pristine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    monkeypatch.setattr(retries, "PAUSE", 0.01)
    import gen2d.generation.regenerate  # noqa: F401  warms up what a child would import

    known = {path.name for path in pristine.rglob("*")}
    with buckets.serving_files(tmp_path) as server:
        trial, faults = Trial(pristine, tmp_path, server), []
        trial.start()
        for seed in range(count):
            found = trial.faults(seed) + outside(tmp_path, seed, known)
            print(*found, sep="\n", end="\n" if found else "", flush=True)
            faults += found
            shutil.rmtree(tmp_path / f"{seed}", ignore_errors=True)
        trial.stop()
    assert faults == []
