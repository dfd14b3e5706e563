"""Arrays on their way from a device to the host, through the pinned memory that GPUs write."""

import jax
import numpy as np
import pytest

from gen2d.config.config import load_config
from gen2d.programs import devices
from gen2d.programs.source import VideoSource

SMALL = ["storage.batch_size=8", "video.frames=4", "video.height=32", "video.width=32", "scene.balls=2"]


@pytest.mark.parametrize("dtype", ["uint8", "bool", "int32", "float32", "float64"])
def test_pinned_arrays_keep_type_and_bits(dtype):
    values = np.random.default_rng(0).normal(0, 100, (3, 5)).astype(dtype)
    with jax.enable_x64(True):
        array = jax.device_put(values)
    pinned = devices.pinned(array)
    assert pinned.sharding.memory_kind == "pinned_host"
    assert np.asarray(pinned).dtype == dtype
    np.testing.assert_array_equal(np.asarray(pinned), values)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_videos_pass_through_pinned_memory_unchanged(monkeypatch, precision):
    config = load_config("bouncing.yaml", [*SMALL, f"physics.precision={precision}"])
    source = VideoSource(config, devices.prepare("cpu")[:1])
    expected = source.videos("train", np.arange(5))
    taken = []
    monkeypatch.setattr(devices, "_on_cpu", lambda array: False)
    monkeypatch.setattr(devices, "pinned", lambda array, to=devices.pinned: taken.append(array) or to(array))
    passed = source.videos("train", np.arange(5))
    assert len(taken) >= len(passed) // 2
    for name, values in expected.items():
        assert passed[name].dtype == values.dtype
        np.testing.assert_array_equal(passed[name], values)
