"""Videos drawn and simulated again from a dataset: the same frames, other sizes, looks and frame rates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import gen2d
from gen2d.core.errors import ConfigError

SMALL = [
    "storage.batch_size=4",
    "video.frames=8",
    "video.height=32",
    "video.width=48",
    "annotations.masks=true",
    "look=flat",
]
CASES = {
    "plain": [],
    "moving": [
        "camera.pan=[[-1,1],0.5]",
        "camera.shake=0.1",
        "image.occluders=2",
        "image.noise=[1,4]",
        "look=textured",
    ],
}
BLURRED = ["image.exposure=0.5", "image.exposure_samples=4", "look.palette=random", "image.blending=linear"]


def dataset(folder, overrides, n=6):
    gen2d.generate("bouncing.yaml", n, folder, overrides=[*SMALL, *overrides], device="cpu")
    return gen2d.open(folder)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return dataset(tmp_path_factory.mktemp("plain") / "ds", [])


TIERS = {"moving": pytest.mark.full, "blurred": pytest.mark.slow}


@pytest.mark.parametrize("case", [pytest.param(case, marks=TIERS.get(case, ())) for case in (*CASES, "blurred")])
def test_drawn_again_the_frames_are_those_stored(case, tmp_path, plain):
    ds = plain if case == "plain" else dataset(tmp_path / "ds", {**CASES, "blurred": BLURRED}[case])
    assert_array_equal(gen2d.render(ds, range(6)), ds[:]["frames"])
    some = gen2d.render(ds, [5, 2, -1], fields=("frames", "masks/instance"))
    whole = gen2d.open(ds.root, fields=("masks/instance",))
    assert_array_equal(some["frames"], ds[[5, 2, 5]]["frames"])
    assert_array_equal(some["masks/instance"], whole[[5, 2, 5]]["masks/instance"])


def test_a_larger_picture_shows_the_same(plain):
    small = plain[[0, 1]]["frames"].astype(float)
    large = np.asarray(gen2d.render(plain, [0, 1], height=128, width=192, overrides=["look.wall_width=6"])).astype(
        float
    )
    shrunk = large.reshape(2, 8, 32, 4, 48, 4, 3).mean((3, 5))
    # Averages over areas, whatever their size: but for rounding, and for pixels in which several rims meet.
    assert np.quantile(np.abs(shrunk - small), 0.995) < 1.5


def test_soft_frames_are_the_frames_but_for_rounding(plain):
    soft = np.asarray(gen2d.render_soft(plain, [3, 1]))
    assert soft.shape == (2, 8, 32, 48, 3)
    assert soft.dtype == np.float32
    assert np.abs(soft - plain[[3, 1]]["frames"]).max() < 2.5  # every layer is rounded there


@pytest.mark.full
def test_slopes_of_soft_frames_are_those_of_differences_and_reach_from_afar(plain):
    position = jnp.asarray(gen2d.open(plain.root, fields="states/position")[[0]]["states/position"])

    def column(shift, sigma):
        moved = position.at[0, :, 0, 0].add(shift)
        return gen2d.render_soft(plain, [0], states={"states/position": moved}, sigma=sigma)[0].sum((0, 1, 3))

    for sigma in (1.0, 2.0):
        slope = jax.jacfwd(lambda shift, sigma=sigma: column(shift, sigma))(0.0)
        step = 1e-2
        differences = (column(step, sigma) - column(-step, sigma)) / (2 * step)
        assert_allclose(slope, differences, atol=2e-2 * np.abs(differences).max())
    reached = [np.count_nonzero(np.asarray(jax.jacfwd(lambda s, w=w: column(s, w))(0.0))) for w in (0.0, 1.0, 3.0)]
    assert reached[0] < reached[1] < reached[2]


@pytest.mark.parametrize("sigma", [-1.0, float("nan"), 2000])
def test_a_blur_that_cannot_be_is_refused(plain, sigma):
    with pytest.raises(ConfigError, match=r"sigma is .*, but must be a number of pixels from 0 to 1000"):
        gen2d.render_soft(plain, [0], sigma=sigma)


def test_another_look_and_other_annotations(plain):
    fields = gen2d.render(plain, [1], look={"name": "marked"}, fields=("frames", "boxes/visible", "flow/forward"))
    assert (np.asarray(fields["frames"]) != plain[[1]]["frames"]).any()
    assert fields["flow/forward"].shape == (1, 8, 32, 48, 2)


def test_states_alone_are_drawn_when_loaded(tmp_path, plain):
    ds = dataset(tmp_path / "ds", ["storage.frames=none", "annotations.masks=false"])
    assert "frames" not in ds.manifest.fields
    assert list(ds[0]) == [name for name in sorted(ds[0]) if name.startswith("states/")]
    assert_array_equal(gen2d.render(ds, range(6)), plain[:]["frames"])
    assert gen2d.verify(ds.root, "full") == []


@pytest.mark.slow
def test_simulated_again_the_states_are_those_stored(plain):
    again = gen2d.simulate_again(plain, [0, 3])
    assert_allclose(again["states/position"], plain[[0, 3]]["states/position"], atol=1e-5)


def test_simulated_again_at_twice_the_frame_rate_the_motion_is_the_same(plain):
    twice = gen2d.simulate_again(plain, [0, 3], fps=60, frames=15)
    assert_allclose(twice["time"], np.arange(15) / 60, atol=1e-6)
    # The same motion, but for where in a step impacts fall.
    assert_allclose(twice["states/position"][:, ::2][:, :3], plain[[0, 3]]["states/position"][:, :3], atol=2e-2)
    assert gen2d.render(plain, [0, 3], states=twice).shape == (2, 15, 32, 48, 3)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda ds: gen2d.render(ds, [6]), "video 6 is not there"),
        (lambda ds: gen2d.render(ds, np.array([0.5])), "must be an integer"),
        (lambda ds: gen2d.render(ds, [0], height=2), "video.height is 2"),
        (lambda ds: gen2d.render(ds, [0], look="flatt"), "flat"),
        (lambda ds: gen2d.render(ds, [0], fields=("frame",)), "fields holds 'frame'"),
        (lambda ds: gen2d.simulate_again(ds, [0], fps=-1), "video.fps is -1"),
    ],
)
def test_bad_input_gets_one_sentence(plain, call, said):
    with pytest.raises((ConfigError, IndexError, TypeError), match=said) as caught:
        call(plain)
    assert "\n" not in str(caught.value)
