"""Data sources for Grain, with random windows.

    source = gen2d.grain.source(gen2d.open("datasets/bouncing", window=16), seed=0, epochs=10)
    for batch in grain.MapDataset.source(source).batch(32).to_iter_dataset(): ...

Grain itself is not imported: the sources need only a length and random access.
"""

from gen2d.loading.mixture import Mixture
from gen2d.loading.protocols import VideoReader
from gen2d.loading.windows import EpochSource

__all__ = ["source"]


def source(
    ds: VideoReader | Mixture, seed: int = 0, *, shuffle: bool | str = True, epochs: int | None = 1
) -> EpochSource:
    """Random-access data source of successive epochs, for `grain.MapDataset.source` and `grain.DataLoader`.

    Its videos and windows are those of `gen2d.DataLoader` with the same seed, in the same order, so do not shuffle or
    repeat them again in Grain. An item is a dictionary of NumPy arrays by field name; items of windows also hold
    `window/start` and `window/time`.

    Parameters
    ----------
    ds : Dataset, ConcatDataset or Mixture
        A dataset from `gen2d.open` or `gen2d.mix`.
    seed : int
        Seed of the shuffling and of random windows.
    shuffle : bool or "global"
        Whether the videos are permuted anew in each epoch; False keeps their order.
    epochs : int, optional
        Number of epochs. With None they never end.

    Returns
    -------
    EpochSource
        A sequence of `epochs * len(ds)` videos. It can be pickled.

    Raises
    ------
    ConfigError
        If an argument is invalid. Reading raises the errors of `Dataset.batch`.

    Examples
    --------
    >>> source = gen2d.grain.source(gen2d.open("datasets/bouncing", window=16), seed=0, epochs=10)
    >>> source[0]["frames"].shape, source[0]["window/time"].shape
    ((16, 64, 64, 3), (16,))
    """
    return EpochSource(ds, seed, shuffle, epochs)
