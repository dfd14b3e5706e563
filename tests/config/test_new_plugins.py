"""One new file is a plug-in: in its folder by its name, anywhere else by its path; and nothing else is touched."""

import importlib
import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny import run_command

import gen2d
from gen2d.config import plugins
from gen2d.config.reading import yaml_text
from gen2d.core.errors import ConfigError, UserError

ROOT = Path(gen2d.__file__).parent.parent
CONFIG = {
    "name": "small",
    "video": {"frames": 6, "height": 16, "width": 20},
    "scene": "uniform_motion",  # of one ball that meets nothing: the fastest to compile
    "physics": {"substeps": 1},
    "storage": {"batch_size": 4},
}
FOLDERS = {
    "scene": "gen2d/scenes",
    "look": "renderers/looks",
    "annotation": "gen2d/annotations",
    "export": "gen2d/exports/formats",
}
SOURCES = {
    "scene": '''"""Discs at rest in a row."""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import Family, Layout, SampledScene, SlotGroup, builder, option


@dataclasses.dataclass(frozen=True)
class Options:
    radius: object = option([0.2, 0.4], float, "m", "of each disc of the row", above=0, high=0.5, draw=True)
    count: int = option(3, int, "discs", "in the row", low=1, high=9)


def layout(options):
    return Layout((SlotGroup("circle", options.count),), (0, 0, options.count, 1), options.radius.support[1])


def sample(key, factors, options):
    places = jnp.stack([jnp.arange(options.count) + 0.5, jnp.full(options.count, 0.5)], 1)
    radius = jnp.full(options.count, factors["radius"])
    return SampledScene(*builder.assemble(layout(options), [builder.discs(places, radius, True)], jnp.zeros(2)))


FAMILY = Family(options=Options, layout=layout, sample=sample)
''',
    "look": '''"""Everything in one colour."""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import Look, PlainOptions, line_margin, option, plain


@dataclasses.dataclass(frozen=True)
class Options(PlainOptions):
    level: int = option(200, int, "sRGB", "of all that is drawn", low=0, high=255)


def paint(scene, layout, options, key):
    begun = plain(scene, layout, options, key)
    return begun._replace(color=jnp.full_like(begun.color, options.level))


LOOK = Look(options=Options, paint=paint, margin=line_margin)
''',
    "annotation": '''"""How many pixels each object has been seen in, over a number."""

import dataclasses

import jax.numpy as jnp

from gen2d.plugin import Annotation, Field, option


@dataclasses.dataclass(frozen=True)
class Options:
    over: float = option(1.0, float, "px", "that counts are divided by", above=0)
    parts: int = option(2, int, "parts", "of the video, each counted on its own", low=1)


def sizes(plan, options):
    return {"Q": options.parts}


def annotate(scenes, owners, plan, options):
    slots = jnp.arange(1, plan.layout.slots + 1)
    seen = (owners[..., None] == slots).sum((2, 3)).astype(jnp.float32) / options.over  # [n, T, K]
    parts = [part.sum((1, 2)) for part in jnp.array_split(seen, options.parts, 1)]
    return {"seen/pixels": seen, "seen/parts": jnp.stack(parts, 1)}


ANNOTATION = Annotation(
    options=Options,
    fields={
        "seen/pixels": Field("float32", "n T K", "1", "pixels of each object"),
        "seen/parts": Field("float32", "n Q", "1", "the same, of all objects in each part"),
    },
    annotate=annotate,
    sizes=sizes,
    owners=True,
)
''',
    "export": '''"""One JSON file with the mean level of each frame."""

import importlib
import json
import os

from gen2d.plugin import ConfigError, Export


def check(source):
    if len(source) > 100:
        raise ConfigError("levels holds 100 videos at most")


def write(target, source):
    levels = [video["frames"].mean((1, 2, 3)).tolist() for video in source.videos()]
    target.write_text(json.dumps(levels))


EXPORT = Export(fields=("frames",), write=write, check=check, fixed=True, suffix=".json", loss="levels alone")
''',
}
OPTION = {
    "scene": "scene.radius",
    "look": "look.level",
    "annotation": "annotations.brandnew.over",
    "export": "brandnew",
}


def config_with(kind: str, name: str) -> dict[str, Any]:
    """The small config that asks for a plug-in."""
    sections = {
        "scene": {"scene": {"name": name, "count": 2}},
        "look": {"look": {"name": name, "level": 90, "background": [0, 0, 0]}},
        "annotation": {"annotations": {name: {"over": 2, "parts": 3}, "masks": True}},
    }
    return CONFIG | sections[kind]


