"""The solver's parameters."""

import dataclasses
import math

from gen2d.config.sections import PhysicsOptions
from gen2d.records.parameter import minimum

FEWEST_LATE_PASSES = 4  # in scenes with a late impact, or with loads in the first steps
LATE_PASSES = 16  # the most in those where each one finds another late impact
FIRST_STEPS = 48  # of a video: no impulses are known that these could start with


@dataclasses.dataclass(frozen=True)
class SolverParams:
    """Parameters of a solver step; `solver_params` computes them from a config."""

    step: float  # s
    bounce_threshold: (
        float  # m/s: slower impacts do not bounce, nor do those at speeds that gravity reaches in two steps
    )
    hertz: float  # stiffness of an overlapping contact; doubled against static and kinematic bodies
    damping_ratio: float
    push_speed: float  # m/s: the fastest correction of an overlap
    damping: float  # 1/s, of velocity and spin
    mixing: str
    by_time: bool  # the impacts of discs in a step act in the order of their times, not of the solver's pairs
    extreme_mass_ratios: bool  # bodies that far heavier ones crush stop these where obstacles stop them
    relax_iterations: int | None  # passes over all pairs at the end of a step; None: more if an impact is late

    @property
    def late_passes(self) -> int:
        """Most relaxing passes that find impacts that others have caused in the step; 0: none."""
        if self.relax_iterations is None:
            return LATE_PASSES
        return self.relax_iterations if self.relax_iterations > 1 else 0

    @property
    def fewest_late_passes(self) -> int:
        """Number of these passes after which a scene is solved if the last one found no impact."""
        return FEWEST_LATE_PASSES if self.relax_iterations is None else self.late_passes

    def bias_rate(self, hertz: float, damping_ratio: float) -> float:
        """Share of an error that an implicit damped spring corrects, 1/s."""
        omega = 2 * math.pi * hertz
        return omega / (2 * damping_ratio + self.step * omega)


def solver_params(physics: PhysicsOptions, fps: float, steps: int) -> SolverParams:
    """Parameters of the solver for `steps` steps per frame."""
    step = 1 / (fps * steps)
    return SolverParams(
        step=step,
        bounce_threshold=physics.bounce_threshold,
        hertz=minimum(physics.contact_hertz, 0.125 / step),
        damping_ratio=physics.contact_damping_ratio,
        push_speed=physics.push_speed,
        damping=physics.damping,
        mixing=physics.mixing,
        by_time=physics.impact_order == "time",
        extreme_mass_ratios=physics.extreme_mass_ratios,
        relax_iterations=physics.relax_iterations,
    )
