"""The solver's parameters."""

import dataclasses
import math

from gen2d.config.sections import PhysicsOptions


@dataclasses.dataclass(frozen=True)
class SolverParams:
    """Numbers of a solver step; `solver_params` makes them from a config."""

    step: float  # s
    bounce_threshold: float  # m/s: slower impacts do not bounce, nor do those that gravity makes in two steps
    hertz: float  # stiffness of an overlapping contact; twice that against a fixed object
    damping_ratio: float
    push_speed: float  # m/s: an overlap is undone no faster
    damping: float  # 1/s, of velocity and spin
    mixing: str

    def softness(self, hertz: float, damping_ratio: float) -> tuple[float, float, float]:
        """Of an implicit damped spring at this step: bias rate (1/s), mass scale and impulse scale."""
        omega = 2 * math.pi * hertz
        a1 = 2 * damping_ratio + self.step * omega
        a2 = self.step * omega * a1
        return omega / a1, a2 / (1 + a2), 1 / (1 + a2)


def solver_params(physics: PhysicsOptions, fps: float, steps: int) -> SolverParams:
    """The solver's numbers, from the options of physics and the steps of a frame."""
    step = 1 / (fps * steps)
    return SolverParams(
        step=step,
        bounce_threshold=physics.bounce_threshold,
        hertz=min(physics.contact_hertz, 0.125 / step),
        damping_ratio=physics.contact_damping_ratio,
        push_speed=physics.push_speed,
        damping=physics.damping,
        mixing=physics.mixing,
    )
