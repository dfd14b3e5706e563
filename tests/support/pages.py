"""Pages of the documentation: their blocks of code, run in an empty folder with fewer videos and steps.

`sh` blocks hold commands of gen2d and lines that install it, `yaml` blocks a config that begins with its name,
`python` blocks a program, or a plug-in that begins with its name. `bash` and `text` are not run: they need other
machines, or show output.
"""

import functools
import importlib.util
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from ruamel.yaml import YAML
from tiny import run_command

from gen2d.config.config import load_config

ROOT = Path(__file__).parents[2]
DOCS = [path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "docs").rglob("*.md"))]
LANGUAGES = {"sh", "yaml", "python", "bash", "text"}
FOREIGN = {"gen2d.job.yaml", "cluster.yaml"}  # of other programs
OPTIONAL = "datasets", "ray", "torch"  # packages without which blocks that need them are left out
FEWER = {"--n": "40", "--workers": "1"}  # videos; workers, as a test has one core


@functools.cache
def blocks(page: str) -> list[tuple[str, str]]:
    """Language and text of each block of a page."""
    return re.findall(r"^```(\w*)\n(.*?)^```$", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def commands(block: str) -> Iterator[list[str]]:
    """Arguments of the commands of gen2d in an `sh` block, which has no others but installations."""
    for line in block.splitlines():
        words = shlex.split(line.rpartition("&& ")[2] if "pip install" in line else line, comments=True)
        if words[:3] == ["python", "-m", "gen2d"]:
            yield words[3:]
        else:
            assert not words or "pip install" in line, f"nothing runs {line!r}: write it into a block `bash`"


def dataset_of(arguments: list[str]) -> str | None:
    """Name of the dataset that a command makes."""
    if "--config" not in arguments or arguments[0] != "--config":
        return None
    given = arguments[arguments.index("--out") + 1] if "--out" in arguments else arguments[1].removesuffix(".yaml")
    return given.removeprefix("datasets/")


@functools.cache
def makers() -> dict[str, tuple[str, list[str]]]:
    """Page and first command that makes each dataset."""
    found: dict[str, tuple[str, list[str]]] = {}
    for page in ("README.md", *DOCS):
        for kind, block in blocks(page):
            for arguments in commands(block) if kind == "sh" else ():
                name = dataset_of(arguments)
                if name is not None and "ray" not in arguments:
                    found.setdefault(name, (page, arguments))
    return found


class Reader:
    """A reader, who runs the blocks of pages in a folder."""

    def __init__(self, folder: Path, store: Path) -> None:
        """`store` keeps datasets that pages read and other pages make."""
        self.folder, self.store = folder, store
        self.compared = 0  # models with what they must beat
        self.left_out: set[str] = set()  # packages that are not installed

    def run(self, kind: str, block: str) -> None:
        """Run a block. Raises AssertionError if it fails."""
        assert kind in LANGUAGES, f"{kind!r} is none of {LANGUAGES}"
        if kind == "yaml":
            self.write_config(block)
        elif kind == "sh":
            for arguments in commands(block):
                self.run_command(arguments)
        elif kind == "python" and (named := re.match(r"# (\w+\.py)\n", block)):
            (self.folder / named[1]).write_text(block)
        elif kind == "python":
            self.run_python(block)

    def write_config(self, block: str) -> None:
        """Write a config under the name that it begins with."""
        name, config = block.partition("\n")[0].removeprefix("# "), block.replace("videos: 1000", "videos: 8")
        assert name.endswith(".yaml"), f"{block!r} must begin with the name of its file"
        (self.folder / name).write_text(config)
        if name in FOREIGN:
            assert YAML(typ="safe").load(config)
        else:
            assert load_config(self.folder / name).name == name.removesuffix(".yaml")

    def run_command(self, arguments: list[str]) -> None:
        """Run a command of gen2d, with few videos, after those that make the datasets that it reads."""
        if "ray" in arguments and self.lacks("ray"):
            return
        made = dataset_of(arguments)
        self.provide({name for word in arguments for name in re.findall(r"^datasets/(\w+)", word)} - {made})
        before = ["", *arguments]
        fewer = [FEWER.get(flag, word) for flag, word in zip(before, arguments, strict=False)]
        done = run_command(*fewer, cwd=self.folder)
        assert done.returncode == 0, f"{arguments}\n{done.stderr}"
        assert made is None or (self.folder / "datasets" / made / "manifest.json").is_file(), arguments

    def run_python(self, block: str) -> None:
        """Run a program; the error that it prints must be less than that beside it."""
        imported = set(re.findall(r"^ *(?:import|from) (\w+)", block, re.MULTILINE))
        if any(self.lacks(name) for name in OPTIONAL if name in imported):
            return
        self.provide(set(re.findall(r'(?<!out=)"datasets/(\w+)', block)))
        shorter = block.replace("150", "50") if "gen2d.stream" in block else block  # batches, still enough to win
        words = [sys.executable, "-c", shorter]
        done = subprocess.run(words, cwd=self.folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, block + done.stderr
        printed = re.search(r"error ([\d.]+), of .* ([\d.]+)", done.stdout)
        assert printed is None or float(printed[1]) < 0.9 * float(printed[2]), done.stdout
        self.compared += printed is not None

    def lacks(self, name: str) -> bool:
        """Whether a package is not installed."""
        if importlib.util.find_spec(name) is None:
            self.left_out.add(name)
        return name in self.left_out

    def provide(self, names: set[str]) -> None:
        """Make the datasets of these names that the folder lacks, by the commands of the pages."""
        for name in sorted(names):
            if (self.folder / "datasets" / name).exists():
                continue
            assert name in makers(), f"no page makes datasets/{name}"
            page, arguments = makers()[name]
            if not (self.store / "datasets" / name).exists():
                other = Reader(self.store, self.store)
                for kind, block in blocks(page):
                    if kind == "yaml" and block.startswith(f"# {arguments[1]}\n"):
                        other.write_config(block)
                other.run_command(arguments)
            shutil.copytree(self.store / "datasets" / name, self.folder / "datasets" / name)