def check_dataset(kind: str, root: Path) -> None:
    """Asserts that a dataset holds what the plug-in above makes."""
    ds = gen2d.open(root, fields="*")
    videos = ds[:]
    if kind == "scene":
        assert videos["objects/radius"].shape == (4, 2)
        np.testing.assert_array_equal(videos["objects/radius"], np.repeat(videos["factors/radius"][:, None], 2, 1))
        assert (videos["factors/radius"] >= 0.2).all()
    if kind == "look":
        assert set(np.unique(videos["objects/color"])) <= {0, 90}
        assert videos["frames"].max() == 90
    if kind == "annotation":
        slots = np.arange(1, videos["seen/pixels"].shape[-1] + 1)
        expected = (videos["masks/instance"][..., None] == slots).sum((2, 3)) / 2
        np.testing.assert_array_equal(videos["seen/pixels"], expected)
        assert videos["seen/parts"].shape == (4, 3)
        np.testing.assert_allclose(videos["seen/parts"].sum(1), expected.sum((1, 2)), rtol=1e-6)
        assert ds.manifest.sizes["Q"] == 3


def check_export(path: Path, root: Path) -> None:
    """Asserts that a file holds what the format above writes."""
    levels = gen2d.open(root)[:]["frames"].mean((2, 3, 4))
    np.testing.assert_allclose(json.loads(path.read_text()), levels, rtol=1e-9)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset without any new plug-in."""
    folder = tmp_path_factory.mktemp("plain") / "data"
    gen2d.generate(CONFIG, 4, folder)
    return folder


def copy_with(kind: str, copy: Path) -> Path:
    """A copy of the package with one file more."""
    skipped = shutil.ignore_patterns("__pycache__", "*.png")
    for name in ("gen2d", "renderers", "configs", "tests"):
        if (ROOT / name).is_dir():  # in a wheel the first holds the next two
            shutil.copytree(ROOT / name, copy / name, symlinks=True, ignore=skipped)
    shutil.copy(Path(__file__).parent.parent.parent / "pyproject.toml", copy)
    folder = copy / FOLDERS[kind] if (copy / FOLDERS[kind]).is_dir() else copy / "gen2d" / FOLDERS[kind]
    (folder / "brandnew.py").write_text(SOURCES[kind])
    return copy


@pytest.mark.parametrize("kind", ["scene", *(pytest.param(kind, marks=pytest.mark.full) for kind in [*SOURCES][1:])])
def test_one_file_in_its_folder_adds_a_plug_in(kind: str, plain: Path, tmp_path: Path) -> None:
    copy = copy_with(kind, tmp_path / "copy")
    here = {"cwd": copy, "PYTHONPATH": str(copy)}
    listed = run_command("list", "brandnew", **here)
    assert listed.returncode == 0, listed.stderr
    assert OPTION[kind] in listed.stdout
    if kind == "export":
        done = run_command("export", plain, "--to", "brandnew", "--out", tmp_path / "levels.json", **here)
        assert done.returncode == 0, done.stderr
        assert "brandnew is levels alone" in done.stdout
        check_export(tmp_path / "levels.json", plain)
    else:
        (tmp_path / "new.yaml").write_text(yaml_text(config_with(kind, "brandnew")))
        done = run_command("--config", tmp_path / "new.yaml", "--n", 4, "--out", tmp_path / "data", **here)
        assert done.returncode == 0, done.stderr
        check_dataset(kind, tmp_path / "data")
    check_tests(copy, "tests/config/test_contracts.py")


@pytest.mark.slow
def test_a_family_in_its_folder_keeps_the_contract_of_all(tmp_path: Path) -> None:
    check_tests(copy_with("scene", tmp_path / "copy"), "tests/scenes/test_families.py")


def check_tests(copy: Path, tests: str) -> None:
    """Asserts that those of the tests that are about the new plug-in pass in a copy of the package."""
    words = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "-k", "brandnew", tests]
    environment = os.environ | {"PYTHONPATH": str(copy)}
    done = subprocess.run(words, cwd=copy, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert " passed" in done.stdout


@pytest.mark.parametrize("kind", SOURCES)
def test_one_file_anywhere_is_a_plug_in(kind: str, plain: Path, tmp_path: Path) -> None:
    path = tmp_path / "of.mine" / "own.py"
    path.parent.mkdir()
    path.write_text(SOURCES[kind])
    if kind == "export":
        made = gen2d.export(plain, str(path), tmp_path / "levels.json")
        assert (made.videos, made.loss) == (4, "levels alone")
        check_export(made.out, plain)
        done = run_command("export", plain, "--to", path, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        check_export(plain.with_name("data-own.json"), plain)
        with pytest.raises(ConfigError, match=r"has its own: choose .*npz"):
            gen2d.export(plain, str(path), tmp_path / "other.json", fields=["index"])
        return
    gen2d.generate(config_with(kind, str(path)), 4, tmp_path / "data")
    check_dataset(kind, tmp_path / "data")
    copy = tmp_path / "data" / "plugins" / kind / "own.py"
    assert copy.read_text() == SOURCES[kind]
    code = "import sys, gen2d; root = sys.argv[1]; gen2d.open(root)[:]; gen2d.info(root); assert not gen2d.verify(root)"
    code += "; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "data")], check=True)
    path.unlink()
    assert gen2d.verify(tmp_path / "data", "regen", videos=4) == []


def test_an_annotation_is_switched_on_by_its_path_and_by_its_fields(plain: Path, tmp_path: Path) -> None:
    path = tmp_path / "own.py"
    path.write_text(SOURCES["annotation"])
    config = gen2d.load_config(CONFIG, [f"annotations.{path}=true"])
    assert str(path) in config.annotations.enabled
    config = gen2d.load_config(config, [f"annotations.{path}.over=3"])
    assert config.annotations.plain()[str(path)]["over"] == 3
    ds, fields = gen2d.open(plain), ["seen/pixels", "masks/instance", "tracks/points"]
    found = gen2d.render(ds, [0, 2], overrides=[f"annotations.{path}=true"], fields=fields)
    mask, slots = np.asarray(found["masks/instance"]), np.arange(1, found["seen/pixels"].shape[-1] + 1)
    np.testing.assert_array_equal(found["seen/pixels"], (mask[..., None] == slots).sum((2, 3)))
    assert found["tracks/points"].shape[2] == 8 * len(slots)
    with pytest.raises(ConfigError, match="fields holds 'seen/pixels', but must be of"):
        gen2d.render(ds, [0], fields=["seen/pixels"])
    other = tmp_path / "other.py"
    other.write_text(SOURCES["annotation"])
    with pytest.raises(ConfigError, match=r"annotations\..*other\.py has a field 'seen/p"):
        gen2d.generate(CONFIG | {"annotations": {str(path): True, str(other): True}}, 1, tmp_path / "twice")


WRONG = {
    '"seen/more": seen': "must declare what it returns",
    '"seen/pixels": seen[:1]': r"is float32\[1, 6, 1\], but must be as declared, float32\[4, 6, 1\]",
    '"seen/pixels": owners': r"is uint8\[4, 6, 16, 20\], but must be as declared, float32\[4, 6, 1\]",
}


@pytest.mark.parametrize("returned", WRONG)
def test_an_annotation_that_returns_something_else_is_one_sentence(returned: str, tmp_path: Path) -> None:
    path = tmp_path / "own.py"
    path.write_text(SOURCES["annotation"].replace('"seen/pixels": seen,', f"{returned},"))
    with pytest.raises(UserError, match=WRONG[returned]) as caught:
        gen2d.generate(CONFIG | {"annotations": {str(path): True}}, 1, tmp_path / "data")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "data" / "manifest.json").exists()


@pytest.mark.parametrize("kind", SOURCES)
def test_the_smallest_example_of_each_kind_runs(kind: str, plain: Path, tmp_path: Path) -> None:
    """The one in the docstring of the folder."""
    package = importlib.import_module(plugins.KINDS[kind][0])
    code = re.findall(r"\n\n((?:    .*\n|\n)+)", package.__doc__ or "")[0]
    path = tmp_path / "own.py"
    path.write_text(textwrap.dedent(code))
    if kind == "export":
        made = gen2d.export(plain, str(path), tmp_path / "out")
        np.testing.assert_array_equal(np.load(made.out / "train-000000003.npy"), gen2d.open(plain)[3]["frames"])
        return
    config = {"annotations": {str(path): True}} if kind == "annotation" else {kind: str(path)}
    batch = next(iter(gen2d.stream(CONFIG | config, batch_size=4, device="cpu", fields=["*"])))
    if kind == "look":
        np.testing.assert_array_equal(batch["objects/color"], 255 - gen2d.open(plain, fields=["*"])[:]["objects/color"])
    if kind == "scene":
        np.testing.assert_array_equal(batch["states/position"], np.full((4, 6, 1, 2), 0.5))
    if kind == "annotation":
        np.testing.assert_array_equal(batch["motion/turn"], abs(batch["states/angle"]))
