"""A dataset of states gives the frames that its run would have stored, however they are asked for."""

import logging
import pickle
import random
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny
from numpy.testing import assert_array_equal
from packages import package

import gen2d
from gen2d.core.errors import ConfigError, UserError
from gen2d.programs import rendered_dataset

SMALL = ["storage.batch_size=4", "video.frames=8", "video.height=32", "video.width=32", "scene.balls=3"]
NOISE = ["image.noise=[1,4]", "camera.shake=0.1"]
BLUR = ["image.exposure=0.5", "image.exposure_samples=2"]
VIEWS: list[dict[str, Any]] = [{}, {"window": 2, "start": 5}]
OTHER: Any = {"height": 48, "width": 64, "look": "marked", "overrides": ["look.background=[0,0,0]"]}
VIDEOS = 10


def generate(folder: Path, *overrides: str, seed: int = 0) -> Path:
    gen2d.generate("bouncing.yaml", VIDEOS, folder, seed=seed, overrides=[*SMALL, *overrides], device="cpu")
    return folder


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same videos with frames and masks, and as states alone."""
    folder = tmp_path_factory.mktemp("data")
    masks = "annotations.masks=true", "annotations.boxes=true"
    return generate(folder / "frames", *masks), generate(folder / "states", "storage.frames=none")


@pytest.fixture(scope="module")
def frames(roots: tuple[Path, Path]) -> np.ndarray:
    """The stored frames."""
    return gen2d.open(roots[0])[:]["frames"]


# ---- Bits


def test_frames_that_are_named_are_rendered_to_the_bit(roots: tuple[Path, Path], frames: np.ndarray) -> None:
    states = gen2d.open(roots[1])
    assert "frames" not in states[0]
    assert states.exact
    ds = gen2d.open(roots[1], fields=["frames", "states/*"])
    assert isinstance(ds, gen2d.Dataset)
    assert ds.exact
    assert list(ds[0]) == ["frames", *states[0]]
    assert ds.fields["frames"] == gen2d.open(roots[0]).fields["frames"]
    batch = ds[:]
    assert_array_equal(batch["frames"], frames)
    tiny.same({name: batch[name] for name in states.fields}, states[:])


@pytest.mark.parametrize("size", [1, 3, 4, VIDEOS])
def test_batches_threads_and_order_do_not_change_bits(roots: tuple[Path, Path], frames: np.ndarray, size: int) -> None:
    ds = gen2d.open(roots[1], fields=["frames", "index"])
    order = random.Random(size).sample(range(VIDEOS), VIDEOS)
    for first in range(0, VIDEOS, size):
        numbers = order[first : first + size]
        assert_array_equal(ds.batch(numbers)["frames"], frames[numbers])
    with gen2d.DataLoader(ds, size, seed=1, epochs=2, drop_last=False, num_threads=3) as loader:
        for batch in loader:
            assert_array_equal(batch["frames"], frames[batch["index"]])
    out = ds.empty(VIDEOS)
    ds._fill(out, order, range(VIDEOS))
    assert_array_equal(out["frames"][order], frames)


@pytest.mark.parametrize("layout", ["THWC", "TCHW", "CTHW"])
def test_windows_layouts_and_types_are_those_of_stored_frames(roots: tuple[Path, Path], layout: str) -> None:
    view: dict[str, Any] = {"window": 3, "stride": 2, "layout": layout}
    for dtype in ("uint8", "float32"):
        names, starts = ["frames", "states/angle"], [0, 3, 1, 2]
        stored, ds = (gen2d.open(root, fields=names, dtype=dtype, **view) for root in roots)
        tiny.same(ds.batch([7, 0, 7, 4], starts), stored.batch([7, 0, 7, 4], starts))
        loaders = (gen2d.DataLoader(source, 4, epochs=1) for source in (stored, ds))
        for one, other in zip(*loaders, strict=True):
            tiny.same(one, other)
    with pytest.raises(ConfigError, match="starts must be a frame from 0 to 3"):
        ds.batch([0], [4])


@pytest.mark.parametrize("overrides", [NOISE, pytest.param(BLUR, marks=pytest.mark.slow)], ids=["noise", "blur"])
def test_noise_motion_blur_and_a_moving_camera(tmp_path: Path, overrides: list[str]) -> None:
    root, names = generate(tmp_path / "ds", *overrides), ["frames", "camera/scale"]
    for view in VIEWS:
        stored = gen2d.open(root, fields=names, **view)
        ds = gen2d.open(root, fields=names, render={"overrides": ()}, **view)
        tiny.same(ds[[6, 0, 2]], stored[[6, 0, 2]])
        assert ds.exact


def test_annotations_that_are_not_stored(roots: tuple[Path, Path]) -> None:
    names = ["frames", "masks/instance", "boxes/visible"]
    for view in VIEWS:
        stored, ds = (gen2d.open(root, fields=names, **view) for root in roots)
        tiny.same(ds[[1, 8]], stored[[1, 8]])
    both = gen2d.open(roots[0], fields=["frames", "flow/forward"], render={})
    assert both.fields["frames"] is both.manifest.fields["frames"]  # read
    assert both.empty(2)["flow/forward"].shape == (2, 8, 32, 32, 2)


# ---- Other sizes and looks


@pytest.mark.full
def test_another_size_and_look(roots: tuple[Path, Path]) -> None:
    stored, ds = (gen2d.open(root, fields=["frames", "camera/scale"], render=OTHER) for root in roots)
    batch = ds[[3, 9]]
    assert_array_equal(batch["frames"], np.asarray(gen2d.render(ds, [3, 9], **OTHER)))
    assert (ds.sizes["H"], ds.sizes["W"]) == (48, 64)
    assert_array_equal(batch["camera/scale"], gen2d.open(roots[0], fields="camera/scale")[[3, 9]]["camera/scale"] * 1.5)
    assert not ds.exact
    tiny.same(stored[[3, 9]], batch)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"render": {"hight": 3}}, "render has 'hight', but may have height, width, look, overrides, trust"),
        ({"render": {"height": 2}}, "video.height is 2"),
        ({"render": {"look": "flatt"}}, "flat"),
        ({"fields": ["frames", "mask/instance"]}, "has no field 'mask/instance': did you mean 'masks/instance'?"),
        ({"fields": ["frames", "state/angle"]}, "has no field 'state/angle': did you mean 'states/angle'?"),
    ],
)
def test_bad_input_gets_one_sentence(roots: tuple[Path, Path], arguments: Any, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        gen2d.open(roots[1], **arguments)
    assert said in str(caught.value)


# ---- Frameworks, mixtures, concatenations


def test_torch_and_jax(roots: tuple[Path, Path], frames: np.ndarray) -> None:
    jax = package("jax")
    ds = gen2d.open(roots[1], fields=["frames", "index"])
    for batch in gen2d.DataLoader(ds, 5, epochs=1, to="jax"):
        assert isinstance(batch["frames"], jax.Array)
        assert_array_equal(np.asarray(batch["frames"]), frames[np.asarray(batch["index"])])
    torch = package("torch")
    for batch in gen2d.DataLoader(ds, 5, epochs=1, to="torch"):
        assert_array_equal(batch["frames"].numpy(), frames[batch["index"].numpy()])
    for batch in torch.utils.data.DataLoader(ds, 5, shuffle=True):
        assert_array_equal(batch["frames"].numpy(), frames[batch["index"].numpy()])


def test_mixtures_and_concatenations(roots: tuple[Path, Path], frames: np.ndarray) -> None:
    names = ["frames", "index"]
    stored, ds = (gen2d.open(root, fields=names) for root in roots)
    for batch in gen2d.DataLoader(gen2d.mix({"stored": stored, "rendered": ds}, [1, 3]), 4, epochs=1):
        assert_array_equal(batch["frames"], frames[batch["index"]])
    both = gen2d.open([roots[1], roots[1]], fields=names)
    assert_array_equal(both[[12, 3]]["frames"], frames[[2, 3]])
    assert both.exact
    with pytest.raises(ConfigError, match="size H is 16"):
        gen2d.loading.dataset._concatenate([ds, gen2d.open(roots[1], fields=names, render={"height": 16})])


# ---- Snapshots, processes, threads


def test_a_loader_s_state_opens_the_snapshot_again(tmp_path: Path) -> None:
    root = generate(tmp_path / "ds", "storage.frames=none")
    loader = gen2d.DataLoader(gen2d.open(root, fields=["frames", "index"]), 2, epochs=1)
    first = next(iter(loader))
    state = loader.state_dict()
    loader.close()
    gen2d.generate("bouncing.yaml", VIDEOS + 2, root, overrides=[*SMALL, "storage.frames=none"], device="cpu")
    grown = gen2d.open(root, fields=["frames", "index"])
    again = gen2d.DataLoader(grown, 2, epochs=1)
    again.load_state_dict(state)
    assert len(again.dataset) == VIDEOS
    batch = next(iter(again))
    assert_array_equal(batch["frames"], grown.batch(batch["index"])["frames"])
    assert not set(batch["index"]) & set(first["index"])


def test_workers_that_are_forked_say_so_and_spawned_ones_work(roots: tuple[Path, Path], frames: np.ndarray) -> None:
    torch = package("torch")
    ds = gen2d.open(roots[1], fields=["frames", "index"])

    def loader(method: str) -> Any:
        return torch.utils.data.DataLoader(ds, 5, num_workers=1, multiprocessing_context=method)

    with pytest.warns(match="fork"), pytest.raises(UserError, match="does not work in a forked process: load with"):
        next(iter(loader("fork")))
    for batch in loader("spawn"):
        assert_array_equal(batch["frames"].numpy(), frames[batch["index"].numpy()])
    assert_array_equal(pickle.loads(pickle.dumps(ds))[2]["frames"], frames[2])


def test_threads_compile_once(roots: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    made, renderer = [], rendered_dataset._Renderer
    monkeypatch.setattr(rendered_dataset, "_Renderer", lambda *args: made.append(args) or renderer(*args))
    ds = gen2d.open(roots[1], fields="frames")
    threads = [threading.Thread(target=ds.batch, args=([k],)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 1


# ---- Other machines and versions


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"fingerprint": {"jaxlib": "0.1"}}, "fingerprint.jaxlib is 0.1 there"),
        ({"fingerprint": {"device": "cpu sse9"}}, "fingerprint.device is cpu sse9 there"),
        ({"fingerprint": {"programs": {"simulate": "0"}}}, "the program that"),
        ({"producer": {"sources": {"renderers/tiles.py": "0"}}}, "renderers/tiles.py"),
    ],
)
def test_a_foreign_fingerprint_is_logged(
    roots: tuple[Path, Path], frames: np.ndarray, change: Any, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    ds = gen2d.open(roots[1], fields="frames")
    for part, values in change.items():
        for name, value in values.items():
            own = getattr(ds.manifest, part)
            own[name] = {**own[name], **value} if isinstance(value, dict) else value
    with caplog.at_level(logging.INFO, "gen2d"):
        actual = ds[:]["frames"]
    assert not ds.exact
    (record,) = (record for record in caplog.records if record.name.startswith("gen2d"))
    assert record.levelno == logging.WARNING
    assert said in record.getMessage()
    assert np.abs(actual.astype(int) - frames).max() <= 1


def test_what_is_exact_is_logged_once(roots: tuple[Path, Path], caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "gen2d"):
        ds = gen2d.open(roots[1], fields="frames")
        assert ds[0].keys() == ds[1].keys() == {"frames"}
    messages = [record.getMessage() for record in caplog.records if record.name.startswith("gen2d")]
    assert messages == [f"{roots[1]}: rendered frames are those of the dataset, to the bit"]


# ---- Exports


@pytest.mark.parametrize("to", ["npz", "mp4"])
def test_exports_have_frames(roots: tuple[Path, Path], frames: np.ndarray, to: str, tmp_path: Path) -> None:
    exported = [gen2d.export(root, to, tmp_path / name).out for root, name in zip(roots, "ab", strict=True)]
    for number in range(VIDEOS):
        one, other = (folder / f"train-{number:09d}.{to}" for folder in exported)
        if to == "mp4":
            assert one.read_bytes() == other.read_bytes()
        else:
            assert_array_equal(np.load(other)["frames"], frames[number])


@pytest.mark.full
def test_exports_at_another_size(roots: tuple[Path, Path], tmp_path: Path) -> None:
    words = "--to", "npz", "--fields", "frames", "--height", 48, "--width", 64, "--look", "marked"
    done = tiny.run_main("export", roots[1], *words, "--set", "look.background=[0,0,0]", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    expected = gen2d.open(roots[1], fields="frames", render=OTHER)[4]["frames"]
    assert_array_equal(np.load(tmp_path / "out" / "train-000000004.npz")["frames"], expected)
    with pytest.raises(ConfigError, match="must be None where no frames are exported"):
        gen2d.export(roots[0], "npz", tmp_path / "more", fields="index", render={"height": 48})
