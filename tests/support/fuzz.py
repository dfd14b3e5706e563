"""Malformed configs: the shipped configs with random changes."""

import copy
import random
from collections.abc import Iterator, Mapping
from typing import Any

from gen2d.config.plugins import config_folder
from gen2d.config.reading import parse_yaml

JUNK: list[Any] = [
    None,
    True,
    False,
    0,
    1,
    -1,
    2,
    3,
    1e-9,
    1e9,
    1e13,
    -1e300,
    10**30,
    10**400,
    float("inf"),
    float("nan"),
    0.5,
    "",
    " ",
    "yes",
    "null",
    "[]",
    "1e3",
    "a" * 5000,
    "\x00",
    "\x1b[31m",
    "\ud800",
    "../../etc/passwd",
    "flat",
    "bouncing",
    "/dev/zero",
    "x.py",
    [],
    [[]],
    {},
    {"": {}},
    {"name": "flat"},
    {"name": []},
    [0, 1],
    [1, 0],
    [0, 0],
    [1, 2, 3],
    [None],
    ["a", "b"],
    [[0, 1], [2, 3]],
    {"uniform": [0, 1]},
    {"normal": [0, 0]},
    {"normal": [0, 1, 5, 6]},
    {"log_uniform": [0, 1]},
    {"choice": []},
    {"choice": [1, 2]},
    {"grid": [1, 2, 3]},
    {"grid": list(range(2000))},
    {"mixture": []},
    {"mixture": [[0, 1], 5], "weights": [1]},
    {"minus": [[0, 1], [0, 1]]},
    {"minus": [[0, 10], *([k / 10, k / 10 + 0.05] for k in range(99))]},
    {"intersection": [[0, 1], [2, 3]]},
    {"mixture": [{"mixture": [{"mixture": [1, 2]}, 3]}, 4]},
    {"condition": [{}, {}]},
    list(range(3000)),
    {str(k): k for k in range(3000)},
    {"a": {"b": {"c": {"d": {"e": {}}}}}},
    {"train": {}, "test": {}},
    {"train": {"videos": -1}},
    {"test": {"look": "nope"}},
    {"train": {"factors": {"radius": [0.1, 0.2]}}, "test": {"factors": {"radius": {"minus": [[0.1, 1], [0.1, 0.2]]}}}},
    b"bytes",
    2**63,
    -(2**63),
    1e-320,
    "∞",
    ["train", "test"],
    {1: 2},
    {None: None},
    {(1, 2): 3},
]

TEXTS = [
    "",
    "\n",
    "- 1",
    "1",
    "a: b: c",
    "{",
    "[" * 3000,
    "{a: " * 3000,
    "&a [*a]",
    "*a",
    "a: &a [1]\nb: [*a, *a]",
    "!!python/object:os.system x",
    "--- 1\n--- 2",
    "\t",
    "%YAML 9.9\n---\n",
    "a: 1\na: 2",
    "? [1, 2]\n: 3",
    "seed: 2020-13-45",
    "seed: 0o17",
    "seed: 1_000",
    "seed: +_",
    "seed: " + "1" * 400,
    "seed: 0x" + "1" * 5000,
    "scene: {balls: 0x" + "1" * 500 + "}",
    "name: 1",
    "a: &x [&y [1], *y]\n" * 2,
    "x: |\n" + " a\n" * 2000,
    "\ufeffseed: 1",
    "seed: !!binary aGk=",
    "seed: !!set {a, b}",
    "seed: !!bool x",
    "seed: !!int ''",
    "seed: !!omap [a: 1, a: 2]",
    "!" * 2**20,
    "%YAML 1.1\n---\nseed: 1e-3",
    "%YAML 1.3\n---\n",
    "? &a [*a]\n: 1",
    "scene: &a {radius: *a}",
    "seed: .nan",
    "a0: &a0 [x]\n" + "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 30)),
    "splits: {" + ", ".join(f"s{k}: {{videos: 1}}" for k in range(5000)) + "}",
    "splits: {" + ", ".join(f"s{k}: {{videos: 1, factors: {{radius: [{k}, {k}.5]}}}}" for k in range(90)) + "}",
    "scene: {name: bouncing, "
    + ", ".join(
        f"{name}: {{grid: [{', '.join(map(str, range(1, 60)))}]}}"
        for name in ("width", "wall_friction", "wall_elasticity", "gravity", "balls")
    )
    + "}",
    "scene: " + "{mixture: [" * 200 + "1" + "]}" * 200,
    "video: {frames: 100000, height: 8192, width: 8192}",
    "scene: {radius: {minus: [[0.5, 1], " + ", ".join(f"[0.{k:04d}, 0.{k:04d}5]" for k in range(5000, 9900)) + "]}}",
]


def places(value: Any, path: tuple = ()) -> Iterator[tuple]:
    """Paths of all values in a config, itself included."""
    yield path
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from places(inner, (*path, key))
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            yield from places(inner, (*path, number))


def changed_configs(count: int, seed: int) -> Iterator[Any]:
    """Randomly changed configs, most of which are invalid."""
    chance = random.Random(seed)
    configs = [parse_yaml(path.read_text(), str(path)) for path in sorted(config_folder().glob("*.yaml"))]
    for _ in range(count):
        config = copy.deepcopy(chance.choice(configs))
        for _ in range(chance.choice([1, 1, 1, 2, 5])):
            change(config, chance)
        yield config


def change(config: dict, chance: random.Random) -> None:
    """Change one value, key or nesting of a config at random, in place."""
    path = chance.choice([path for path in places(config) if path])
    container: Any = config
    for key in path[:-1]:
        container = container[key]
    choice = chance.random()
    if choice < 0.6 or not isinstance(container, dict):
        container[path[-1]] = copy.deepcopy(chance.choice(JUNK))
    elif choice < 0.7:
        del container[path[-1]]
    elif choice < 0.8:
        container[chance.choice(["splits", "nope", "radius", "name", 7, "sha256", "factors", "matched", "quality"])] = (
            copy.deepcopy(chance.choice(JUNK))
        )
    elif choice < 0.9:
        container[path[-1]] = [copy.deepcopy(container[path[-1]])] * chance.choice([1, 2, 3])
    else:
        container[path[-1]] = {
            chance.choice(["uniform", "minus", "mixture", "grid", "normal", "choice"]): container[path[-1]]
        }
