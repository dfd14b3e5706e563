"""Mutants: small errors, each put into a copy of the project, that the tests named beside it must notice.

`python tests/mutants.py` applies every mutant of `tests/mutations/*.toml` and runs its tests:

    [[mutant]]
    name = "a file is renamed before its bytes are on the disk"
    file = "gen2d/storage/atomic.py"
    old = "os.fsync(file.fileno())"  # occurs exactly once in the file
    new = "pass"
    tests = ["tests/storage/test_disks.py::test_a", "tests/storage/test_disks.py::test_b"]  # arguments of pytest

`-k` and its expression may follow the tests, as the last arguments. A mutant is killed if a test fails. It is an error,
not a kill, if its tests do not run, end in time or get past their fixtures, or if they fail because the mutant is not a
program: a name or an import that does not exist.

Mutants share the tests' cache of compiled programs, whose keys hold the sources: write none that changes these keys.
"""

import argparse
import ast
import collections
import concurrent.futures
import contextlib
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
TABLES = Path(__file__).parent / "mutations"
BROKEN = re.compile(r"\b(NameError|UnboundLocalError|SyntaxError|IndentationError|ImportError|ModuleNotFoundError)\b")


class Mutant(NamedTuple):
    """A change of one place in one file, and the tests that must notice it."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


class Result(NamedTuple):
    """Verdict on a mutant, the reason for it, and the seconds that its tests took."""

    verdict: str
    reason: str
    seconds: float


def read_mutants(pattern: str = "") -> list[Mutant]:
    """All mutants whose name, file or table matches a regular expression."""
    mutants = []
    for table in sorted(TABLES.glob("*.toml")):
        for row in tomllib.loads(table.read_text())["mutant"]:
            mutant = Mutant(**{**row, "tests": tuple(row["tests"])})
            if any(re.search(pattern, text) for text in (mutant.name, mutant.file, table.name)):
                mutants.append(mutant)
    return mutants


def mutated(mutant: Mutant, root: Path = ROOT) -> str:
    """Text of the mutant's file with the error in it."""
    text = (root / mutant.file).read_text()
    if text.count(mutant.old) != 1:
        raise ValueError(f"the old text occurs {text.count(mutant.old)} times in {mutant.file}")
    return text.replace(mutant.old, mutant.new)


def why_invalid(mutant: Mutant) -> str:
    """Sentence that says what is wrong with a row of a table, '' if nothing is."""
    try:
        ast.parse(mutated(mutant))
    except (OSError, ValueError, SyntaxError) as error:
        return str(error)
    if mutant.old == mutant.new:
        return "the change changes nothing"
    for test in mutant.tests[: mutant.tests.index("-k") if "-k" in mutant.tests else None]:
        path, *names = re.sub(r"\[.*", "", test).split("::")
        text = (ROOT / path).read_text() if (ROOT / path).is_file() else None
        if text is None or any(not re.search(rf"\b(def|class) {name}\b", text) for name in names):
            return f"no test {test}"
    return "" if mutant.tests else "it names no tests"


def copy_checkout(folder: Path) -> Path:
    """Copy of all files of the working tree that git tracks, or would track."""
    words = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(words, cwd=ROOT, capture_output=True, check=True, text=True).stdout.split("\0"):
        if name and os.path.lexists(ROOT / name):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name, follow_symlinks=False)
    return folder


