"""Springs: the midpoint rule keeps their energy, at any stiffness."""

import numpy as np
import pytest
from laws import holds

from gen2d import Space


@pytest.mark.full
@pytest.mark.parametrize(("stiffness", "bound"), [(1.0, 1e-5), (1e3, 1e-4), (1e6, 1e-3), (1e9, 1e-2)])
def test_a_spring_keeps_its_energy_at_any_stiffness(stiffness: float, bound: float):
    """From 2 m between two bodies of 1 and 3 kg in space, pulled apart by a tenth of that."""
    space = Space(gravity=(0, 0))
    masses = np.array([1.0, 3.0])
    bodies = [space.add_circle((x, 0), 0.2, mass=mass) for x, mass in zip((-1.1, 1.1), masses, strict=True)]
    space.add_joint("distance", *bodies, length=2.0, stiffness=stiffness)
    video = space.simulate(seconds=4, fps=60, contacts=0)
    stretch = np.linalg.norm(video.position[:, 1].astype(float) - video.position[:, 0], axis=-1) - 2.0
    energy = 0.5 * (masses * (video.velocity**2).sum(-1)).sum(1) + 0.5 * stiffness * stretch**2
    holds(f"spring of {stiffness:g} N/m: energy, relative", energy / energy[0] - 1, bound)  # of rounded positions
    momentum = (video.velocity * masses[:, None]).sum(1)
    holds(f"spring of {stiffness:g} N/m: momentum, relative", momentum / np.sqrt(energy[0]), 1e-4)
