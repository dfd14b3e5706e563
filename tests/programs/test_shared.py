"""Programs are shared by all configs that differ in numbers only, and give each the bits of its own program."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import gen2d
from gen2d.config.config import Config, load_config
from gen2d.config.parameters import parametrized, split_numbers
from gen2d.generation.run import generate
from gen2d.programs import devices, shared
from gen2d.programs.rollout import Rollout
from gen2d.records.keys import seed_words, video_keys
from gen2d.records.parameter import SIZE, Tape
from gen2d.sampling.sampler import Sampler

CONFIGS = sorted(path.stem for path in (Path(gen2d.__file__).parent / "configs").glob("*.yaml"))
SMALL = ["video.frames=5", "video.height=16", "video.width=16", "storage.batch_size=4"]
STATIC = ("video.frames", "video.height", "video.width", "storage.", "annotations.", "quality.", "matched.", "seed")


@pytest.fixture(autouse=True)
def _no_programs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """No program in memory or on disk."""
    monkeypatch.setattr("gen2d.programs.executables._root", lambda: None)
    shared.clear()
    yield
    shared.clear()


def trace(config: Config) -> dict[str, shared.BoundProgram]:
    """The programs of a config, traced and not compiled."""
    rollout = Rollout(config, devices.prepare("cpu")[:1])
    return rollout.programs | {"draw": rollout.draw_program(rollout.slice)}


def programs() -> list[shared.Program]:
    """All programs in memory."""
    return [program for _, program in shared._programs]


def edits(plain: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Overrides that change one number each: fractions by a thousandth, the least of a list of whole numbers by one."""
    for name, value in plain.items():
        where = f"{path}.{name}".lstrip(".")
        if where.startswith(STATIC) or name in ("splits", "physics"):
            continue
        if isinstance(value, dict):
            yield from edits(value, where)
        elif isinstance(value, float) and value != 0:
            yield where, value * 1.001
        elif isinstance(value, list) and all(isinstance(x, int) for x in value) and min(value) < max(value):
            yield where, [x + (x == min(value)) for x in value]  # the largest count is a number of slots


FIRST = ("bouncing", "collision", "chain", "occluder", "uniform_motion")
FAMILIES = [name for name in CONFIGS if not name.startswith("phyworld")]


@pytest.mark.parametrize(
    "name", [name if name in FIRST else pytest.param(name, marks=pytest.mark.full) for name in FAMILIES]
)
def test_no_edited_number_of_a_shipped_config_needs_another_program(name: str) -> None:
    config = load_config(f"{name}.yaml", [f"storage.batch_size={4}"])
    programs = [bound.program for bound in trace(config).values()]
    overrides = dict(edits({section: config.plain()[section] for section in ("look", "scene")}))
    overrides |= {
        "camera.margin": config.camera.margin + 1e-4,
        "physics.push_speed": 2.5,
        "physics.bounce_threshold": 0.02,
    }
    overrides |= {"video.fps": config.video.fps * 1.001, "seed": 7}
    assert len(overrides) >= 10
    for where, value in overrides.items():
        changed = load_config(config, [f"{where}={value}"])
        assert [bound.program for bound in trace(changed).values()] == programs, where


def splits(**changes: Any) -> dict[str, Any]:
    """A config whose splits have their own distributions, of all forms; `changes` replace the factors of some."""
    factors: dict[str, Any] = {
        "train": {"minus": [{}, {"radius": [0.7, 0.8]}]},
        "near": {"radius": [0.45, 0.49], "spin": {"normal": [20, 1, 19, 22]}},
        "far": {"radius": [1.1, 1.2], "spin": {"log_uniform": [20, 30]}},
        "hole": {"radius": {"choice": [0.71, 0.72]}, "balls": {"choice": [2, 3]}},
        "hole2": {"radius": {"choice": [0.73, 0.74]}, "balls": [5, 6]},
        "pairs": {
            "mixture": [{"density": [6, 7], "gravity": [0, -3]}, {"density": [8, 9], "gravity": [0, -4]}],
            "weights": [1, 2],
        },
        "grid": {"gravity": [{"grid": [1, 2]}, 0]},
    }
    scene = {"name": "bouncing", "balls": [2, 6], "radius": [0.5, 1.0], "spin": [0, 3], "density": [1, 5]}
    written = {name: {"factors": changes.get(name, own), "overlaps": True} for name, own in factors.items()}
    video = {"frames": 5, "height": 16, "width": 16}
    return {"video": video, "storage": {"batch_size": 4}, "scene": scene, "splits": written}


