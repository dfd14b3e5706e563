"""Selections are the videos of a NumPy mask, in any loader; tables hold what is stored."""

import contextlib
import itertools
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from packages import package

import gen2d
from gen2d.core.enums import DYNAMIC, JOINT_KINDS, KINEMATIC, SHAPES, STATIC
from gen2d.core.errors import ConfigError
from gen2d.core.schema import Field
from gen2d.loading import chunks
from gen2d.loading.filters import parse_filter
from gen2d.loading.protocols import Batch

FIELDS = synthetic.FIELDS | {
    "factors/balls": Field("float32", "n", "balls", "how many"),
    "factors/gravity": Field("float32", "n 2", "m/s^2", "acceleration"),
    "factors/radius": Field("float32", "n balls", "m", "of each ball"),
    "matched/kind": Field("uint8", "n", "1", "code of the change: 1 teleport, 5 energy_gain"),
    "out_of_distribution": Field("bool", "n", "1", "whether it is"),
    "text/word": Field("S8", "n", "", "a word"),
}
TRAIN = 40
SIZES = {"T": 5, "H": 8, "W": 8, "K": 3, "balls": 2}


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two datasets with different values."""
    home = tmp_path_factory.mktemp("data")
    video = synthetic.video

    def with_values(spec: Any, split: str, number: int) -> Batch:
        values = video(spec, split, number)
        rng = np.random.default_rng([spec.seed, number, 5])
        word = np.array(["red", "blue", "größe"][number % 3].encode(), "S8")
        flags = {"out_of_distribution": np.array(rng.random() < 0.5), "text/word": word}
        return values | flags | {"matched/kind": np.array(rng.choice([1, 5]), np.uint8)}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "video", with_values)
        specs = [synthetic.dataset(home / f"{seed}", TRAIN, seed=seed, fields=FIELDS, sizes=SIZES) for seed in (1, 2)]
        return [synthetic.folder(synthetic.make(spec)) for spec in specs]


@pytest.fixture(params=["dataset", "concatenation", "subset"])
def source(request: pytest.FixtureRequest, roots: list[Path]) -> Any:
    if request.param == "concatenation":
        return gen2d.open(roots, fields="*")
    ds = gen2d.open(roots[0], fields="*")
    return ds if request.param == "dataset" else ds.select(np.arange(TRAIN)[::-2])


def same(one: Batch, other: Batch) -> None:
    assert one.keys() == other.keys()
    for name, values in other.items():
        assert_array_equal(one[name], values)


# ---- select


@settings(max_examples=20, deadline=None)
@given(data=st.data())
def test_a_selection_has_the_videos_with_these_indices(roots: list[Path], data: st.DataObject) -> None:
    ds = gen2d.open(roots, fields=("index", "states/angle", "frames"))
    count, whole = len(ds), ds[:]
    indices = data.draw(st.lists(st.integers(-count, count - 1), max_size=8))
    some = ds.select(indices)
    assert len(some) == len(indices)
    same(some[:], {name: values[indices] for name, values in whole.items()})
    if indices:
        same(some[-1], {name: values[indices[-1]] for name, values in whole.items()})
        assert [video["index"] for video in some] == whole["index"][indices].tolist()
        again = data.draw(st.lists(st.integers(0, len(indices) - 1), max_size=4))
        same(some.select(again)[:], {name: values[indices][again] for name, values in whole.items()})
    mask = np.array(data.draw(st.lists(st.booleans(), min_size=count, max_size=count)))
    assert_array_equal(ds.select(mask).indices, np.flatnonzero(mask))


def test_wrong_selections_are_named(roots: list[Path]) -> None:
    ds: Any = gen2d.open(roots[0])
    with pytest.raises(IndexError, match="video 40 is not there: the dataset has 40 videos"):
        ds.select([0, 40])
    with pytest.raises(IndexError, match="video 3 is not there: the selection has 3 videos"):
        ds.select([4, 5, 6])[3]
    with pytest.raises(TypeError, match="must be an integer, not float64"):
        ds.select([0.5])
    with pytest.raises(ConfigError, match=r"the mask has the shape \(3,\), but there are 40 videos"):
        ds.select([True, False, True])
    with pytest.raises(ConfigError, match=r"indices have the shape \(1, 2\)"):
        ds.select([[1, 2]])


def test_every_loader_reads_a_selection(roots: list[Path]) -> None:
    ds = gen2d.open(roots, fields=("index", "states/angle"), window=2)
    numbers = np.array([3, 71, 12, 5, 40, 41, 8, 9])
    some, whole = ds.select(numbers), gen2d.open(roots, fields=("index", "states/angle"))[:]
    expected = sorted(whole["index"][numbers].tolist())
    batches = list(gen2d.DataLoader(some, 4, epochs=2, seed=1))
    for epoch in (batches[:2], batches[2:]):
        assert sorted(np.concatenate([batch["index"] for batch in epoch]).tolist()) == expected
    starts = some._starts(np.arange(8), np.arange(8, dtype=np.uint64))
    assert starts is not None
    batch = some.batch(range(8), starts)
    for row, number in enumerate(numbers):
        assert_array_equal(batch["states/angle"][row], whole["states/angle"][number, starts[row] : starts[row] + 2])
    mixture = gen2d.mix({"few": some, "rest": ds.select(np.setdiff1d(np.arange(80), numbers))}, [1, 3])
    assert len(list(gen2d.DataLoader(mixture, 4, epochs=1))) == 8
    assert len(gen2d.grain.source(some, epochs=3)) == 24
    package("torch")
    data = gen2d.torch.dataset(pickle.loads(pickle.dumps(some)))
    same(
        {name: values.numpy()[None] for name, values in data[2].items()},
        some.batch([2], [int(data[2]["window/start"])]),
    )


def test_a_state_is_of_the_selection(roots: list[Path]) -> None:
    ds = gen2d.open(roots[0], fields="index")
    one, other = ds.select(range(8)), ds.select(range(1, 9))
    with gen2d.DataLoader(one, 2, epochs=1) as loader:
        batches = iter(loader)
        next(batches)
        state, rest = loader.state_dict(), [batch["index"].tolist() for batch in batches]
    with gen2d.DataLoader(ds.select(range(8)), 2, epochs=1) as loader:
        loader.load_state_dict(state)
        assert [batch["index"].tolist() for batch in loader] == rest
    with pytest.raises(ConfigError, match="the state is of other videos than those that are selected here"):
        gen2d.DataLoader(other, 2, epochs=1).load_state_dict(state)


# ---- filter


NUMBERS = "index", "factors/balls", "factors/gravity[1]", "factors/radius[0]", "states/angle[4, 2]", "quality/contacts"
SIGNS = "<", "<=", ">", ">=", "==", "!="


def comparison(draw: Any, values: Batch) -> tuple[str, np.ndarray]:
    """A comparison, and its mask by NumPy."""
    kind = draw(st.sampled_from(["number", "chain", "fields", "flag", "text", "code"]))
    if kind == "flag":
        return "out_of_distribution", values["out_of_distribution"]
    sign = draw(st.sampled_from(SIGNS))
    if kind == "text":
        word = draw(st.sampled_from(["red", "blue", "größe"]))
        return f"text/word {sign} '{word}'", eval(f"a {sign} b", {"a": values["text/word"], "b": word.encode()})
    if kind == "code":
        name, code = draw(st.sampled_from([("teleport", 1), ("'energy_gain'", 5), ("5", 5)]))
        return f"matched/kind {sign} {name}", eval(f"a {sign} b", {"a": values["matched/kind"], "b": code})
    names = draw(st.lists(st.sampled_from(NUMBERS), min_size=2, max_size=2))
    columns = [
        eval(f"v['{n.partition('[')[0]}'][:{', ' + n[:-1].partition('[')[2] if '[' in n else ''}]", {"v": values})
        for n in names
    ]
    if kind == "fields":
        return f"{names[0]} {sign} {names[1]}", eval(f"a {sign} b", {"a": columns[0], "b": columns[1]})
    bound = draw(st.one_of(st.integers(-5, 120), st.floats(-5, 120, allow_nan=False, width=16)))
    if kind == "number":
        return f"{names[0]}{sign}{bound!r}", eval(f"a {sign} b", {"a": columns[0], "b": bound})
    return f"{bound!r} < {names[0]} <= {bound + 40!r}", (bound < columns[0]) & (columns[0] <= bound + 40)


def condition(draw: Any, values: Batch, depth: int = 2) -> tuple[str, np.ndarray]:
    """A condition, and its mask by NumPy."""
    kind = draw(st.sampled_from(["one", "and", "or", "not", "both"])) if depth else "one"
    if kind == "one":
        return comparison(draw, values)
    text, mask = condition(draw, values, depth - 1)
    if kind == "not":
        return f"not ({text})", ~mask
    other, others = comparison(draw, values)
    if kind == "both":  # `and` binds closer than `or`
        third, thirds = comparison(draw, values)
        return f"{other} or {third} and not {other}", others | (thirds & ~others)
    return (f"({text}) and {other}", mask & others) if kind == "and" else (f"({text}) or {other}", mask | others)


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_a_filter_is_the_mask_of_numpy(roots: list[Path], data: st.DataObject) -> None:
    ds = gen2d.open(roots, fields="frames")
    text, mask = condition(data.draw, gen2d.open(roots, fields="*")[:])
    assert_array_equal(ds.filter(text).indices, np.flatnonzero(mask), err_msg=text)


def test_components_have_names(source: Any) -> None:
    gravity = source[:]["factors/gravity"]
    for name, column in (("factors/gravity_x", 0), ("factors/gravity_y", 1)):
        assert_array_equal(source.filter(f"{name} < 50").indices, np.flatnonzero(gravity[:, column] < 50))


def test_filters_of_filters(source: Any) -> None:
    twice = source.filter("index >= 10").filter("factors/balls > 30 or out_of_distribution")
    values = source[:]
    mask = (values["index"] >= 10) & ((values["factors/balls"] > 30) | values["out_of_distribution"])
    same(twice[:], {name: array[mask] for name, array in values.items()})
    assert len(source.filter("index < 0")) == 0


def test_a_filter_reads_no_frames(roots: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    read: set[str] = set()
    chunks_of = chunks.SplitFiles.chunks_of

    def note(self: Any, column: Any, *arguments: Any) -> Any:
        read.add(column.name)
        return chunks_of(self, column, *arguments)

    monkeypatch.setattr(chunks.SplitFiles, "chunks_of", note)
    gen2d.open(roots[0], fields="*").filter("factors/balls > 3 and index < 9")
    assert read == {"factors/balls", "index"}


WRONG = {
    "factors/bals > 3": "has no field 'factors/bals': did you mean 'factors/balls'?",
    "energy/kinetic[0] > 3": "the option annotations.energy=true of gen2d.generate stores it",
    "factors/gravity < 3": "factors/gravity has 2 values per video: choose one, such as factors/gravity[0]",
    "states/angle[1] < 3": "has 5 x 3 values per video: choose one, such as states/angle[0, 0]",
    "factors/gravity[2] < 3": "has 2 values per video",
    "index[0] < 3": "index has one value per video, and takes no index",
    "factors/gravity[-1] < 3": "an index must be a whole number, 0 or more, not -1",
    "factors/gravity[0 < 3": "a bracket is not closed",
    "frames > 3": "frames is an image",
    "time > 3": "time is the same for all videos",
    "index = 3": "say == for equality",
    "index": "must compare values with",
    "index < 3 4": "4 stands where the filter should end",
    "index <": "nothing stands where a field or a number should",
    "and": "and stands where a field or a number should",
    "": "nothing stands where a field or a number should",
    "(index < 3": "a parenthesis is not closed",
    "index < 3)": ") stands where the filter should end",
    "1 < 2": "compares 1 with 2: one of them must be a field",
    "text/word == 3": "compares a text with the number 3: put it in quotes",
    "text/word == index": "compares a text with a number",
    "index == red": "compares a number with 'red', which must be a number or a field",
    "matched/kind == telport": "which must be one of teleport, energy_gain",
    "index < 3 & index > 1": "must be made of fields, numbers, comparisons, and, or and not",
    "__import__('os')": "has no field '__import__'",
    "not " * 60 + "out_of_distribution": "at most 50 parentheses and negations",
    "(" * 60: "at most 50 parentheses and negations",
}


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_filter_is_named(roots: list[Path], text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        gen2d.open(roots[0]).filter(text)
    assert WRONG[text] in str(caught.value)
    assert "\n" not in str(caught.value)


@settings(max_examples=300, deadline=None)
@given(st.text(st.sampled_from("abi/_x01.<>=!()[], andortfe'\"-+"), max_size=25))
def test_no_text_fails_but_in_a_sentence(text: str) -> None:
    with contextlib.suppress(ConfigError):
        assert set(parse_filter(text, FIELDS, SIZES, "here").fields) <= FIELDS.keys()


def test_a_filter_is_text(roots: list[Path]) -> None:
    ds: Any = gen2d.open(roots[0])
    with pytest.raises(ConfigError, match=r"filter is <function .*, but must be a text such as"):
        ds.filter(lambda video: True)


# ---- Tables


def test_tables_hold_what_is_stored(source: Any) -> None:
    package("pandas")
    package("pyarrow")
    values, frame, table = source[:], source.to_pandas(), source.to_arrow()
    assert list(frame.columns[:4]) == ["index", "factors/balls", "factors/gravity[0]", "factors/gravity[1]"]
    assert table.column_names == list(frame.columns)
    names = {"index", "factors/balls", "factors/gravity", "factors/radius", "quality/contacts"}
    assert {name.partition("[")[0] for name in frame} == names | {"matched/kind", "out_of_distribution", "text/word"}
    for name in frame:
        base, _, index = name.partition("[")
        expected = values[base][(slice(None), *map(int, filter(None, index.removesuffix("]").split(","))))]
        if base == "text/word":
            assert frame[name].tolist() == table[name].to_pylist() == [word.decode() for word in expected.tolist()]
            continue
        assert frame[name].dtype == expected.dtype
        assert_array_equal(frame[name], expected)
        assert_array_equal(table[name].to_numpy(), expected)
    metadata = table.schema.field("factors/gravity[1]").metadata
    assert metadata == {b"unit": b"m/s^2", b"meaning": b"acceleration"}
    mask = frame["factors/gravity[1]"] < 40
    assert_array_equal(source.select(mask).indices, source.filter("factors/gravity[1] < 40").indices)


def test_tables_of_chosen_fields(roots: list[Path]) -> None:
    package("pandas")
    ds = gen2d.open(roots[0])
    assert list(ds.to_pandas("objects/mass")) == [f"objects/mass[{k}]" for k in range(3)]
    assert ds.to_pandas(["states/angle"]).shape == (TRAIN, 15)
    assert len(ds.select([]).to_pandas()) == 0
    for name, message in [
        ("frames", "frames is an image"),
        ("time", "same for all"),
        ("facters/balls", "did you mean"),
    ]:
        with pytest.raises(ConfigError, match=message):
            ds.to_pandas([name])


@pytest.mark.parametrize("name", ["pandas", "pyarrow"])
def test_a_missing_package_is_named(roots: list[Path], name: str) -> None:
    method = "to_pandas" if name == "pandas" else "to_arrow"
    code = f"import sys; sys.modules[{name!r}] = None; import gen2d; gen2d.open({str(roots[0])!r}).{method}()"
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    last = done.stderr.strip().splitlines()[-1]
    assert last == f"ModuleNotFoundError: {method} needs {name}, which is not installed: pip install {name}"
    assert "During handling" not in done.stderr


# ---- What a dataset says of itself


def test_indexing_and_iteration(source: Any) -> None:
    whole = source[:]
    same(source[0], {name: values[0] for name, values in whole.items()})
    same(source[-1], {name: values[-1] for name, values in whole.items()})
    same(source[5:9], {name: values[5:9] for name, values in whole.items()})
    for number, video in enumerate(itertools.islice(source, 3)):
        same(video, {name: values[number] for name, values in whole.items()})
    assert len(list(iter(source))) == len(source)
    with pytest.raises(IndexError):
        source[len(source)]


def test_properties_of_a_dataset(roots: list[Path]) -> None:
    ds = gen2d.open(roots[0], fields="*")
    assert ds.splits == {"train": TRAIN, "test": 3}
    assert (ds.fps, ds.config["scene"]["name"]) == (10.0, "toy")
    assert (ds.fields["factors/gravity"].unit, ds.fields["matched/kind"].codes) == (
        "m/s^2",
        {1: "teleport", 5: "energy_gain"},
    )
    both = gen2d.open(roots, fields="*")
    mixture = gen2d.mix({"a": ds, "b": both})
    assert both.fps == mixture.fps == ds.select([1]).fps == 10.0
    for name in ("config", "splits"):
        with pytest.raises(AttributeError, match=rf"each of the 2 datasets has its own {name}: ds\.datasets\[0\]"):
            getattr(both, name)
        with pytest.raises(AttributeError, match=f"each dataset of a mixture has its own {name}"):
            getattr(mixture, name)
    for name in ("select", "to_pandas", "to_arrow"):
        with pytest.raises(AttributeError, match=f"call {name} of its datasets, then gen2d.mix"):
            getattr(mixture, name)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = mixture.nothing
    same(pickle.loads(pickle.dumps(mixture))[3], mixture[3])


def test_codes_are_those_of_the_enums() -> None:
    fields = gen2d.stream("bouncing.yaml", n=32, overrides=["annotations.contacts=4"]).source.schema.fields
    assert fields["objects/kind"].codes == {DYNAMIC: "dynamic", STATIC: "static", KINEMATIC: "kinematic"}
    assert fields["objects/shape"].codes == dict(enumerate(SHAPES))
    assert list(fields["contacts/kind"].codes.values()) == ["none", "impact", "begin", "persist", "end"]
    assert {name for name, field in fields.items() if field.codes} == {"objects/kind", "objects/shape", "contacts/kind"}
    assert JOINT_KINDS == ("distance", "revolute")


def test_descriptions_say_what_there_is(roots: list[Path], tmp_path: Path) -> None:
    ds = gen2d.open(roots[0], fields=("frames", "states/*"), window=2, stride=2, layout="TCHW")
    lines = repr(ds).splitlines()
    assert lines[0] == f"40 train videos of {roots[0]}"
    assert lines[1:5] == [
        "  5 frames of 8 x 8 px, 10 per second",
        "  windows of 2 frames, at random, stride 2",
        "  layout TCHW, frames uint8",
        "  other splits: test",
    ]
    assert lines[5].split() == ["frames", "uint8", "n", "T", "H", "W", "3", "sRGB"]
    assert repr(ds.select([1, 2])).startswith("2 of the 40 train videos of ")
    assert repr(gen2d.open(roots)).startswith("80 videos of 2 datasets, one after the other\n  40 train videos of ")
    mixture = gen2d.mix({"<b>": ds, "other": ds}, [3, 1])
    assert "  3 in 4: <b>, 40 train videos of " in repr(mixture)
    for each in (ds, mixture, ds.select([1]), gen2d.open(roots)):
        page = each._repr_html_()
        assert "<td style='text-align:left'>states/angle</td>" in page
        assert "<b>," not in page
    fields = synthetic.FIELDS | {"x/y": Field("int32", "n", "<b>", "<script>alert(1)</script>")}
    hostile = gen2d.open(synthetic.make(synthetic.dataset(tmp_path / "x", fields=fields)).root, fields="*")
    assert "<script>" not in hostile._repr_html_()
    assert "<td style='text-align:left'>&lt;b&gt;</td>" in hostile._repr_html_()
