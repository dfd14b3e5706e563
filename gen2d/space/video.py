"""The result of a simulation by hand."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.space.bodies import Body, Joint


@dataclasses.dataclass(frozen=True)
class Video:
    """What a space did: NumPy arrays, T frames of K bodies in the order in which they were added."""

    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    time: np.ndarray  # [T] s
    position: np.ndarray  # [T, K, 2] m
    angle: np.ndarray  # [T, K] rad
    velocity: np.ndarray  # [T, K, 2] m/s
    angular_velocity: np.ndarray  # [T, K] rad/s
    contacts: Any  # types.Contacts: only the rows there are, in order of time; a and b are numbers of bodies
    energy: Any  # types.Energy: [T] J, and the momentum
    quality: Any  # types.Quality

    @property
    def fps(self) -> float:
        """Frames per second."""
        return float(1 / (self.time[1] - self.time[0]))

    @property
    def momentum(self) -> Any:
        """Of all dynamic bodies [T, 2], kg m/s; needs energy=True."""
        return None if self.energy is None else self.energy.linear

    def picture(self, frame: int = 0, **options: Any) -> np.ndarray:
        """One instant as uint8 [H, W, 3]; options are those of `plot.picture`."""
        from gen2d.space import plot

        return plot.picture(self, frame, **options)

    def overlay(self, **options: Any) -> np.ndarray:
        """All frames over each other as uint8 [H, W, 3]; options are those of `plot.overlay`."""
        from gen2d.space import plot

        return plot.overlay(self, **options)

    def save(self, path: str | Path, **options: Any) -> Path:
        """The path of a file written there: .webp or .mp4 the video, .png all frames over each other."""
        from gen2d.space import plot

        return plot.save(self, path, **options)
