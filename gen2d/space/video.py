"""Result of the simulation of a `Space`."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.space.bodies import Body, Joint


@dataclasses.dataclass(frozen=True)
class Video:
    """Trajectories of K bodies, in the order in which they were added, as NumPy arrays over T frames."""

    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    time: np.ndarray  # [T] s
    position: np.ndarray  # [T, K, 2] m
    angle: np.ndarray  # [T, K] rad
    velocity: np.ndarray  # [T, K, 2] m/s
    angular_velocity: np.ndarray  # [T, K] rad/s
    contacts: Any  # Contacts, or None: filled rows only, ordered by time; a and b are numbers of bodies
    energy: Any  # Energy, or None: [T] J, and the momentum
    quality: Any  # Quality: scalar measures of the simulation

    @property
    def fps(self) -> float:
        """Frames per second."""
        return float(1 / (self.time[1] - self.time[0]))

    @property
    def momentum(self) -> Any:
        """Momentum of all dynamic bodies [T, 2] in kg m/s; None unless simulated with energy=True."""
        return None if self.energy is None else self.energy.linear

    def picture(self, frame: int = 0, **options: Any) -> np.ndarray:
        """Image of one frame, uint8 [H, W, 3]; options are those of `plot.picture`."""
        from gen2d.space import plot

        return plot.picture(self, frame, **options)

    def overlay(self, **options: Any) -> np.ndarray:
        """Image of all frames over each other, uint8 [H, W, 3]; options are those of `plot.overlay`."""
        from gen2d.space import plot

        return plot.overlay(self, **options)

    def save(self, path: str | Path, **options: Any) -> Path:
        """Write a film (.webp, .mp4) or an image of all frames (.png); return the path. Options as in `plot.save`."""
        from gen2d.space import plot

        return plot.save(self, path, **options)
