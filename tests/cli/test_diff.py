"""`diff`: nothing for what is equal, and each option, field and program that differs."""

import json
from pathlib import Path

import pytest
from tiny import CONFIG, run_main, tiny_config

import gen2d
from gen2d.config.reading import yaml_text
from gen2d.config.resolved import resolved_text
from gen2d.storage.sealed import as_json, seal
from gen2d.tools.compare import compare


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("diff")
    gen2d.generate(CONFIG, 2, folder / "one")
    gen2d.generate(CONFIG, 3, folder / "other", seed=3)
    (folder / "one.yaml").write_text(yaml_text(CONFIG))
    (folder / "one.copy.yaml").write_text(yaml_text(CONFIG))
    (folder / "other.yaml").write_text(yaml_text(tiny_config(physics={"damping": 0.5}, scene={"radius": [1, 2]})))
    (folder / "nothing").mkdir()
    return folder


def rewritten(folder: Path, name: str, **changes: object) -> Path:
    """A folder with the manifest of `one`, changed."""
    manifest = json.loads((folder / "one/manifest.json").read_text())
    del manifest["manifest_sha256"]
    for path, value in changes.items():
        *outer, key = path.split("__")
        inner = manifest
        for each in outer:
            inner = inner[each]
        inner[key] = value
    (folder / name).mkdir()
    (folder / name / "manifest.json").write_bytes(as_json(seal(manifest, "manifest_sha256")))
    return folder / name


@pytest.mark.parametrize("source", ["one", "one.yaml", "bouncing", "pile.yaml"])
def test_what_is_compared_with_itself_has_no_difference(folder: Path, source: str) -> None:
    done = run_main("diff", source, source, cwd=folder)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_a_dataset_equals_its_config_and_a_config_its_resolved_form(folder: Path) -> None:
    (folder / "resolved.yaml").write_text(resolved_text(gen2d.load_config(folder / "one.yaml")))
    for other in ("one.yaml", "resolved.yaml", "one/config.yaml"):
        assert run_main("diff", "one", other, cwd=folder).returncode == 0
    assert run_main("diff", "one.yaml", "one.copy.yaml", cwd=folder).returncode == 0


def test_each_option_that_differs_is_named_in_both_directions(folder: Path) -> None:
    done = run_main("diff", "one.yaml", "other.yaml", cwd=folder)
    assert done.returncode == 1
    lines = done.stdout.splitlines()
    assert "option physics.damping: 0.0 -> 0.5" in lines
    assert [line.partition(":")[0] for line in lines] == ["option physics.damping", "option scene.radius"]
    back = run_main("diff", "other.yaml", "one.yaml", "--json", cwd=folder)
    damping, radius = map(json.loads, back.stdout.splitlines())
    assert damping == {"kind": "option", "name": "physics.damping", "first": 0.5, "second": 0.0}
    assert radius["first"] == {"uniform": [1, 2]}


def test_datasets_of_two_seeds_differ_in_seed_and_number_of_videos_alone(folder: Path) -> None:
    done = run_main("diff", "one", "other", cwd=folder)
    assert (done.returncode, done.stdout) == (1, "option seed: 0 -> 3\nvideos train: 2 -> 3\n")


def test_programs_versions_and_data_that_differ_are_named(folder: Path) -> None:
    changes = {"fingerprint__programs__draw": "0" * 64, "producer__jax": "0.1", "fingerprint__device": "abacus"}
    other = rewritten(folder, "programs", **changes)
    found = {(each.kind, each.name): str(each) for each in compare(f"{folder / 'one'}", f"{other}")}
    assert [*found] == [("program", "draw"), ("machine", "device"), ("version", "jax")]
    assert found["program", "draw"].endswith("-> 000000000000")
    table = json.loads((folder / "one/manifest.json").read_text())["tables"]["train"]
    other = rewritten(folder, "data", tables__train=table | {"sha256": "1" * 64})
    assert [(each.kind, each.name) for each in compare(f"{folder / 'one'}", f"{other}")] == [("data", "train")]


def test_a_field_that_one_lacks_is_named(folder: Path) -> None:
    fields = json.loads((folder / "one/manifest.json").read_text())["fields"]
    del fields["objects/mass"]
    other = rewritten(folder, "fields", fields=fields)
    done = run_main("diff", "one", other, cwd=folder)
    assert done.stdout == "field objects/mass: float32 [n K] kg -> absent\n"
    done = run_main("diff", other, "one", "--json", cwd=folder)
    expected = {"kind": "field", "name": "objects/mass", "second": "float32 [n K] kg", "absent": "first"}
    assert json.loads(done.stdout) == expected


def test_many_source_files_are_counted(folder: Path) -> None:
    other = rewritten(folder, "sources", producer__sources={f"file{i}.py": "0" * 12 for i in range(9)})
    lines = run_main("diff", "one", other, cwd=folder).stdout.splitlines()
    assert len(lines) == 6
    assert lines[-1].endswith("more source files differ; --json names them")


@pytest.mark.parametrize("pair", [("one", "nothing"), ("one", "nowhere"), ("nowhere", "one"), ("one", "broken")])
def test_bad_input_is_one_sentence_and_code_two(folder: Path, pair: tuple[str, str]) -> None:
    (folder / "broken").mkdir(exist_ok=True)
    (folder / "broken/manifest.json").write_text("{}")
    done = run_main("diff", *pair, cwd=folder)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