SPLIT_EDITS: dict[str, dict[str, Any]] = {
    "each number": {
        "near": {"radius": [0.44, 0.48], "spin": {"normal": [21, 2, 20, 23]}},
        "far": {"radius": [1.15, 1.2], "spin": {"log_uniform": [19, 31]}},
        "hole": {"radius": {"choice": [0.75, 0.76]}, "balls": {"choice": [3, 4]}},
    },
    "two equal": {"near": {"radius": [1.1, 1.2], "spin": {"normal": [20, 1, 19, 22]}}},
    "swapped": {
        "near": {"radius": [1.1, 1.2], "spin": {"normal": [20, 1, 19, 22]}},
        "far": {"radius": [0.45, 0.49], "spin": {"log_uniform": [20, 30]}},
    },
    "as in training": {"near": {"radius": [0.5, 1.0], "spin": {"normal": [20, 1, 19, 22]}}},
    "a range of one number": {"near": {"radius": [0.45, 0.45], "spin": {"normal": [20, 1, 19, 22]}}},
    "another hole": {"train": {"minus": [{}, {"radius": [0.6, 0.65]}]}},
    "another axis of the mixture": {
        "pairs": {
            "mixture": [{"density": [6, 7], "gravity": [0, -3]}, {"density": [8, 9], "gravity": [0, -3]}],
            "weights": [3, 1],
        },
    },
    "another grid": {"grid": {"gravity": [{"grid": [5, 7]}, 0]}},
}


@pytest.fixture(scope="module")
def sampled() -> Iterator[Any]:
    """Function of a config that returns its factors and distances from training, by split, and the program."""
    programs: list[tuple[str, Tape, Any]] = []

    def draw(config: Config, shared: bool) -> tuple[dict[str, dict[str, np.ndarray]], Any]:
        (structure, leaves), host = split_numbers(config), Sampler(config)
        words, numbers = seed_words(3, 7), np.arange(64, dtype=np.uint32)
        keys = video_keys(jax.numpy.asarray(words), jax.numpy.asarray(numbers))
        served = (entry for entry in programs if entry[0] == structure and entry[1].arguments(leaves) is not None)
        entry = next(served, None) if shared else None
        if entry is None:
            tape = Tape()
            sampler = Sampler(parametrized(config, tape)[0])

            def run(arguments: jax.Array, row: jax.Array, given: jax.Array) -> dict[str, jax.Array]:
                with tape.tracing(arguments):
                    factors = jax.vmap(sampler.sample_factors, (0, None, 0))(keys, row, given)
                    return factors | jax.vmap(sampler.ood_distances)(factors)

            entry = structure, tape, jax.jit(run)
            entry[2].trace(jax.ShapeDtypeStruct((SIZE,), np.uint32), 0, host.grid_values(0, words, numbers))
            programs.append(entry)
        results = {}
        for row, split in enumerate(config.splits):
            made = entry[2](entry[1].arguments(leaves), row, host.grid_values(row, words, numbers))
            results[split.name] = {name: np.asarray(values) for name, values in made.items()}
        return results, entry

    yield draw
    programs.clear()


@pytest.mark.parametrize("edit", SPLIT_EDITS)
def test_no_edited_number_of_a_split_needs_another_program(sampled: Any, edit: str) -> None:
    first, program = sampled(load_config(splits()), shared=True)
    config = load_config(splits(**SPLIT_EDITS[edit]))
    edited, same = sampled(config, shared=True)
    assert same is program
    own, _ = sampled(config, shared=False)
    for split, values in edited.items():
        for name, array in values.items():
            np.testing.assert_array_equal(array, own[split][name], f"{split} {name}")
    changed = {split for split in edited if any((edited[split][n] != first[split][n]).any() for n in edited[split])}
    assert changed >= SPLIT_EDITS[edit].keys()


