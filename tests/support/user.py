"""A user's script that calls every public function: `mypy --strict` checks it, nothing runs it."""

from pathlib import Path
from typing import assert_type

import jax
import numpy as np
import torch

import gen2d


def train(root: Path) -> float:
    config = gen2d.load_config("bouncing.yaml", ["video.fps=30"])
    summary = gen2d.generate(config, n=64, out=root, seed=7)
    print(summary.generated, summary.out, summary.videos_per_second)
    ds = gen2d.open(root, fields=["frames", "states/*"], window=16)
    assert_type(ds, gen2d.Dataset)
    assert_type(ds[0], dict[str, np.ndarray])
    total = float(ds[0]["frames"].mean())
    with gen2d.DataLoader(ds, batch_size=32, epochs=1) as loader:
        for batch in loader:
            assert_type(batch, dict[str, np.ndarray])
            total += float(batch["states/position"].sum())
        state = loader.state_dict()
        loader.load_state_dict(state)
    for tensors in gen2d.DataLoader(ds, batch_size=8, epochs=1, to="torch", device="cpu"):
        assert_type(tensors, dict[str, torch.Tensor])
        total += tensors["frames"].float().mean().item()
    few = ds.filter("factors/balls > 3").select([0, 1])
    print(len(few), ds.splits, ds.fps, ds.config["scene"], ds.fields["objects/kind"].codes, few.to_pandas())
    videos = assert_type(gen2d.torch.dataset(ds, seed=1), gen2d.torch.VideoDataset)
    videos.set_epoch(3)
    order = gen2d.torch.sampler(videos)
    print(next(iter(torch.utils.data.DataLoader(videos, batch_size=8, sampler=order)))["frames"])
    several = assert_type(gen2d.torch.iterable(ds, batch_size=8), gen2d.torch.IterableVideoDataset)
    several.load_state_dict(several.state_dict())
    print(len(gen2d.grain.source(ds, epochs=2)), videos.epoch)
    for arrays in gen2d.stream(config, batch_size=8, n=8, epochs=1, fields=["states/position"]):
        total += float(arrays["states/position"].sum())
    larger = gen2d.open(root, fields=["frames"], render={"height": 128, "width": 128, "look": "shaded"})
    print(assert_type(larger, gen2d.Dataset).exact, larger.sizes["H"])
    both = gen2d.open([root, root])
    mixture = gen2d.mix({"one": ds, "other": both}, [3, 1])
    print(len(mixture), mixture[0]["frames"].shape)
    rendered = assert_type(gen2d.render(ds, [0, 1], height=32), jax.Array)
    masks = assert_type(gen2d.render(ds, range(2), fields=["masks/instance"]), dict[str, jax.Array])
    states = gen2d.simulate_again(ds, [0], fps=120.0)
    soft = gen2d.render_soft(ds, [0], states=states, sigma=1.5)
    print(rendered.shape, masks.keys(), assert_type(soft, jax.Array).dtype)
    space = gen2d.Space(gravity=(0.0, -9.8))
    ball = space.add_circle((0.0, 3.0), 0.5, elasticity=0.9)
    space.add_segment((-5.0, 0.0), (5.0, 0.0))
    video = space.simulate(2.0, fps=60.0)
    print(video.position[:, ball], video.energy, video.contacts)
    exported = gen2d.export(root, "npz", root / "npz", render={"height": 128})
    problems: list[str] = gen2d.verify(root)
    previews: list[Path] = gen2d.preview(root, out=root)
    plots: list[Path] = gen2d.plot(root, root, video=3)
    try:
        gen2d.open("nothing")
    except gen2d.UserError as error:
        print(error)
    print(exported.videos, problems, previews, plots, gen2d.info(root))
    return total
