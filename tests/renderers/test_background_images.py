"""Backgrounds of the user's images: crops by the seed, hashes in the recipe, and no path that a dataset names."""

import json
import subprocess
from pathlib import Path

import jax
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image
from tiny import command, everything, sentences, tiny_config

import gen2d
from gen2d.config.config import load_config
from gen2d.config.reading import yaml_text
from gen2d.core.errors import ConfigError, UserError
from gen2d.media import backgrounds
from gen2d.programs.rollout import Rollout
from gen2d.storage import image_folder
from gen2d.storage.sealed import sha256

CONFIG = tiny_config(look={"name": "flat", "background_kind": "images"}, video={"frames": 2})


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of three images whose pixels say where they are, in a process that has none."""
    monkeypatch.setattr(image_folder, "_files", {})
    monkeypatch.setattr(image_folder, "_newest", ())
    backgrounds._decoded.cache_clear()
    root = tmp_path / "photos"
    root.mkdir()
    rows, columns = np.mgrid[:120, :200]
    for number, name in enumerate(("a.png", "b.webp", "c.PNG")):
        image = np.stack([columns, rows, np.full_like(rows, 100 * number)], -1).astype(np.uint8)
        Image.fromarray(image).save(root / name, lossless=True)
    (root / "notes.txt").write_text("not an image")
    return root


def hashes(folder: Path) -> list[str]:
    return [sha256(path.read_bytes()) for path in sorted(folder.iterdir()) if path.suffix != ".txt"]


def test_crops_are_parts_of_the_images_and_their_hashes_are_the_recipe(folder: Path, tmp_path: Path) -> None:
    assert [*gen2d.use_images(folder)] == hashes(folder)
    gen2d.generate(CONFIG, 12, tmp_path / "data")
    stored = everything(tmp_path / "data")
    manifest = (tmp_path / "data" / "manifest.json").read_text()
    assert json.loads(manifest)["config"]["look"]["background_images"] == hashes(folder)
    assert str(folder) not in manifest
    seen = set()
    for frames in stored["frames"].astype(int):
        height = frames.shape[1]
        numbers, counts = np.unique(frames[..., 2], return_counts=True)  # blue tells which image it is
        image = int(numbers[counts.argmax()])
        seen.add(image // 100)
        ground = frames[..., 2] == image
        steps = [np.diff(frames[..., channel], axis=axis) for channel, axis in ((0, 2), (1, 1))]
        inner = [ground[:, :, 1:] & ground[:, :, :-1], ground[:, 1:] & ground[:, :-1]]
        step = [float(part[mask].mean()) for part, mask in zip(steps, inner, strict=True)]
        assert abs(step[0] - step[1]) < 0.2  # pixels are square
        assert 0.6 * 120 / height - 0.1 < step[0] <= 120 / height + 0.1
        assert frames[..., 0][ground].max() <= 200
        both = ground.all(0)  # with a few pixels that balls cover a little
        assert (frames[0][both] == frames[1][both]).mean() > 0.95
    assert seen == {0, 1, 2}
    assert_array_equal(np.asarray(gen2d.render(gen2d.open(tmp_path / "data"), range(12))), stored["frames"])


def test_a_dataset_is_read_without_its_images_and_rendered_with_them_alone(folder: Path, tmp_path: Path) -> None:
    """In processes that were told of no folder, of another one, and of the right one under another name."""
    (tmp_path / "images.yaml").write_text(yaml_text(CONFIG))
    run(tmp_path, 0, "images.yaml", "--n", 2, "--out", "data", "--images", folder)
    run(tmp_path, 0, "verify", "data")
    message = run(tmp_path, 2, "verify", "data", "--level", "regen")
    assert "look.background_images has sha256" in message
    assert "but no image of a folder named in --images is it" in message
    folder.rename(tmp_path / "moved")
    run(tmp_path, 0, "verify", "data", "--level", "regen", "--images", tmp_path / "moved")
    other = tmp_path / "other"
    other.mkdir()
    Image.new("RGB", (30, 30)).save(other / "a.png")
    assert "is it" in run(tmp_path, 2, "verify", "data", "--level", "regen", "--images", other)
    assert "no folder of images is named in --images" in run(tmp_path, 2, "images.yaml", "--n", 2, "--out", "more")


def run(cwd: Path, code: int, *arguments: object) -> str:
    """Errors of a command, which must end with this exit code and without a traceback."""
    words, environment = command(*arguments)
    done = subprocess.run(words, env=environment, cwd=cwd, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return " ".join(sentences(done.stderr))


def test_images_that_change_or_are_none_are_refused_in_one_sentence(folder: Path, tmp_path: Path) -> None:
    gen2d.use_images(folder)
    (folder / "a.png").write_bytes((folder / "b.webp").read_bytes())
    with pytest.raises(ConfigError, match=r"a\.png: has changed since its folder was named"):
        image_folder.image_file(hashes_before(folder))
    (folder / "a.png").write_bytes(b"\x89PNG and nothing")
    gen2d.use_images(folder)
    with pytest.raises(ConfigError, match=r"a\.png: cannot be read as a PNG, JPEG, WEBP image"):
        backgrounds.crops((sha256((folder / "a.png").read_bytes()),), np.zeros(1), np.zeros((1, 2)), np.ones(1), 8, 8)
    Image.new("RGB", (2, 2)).save(folder / "d.png", format="GIF")  # another format by this name
    gen2d.use_images(folder)
    with pytest.raises(ConfigError, match=r"d\.png: cannot be read"):
        backgrounds.crops((sha256((folder / "d.png").read_bytes()),), np.zeros(1), np.zeros((1, 2)), np.ones(1), 8, 8)
    for path, words in ((tmp_path / "none", "cannot be read"), (tmp_path, "must be a folder of PNG")):
        with pytest.raises(UserError, match=words):
            gen2d.use_images(path)


def hashes_before(folder: Path) -> str:
    """The hash under which a.png was named."""
    return next(digest for digest, path in image_folder._files.items() if path.name == "a.png")


def test_an_image_of_too_many_pixels_is_not_decoded(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backgrounds, "PIXELS", 100)
    gen2d.use_images(folder)
    with pytest.raises(ConfigError, match=r"a\.png: has 200 x 120 px, but may have 100 in all"):
        backgrounds.crops((hashes(folder)[0],), np.zeros(1), np.zeros((1, 2)), np.ones(1), 8, 8)


def test_a_camera_that_moves_is_refused(folder: Path) -> None:
    gen2d.use_images(folder)
    with pytest.raises(ConfigError, match="background_kind is images, which are fixed to the frame, but the camera"):
        Rollout(load_config(CONFIG, ["camera.zoom=0.1"]), jax.devices()[:1])


@pytest.mark.parametrize(
    ("look", "words"),
    [
        ({"background_kind": "images"}, "no folder of images is named in gen2d.use_images"),
        (
            {"background_kind": "images", "background_images": ["/etc/passwd"]},
            "has '/etc/passwd', but must have sha256",
        ),
    ],
)
def test_a_config_holds_hashes_and_no_path(folder: Path, look: dict, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_config(tiny_config(look={"name": "flat", **look}))