def test_equal_and_different_splits_of_a_config_share_its_programs() -> None:
    """The largest radius stays, as it decides the size of tiles."""

    def programs(config: Config) -> list[shared.Program]:
        return [bound.program for bound in trace(config).values()]

    first = programs(load_config(splits()))
    for changes in SPLIT_EDITS.values():
        assert programs(load_config(splits(**changes))) == first


@pytest.mark.parametrize("name", [name for name in CONFIGS if name.startswith("phyworld")])
def test_no_edited_split_of_a_preset_needs_another_program(name: str) -> None:
    plain = load_config(f"{name}.yaml", ["storage.batch_size=4"]).plain()
    programs = [bound.program for bound in trace(load_config(plain)).values()]
    held_out = {split: own for split, own in plain["splits"].items() if "factors" in own}
    for split, own in held_out.items():
        for factor, (low, high) in own["factors"].items():
            for numbers in ([low, high * 0.99], next(iter(held_out.values()))["factors"].get(factor, [low, high])):
                changed = own | {"factors": own["factors"] | {factor: numbers}}
                config = load_config(plain | {"splits": plain["splits"] | {split: changed}})
                assert [bound.program for bound in trace(config).values()] == programs, (split, factor, numbers)


@pytest.mark.full
def test_a_shared_program_gives_the_bits_of_an_own_one(tmp_path: Path) -> None:
    overrides = [
        *SMALL,
        "scene.gravity=[0.5,-3]",
        "look.background=[90,0,7]",
        "scene.radius=[0.45,1.0]",
        "video.fps=31",
    ]
    others = [*SMALL, "scene.gravity=[0,-9.8]", "look.background=[0,0,0]"]
    generate("bouncing.yaml", 8, tmp_path / "first", overrides=others)
    before = set(programs())
    generate("bouncing.yaml", 8, tmp_path / "shared", overrides=overrides)
    assert set(programs()) == before
    shared.clear()
    generate("bouncing.yaml", 8, tmp_path / "own", overrides=overrides)
    both = [gen2d.open(tmp_path / name, fields="*")[:] for name in ("shared", "own", "first")]
    for name, values in both[0].items():
        np.testing.assert_array_equal(values, both[1][name], name)
    assert not np.array_equal(both[0]["frames"], both[2]["frames"])


@pytest.mark.parametrize("name", ["bouncing", "phyworld_collision"])
def test_the_fingerprint_does_not_depend_on_what_was_traced_first(name: str) -> None:
    """A program that was traced for other numbers has the text of one that is traced for these."""
    config = load_config(f"{name}.yaml", ["storage.batch_size=4"])
    trace(config)
    changed = load_config(config, [f"{where}={value}" for where, value in edits({"scene": config.plain()["scene"]})])
    shared_hashes = [bound.sha256 for bound in trace(changed).values()]
    shared.clear()
    assert [bound.sha256 for bound in trace(changed).values()] == shared_hashes


def test_programs_in_float32_are_the_same_after_some_in_float64() -> None:
    """Alone, and beside the programs of the same config in float64, which trace the same functions."""
    config = load_config("bouncing.yaml", ["storage.batch_size=4"])
    trace(load_config(config, ["physics.precision=float64"]))
    after = [bound.sha256 for bound in trace(config).values()]
    shared.clear()
    jax.clear_caches()
    assert [bound.sha256 for bound in trace(config).values()] == after


NEEDS = {
    "annotations.masks=true": {"draw"},
    "storage.frames=none": {"draw"},
    "look=outline": {"stage", "draw"},
    "camera.pan=[1, 0]": {"stage", "draw"},
    "image.noise=4": {"stage", "draw"},
    "image.jpeg_quality=[20, 90]": {"stage", "draw"},
    "image.vignette=0": set(),
    "scene.radius={normal: [0.6, 0.1, 0.5, 1.0]}": {"sample"},
    "physics.substeps=3": {"simulate"},
    "physics.damping=0.1": {"simulate"},
    "physics.precision=float64": {"simulate"},
    "annotations.energy=true": {"simulate"},
}


@pytest.mark.parametrize("change", NEEDS)
def test_another_effect_needs_only_the_programs_that_it_concerns(change: str) -> None:
    before, after = (trace(load_config("bouncing.yaml", [*SMALL, *changes])) for changes in ([], [change]))
    assert {name for name in after if after[name].program is not before[name].program} == NEEDS[change]