def run_tests(root: Path, tests: tuple[str, ...], timeout: float, *options: str) -> tuple[int | None, str]:
    """Exit code of pytest in a copy, None if it did not end in time, and what it printed."""
    words = [sys.executable, "-m", "pytest", "-x", "-q", "-rfE", "-n", "0", "-m", "", "-p", "no:cacheprovider"]
    words += [f"--basetemp={root.parent / 'temporary'}", *options, *tests]
    environment = os.environ | {"PYTHONPATH": str(root), "COLUMNS": "240"}
    with (root.parent / "output").open("w+") as output:
        process = subprocess.Popen(
            words, cwd=root, env=environment, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            code = process.wait(timeout)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # also what the tests started and left
            process.wait()
        output.seek(0)
        return code, output.read()


def verdict(code: int | None, output: str) -> tuple[str, str]:
    """Verdict on a mutant, and the reason for it, from pytest's exit code and output."""
    failed = [line for line in output.splitlines() if line.startswith("FAILED ")]
    if code == 0 and re.search(r"\b(passed|xfailed)\b", output):
        return "survivor", ""
    if code is None:
        return "error", "its tests do not end in time"
    if code != 1 or not failed:
        return "error", f"no test ran to a result, and pytest ended with code {code}: {output.strip()[-600:]}"
    if BROKEN.search(failed[0]):
        return "error", failed[0]
    return "killed", failed[0].removeprefix("FAILED ")


def try_mutant(mutant: Mutant, index: int, root: Path, timeout: float) -> Result:
    """Result of a mutant's tests in a copy, which is left as it was."""
    path, start = root / mutant.file, time.monotonic()
    original, times = path.read_bytes(), path.stat()
    try:
        path.write_text(mutated(mutant, root))
        os.utime(path, (index + 1, index + 1))  # a compiled module is stale if its file's time is another
        return Result(*verdict(*run_tests(root, mutant.tests, timeout)), time.monotonic() - start)
    except ValueError as error:
        return Result("error", str(error), 0.0)
    finally:
        path.write_bytes(original)
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def baseline(mutants: list[Mutant], root: Path, timeout: float, *options: str) -> bool:
    """Whether the tests pass, or with `--collect-only` exist, where nothing is changed."""
    plain = sorted({test for mutant in mutants if "-k" not in mutant.tests for test in mutant.tests})
    selected = {mutant.tests for mutant in mutants if "-k" in mutant.tests}
    for tests in [tuple(plain), *sorted(selected)]:
        code, output = run_tests(root, tests, timeout, *options) if tests else (0, "")
        if code != 0:
            print(output)
            print(f"Without mutants, pytest ended with code {code}: {' '.join(tests)}")
            return False
    return True


def main() -> int:
    """Exit code 0 if all mutants are killed."""
    parser = argparse.ArgumentParser(description="Errors put into the project one at a time, and whether tests fail.")
    parser.add_argument("--only", metavar="PATTERN", default="", help="regular expression of names, files or tables")
    parser.add_argument("--jobs", metavar="N", type=int, default=1, help="mutants at a time (1)")
    parser.add_argument("--timeout", metavar="SECONDS", type=float, default=300, help="for the tests of a mutant (300)")
    parser.add_argument("--check", action="store_true", help="check only that mutants apply and that their tests exist")
    parser.add_argument("--no-baseline", action="store_true", help="do not run the tests without mutants first")
    chosen = parser.parse_args()
    mutants = read_mutants(chosen.only)
    invalid = {mutant.name: why for mutant in mutants if (why := why_invalid(mutant))}
    for name, why in invalid.items():
        print(f"invalid   {name}: {why}")
    if invalid:
        return 1
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copies: queue.Queue[Path] = queue.Queue()
        for job in range(chosen.jobs):
            copies.put(copy_checkout(Path(folder, str(job), "copy")))
        root = Path(folder, "0", "copy")
        if chosen.check:
            return 0 if baseline(mutants, root, 3600, "--collect-only") else 1
        if not chosen.no_baseline and not baseline(mutants, root, 3600):
            return 1

        def attempt(index: int) -> Result:
            copy = copies.get()
            try:
                return try_mutant(mutants[index], index, copy, chosen.timeout)
            finally:
                copies.put(copy)

        totals, seconds = collections.Counter[str](), 0.0
        with concurrent.futures.ThreadPoolExecutor(chosen.jobs) as pool:
            for mutant, result in zip(mutants, pool.map(attempt, range(len(mutants))), strict=True):
                totals[result.verdict] += 1
                seconds += result.seconds
                print(f"{result.verdict:9} {result.seconds:5.1f} s  {mutant.file}: {mutant.name}", flush=True)
                print(f"{'':19}{result.reason}\n" if result.reason else "", end="", flush=True)
    print(f"\n{len(mutants)} mutants in {seconds:.0f} s of tests")
    for name in ("killed", "survivor", "error"):
        print(f"{name:9} {totals[name]:5}")
    return 0 if totals["killed"] == len(mutants) else 1


if __name__ == "__main__":
    sys.exit(main())
