"""The solver against closed forms of mechanics (C1 to C15, C20, C21): every set-up at four orientations, and mirrored.

Steps are of 1/240 s, discs have a radius of 0.5 m and the mass of their area in kg, unless a test says otherwise.
"""

import functools

import numpy as np
import pytest
from laws import DOWN, FLOOR, GRAVITY, Case, Motion, holds, times, watch
from worlds import STEP, box, rotate, rules

RADIUS = 0.5  # m
MASS = np.pi * RADIUS**2  # kg
SLOPE = 20.0  # degrees
SIN, COS = np.sin(np.radians(SLOPE)), np.cos(np.radians(SLOPE))


def on_slope(degrees: float = SLOPE, **disc) -> Case:
    """A disc at rest on a plane that falls towards +x."""
    ends = {"a": rotate((-50, 0), -degrees), "b": rotate((50, 0), -degrees)}
    return Case([{"x": rotate((0, RADIUS), -degrees), "elasticity": 0, **disc}], [{**FLOOR, **ends}], DOWN)


def downhill(vectors: np.ndarray, degrees: float = SLOPE) -> np.ndarray:
    """The part of vectors [..., 2] along such a plane."""
    return vectors @ np.array(rotate((1, 0), -degrees))


# Free motion --------------------------------------------------------------------------------------------------------


def test_c1_projectile_is_on_its_parabola():
    made, t = watch([Case([{"v": (3, 4)}], gravity=DOWN)]), times(481)
    exact = np.stack([3 * t, 4 * t - GRAVITY * t**2 / 2], axis=-1)
    holds("C1 projectile, 2 s, m", made.x[:, :, :481, 0] - exact, 1e-4)


def test_c2_constant_force_and_torque():
    """v = F t / m and w = tau t / I; place and angle are their integrals."""
    # Needs the keys `force` (N) and `torque` (N m) of a disc in worlds.world.
    force, torque, t = np.array([2.0, -1.0]), 0.3, times(721)[1:]
    made = watch([Case([{"force": force, "torque": torque}])])
    v, w = force * t[:, None] / MASS, torque * t / (MASS * RADIUS**2 / 2)
    holds("C2 force, relative", made.v[:, :, 1:, 0] / v - 1, 1e-4)
    holds("C2 torque, relative", made.spin[:, :, 1:, 0] / w - 1, 1e-4)
    holds("C2 way under a force, relative", made.x[:, :, 1:, 0] / (v * t[:, None] / 2) - 1, 1e-4)
    holds("C2 angle under a torque, relative", made.angle[:, :, 1:, 0] / (w * t / 2) - 1, 1e-4)


@pytest.mark.full
def test_c2_damping_is_exponential_whatever_the_step():
    rate, runs = 0.5, {}
    for per_frame in (1, 4, 8):  # steps of 1/60, 1/240, 1/480 s
        numbers = rules(1 / 60 / per_frame, damping=rate)
        cases = [Case([{"v": (3, 4), "spin": 5}]), Case([{}], gravity=DOWN)]
        runs[per_frame] = watch(cases, 181, per_frame, numbers=numbers)
    slowed = np.exp(-rate * times(181, 1 / 60))
    for made in runs.values():
        holds("C2 damped speed, relative", made.v[0, :, :, 0] / (slowed[:, None] * [3, 4]) - 1, 1e-4)
        holds("C2 damped spin, relative", made.spin[0, :, :, 0] / (slowed * 5) - 1, 1e-4)
    fall = {k: made.v[1, :, 1:, 0, 1] / (-GRAVITY / rate * (1 - slowed[1:])) for k, made in runs.items()}
    for per_frame in (1, 8):
        holds("C2 damped fall does not depend on the step, relative", fall[per_frame] / fall[4] - 1, 1e-3)


# Single collisions --------------------------------------------------------------------------------------------------


def test_c3_c6_head_on_collision_is_newtons_and_makes_no_spin():
    u, masses = 2.0, [(1, 1), (1, 10), (1, 100), (10, 1), (100, 1)]
    each = [(m1, m2, e) for m1, m2 in masses for e in (0.0, 0.5, 1.0)]
    first = {"x": (-2, 0), "v": (u, 0), "friction": 1}
    cases = [
        Case([{**first, "mass": m1}, {"x": (2, 0), "mass": m2, "elasticity": e, "friction": 1}]) for m1, m2, e in each
    ]
    made = watch(cases)
    exact = np.array([[(m1 - e * m2) * u / (m1 + m2), (1 + e) * m1 * u / (m1 + m2)] for m1, m2, e in each])
    size = np.where(exact == 0, u, np.abs(exact))
    holds("C3 head-on, relative", (made.v[:, :, -1, :, 0] - exact[:, None]) / size[:, None], 1e-5)
    holds("C6 head-on: sideways speed, m/s", made.v[..., 1], 1e-6)
    holds("C6 head-on: spin, rad/s", made.spin, 1e-6)


def test_c4_oblique_smooth_collision_exchanges_the_normal_components():
    u, offsets = 4.0, np.array([0, 0.1, 0.25, 0.5, 0.75, 0.95]) * 2 * RADIUS  # up to 1.9 r
    made = watch([Case([{"x": (-3, 0), "v": (u, 0)}, {"x": (0, -b)}]) for b in offsets])
    normal = np.stack([np.sqrt(1 - offsets**2), -offsets], axis=-1)
    second = u * normal[:, :1] * normal
    exact = np.stack([[u, 0] - second, second], axis=1)
    last = made.v[:, :, -1]

    def direction(v: np.ndarray) -> np.ndarray:
        return np.arctan2(v[..., 1], v[..., 0])

    holds("C4 oblique: angle of the struck disc, rad", direction(last[:, :, 1]) - direction(exact[:, None, 1]), 1e-3)
    glancing = direction(last[1:, :, 0]) - direction(exact[1:, None, 0])  # the first stands still after b = 0
    holds("C4 oblique: angle of the striking disc, rad", glancing, 1e-3)
    holds("C4 oblique: speeds, of u", (last - exact[:, None]) / u, 1e-3)
    holds("C4 oblique: momentum, relative", (last.sum(2) - [u, 0]) / u, 1e-5)


def test_a_disc_that_only_just_misses_another_is_not_deflected():
    cases = [Case([{"x": (-3, 0), "v": (u, 0)}, {"x": (0, -2 * RADIUS - 1e-3)}]) for u in (4, 40, 200)]
    made = watch(cases)
    speeds = np.array([4, 40, 200])[:, None]
    holds("Near miss: speed, relative", made.v[:, :, -1, 0, 0] / speeds - 1, 1e-6)
    holds("Near miss: sideways speed, m/s", made.v[:, :, -1, 0, 1], 1e-6)
    holds("Near miss: speed of the other, m/s", made.v[:, :, -1, 1], 1e-6)


def test_c5_friction_at_a_wall_is_coulombs():
    each = [(mu, e, w) for mu in (0, 0.1, 0.2, 1) for e in (0, 0.5, 1) for w in (0.0, 10.0, -10.0)]
    u, v = 3.0, -4.0
    cases = [
        Case([{"x": (0, 1.013), "v": (u, v), "spin": w, "elasticity": e, "friction": mu}], [FLOOR]) for mu, e, w in each
    ]
    made = watch(cases)
    mu, e, spin = np.array(each).T
    slip = u + spin * RADIUS
    change = np.minimum(mu * (1 + e) * abs(v), np.abs(slip) / 3) * np.sign(slip)
    holds("C5 friction: speed along, m/s", made.v[:, :, -1, 0, 0] - (u - change)[:, None], 1e-3)
    holds("C5 friction: speed away, m/s", made.v[:, :, -1, 0, 1] - (-e * v)[:, None], 1e-3)
    # m r change = I (change of spin), with I = m r^2 / 2
    rim = made.spin[:, :, -1, 0] * RADIUS - (spin * RADIUS - 2 * change)[:, None]
    holds("C5 friction: rim speed, m/s", rim, 1e-3)


# Bounces ------------------------------------------------------------------------------------------------------------

HEIGHT, ELASTICITIES = 3.0, (1.0, 0.9, 0.8, 0.5)


@functools.cache
def drop() -> Motion:
    """A disc of each elasticity dropped from 3 m: 16.7 s, every step."""
    return watch(
        [Case([{"x": (0, RADIUS + HEIGHT), "elasticity": e}], [FLOOR], DOWN) for e in ELASTICITIES], frames=4001
    )


def test_c7_bounces_rise_to_e_squared_of_the_height_before():
    first, later, elastic = [], [], []
    for e, poses in zip(ELASTICITIES, drop().x[..., 0, 1] - RADIUS, strict=True):
        for y in poses:
            tops = y[1:-1][(y[:-2] < y[1:-1]) & (y[1:-1] >= y[2:])]
            exact = HEIGHT * e ** (2.0 * np.arange(1, 11))
            exact = exact if e == 1 else exact[:5][exact[:5] > 0.2]
            ratio = tops[: len(exact)] / exact - 1
            first.append(ratio[0])
            (elastic if e == 1 else later).extend(ratio)
    holds("C7 first bounce height, relative", first, 5e-4)
    holds("C7 bounce heights down to 0.2 m, relative", later, 2e-3)
    holds("C7 bounce heights, e = 1, 10 bounces, relative", elastic, 1e-3)
    top = drop().x[0, ..., 0, 1].max() - RADIUS
    holds("C7 elastic bounce rises above its start, relative", max(top / HEIGHT - 1, 0), 1e-4)


def test_c8_bounces_happen_in_time_and_end_in_time():
    """To the time of rest count bounces of all sizes; a threshold above which they count must be that small."""
    fall, t = np.sqrt(2 * HEIGHT / GRAVITY), times(4001)
    events, rest = [], []
    for e, poses in zip(ELASTICITIES, drop().v[..., 0, :], strict=True):
        for v in poses:
            when = t[1:][(v[:-1, 1] < 0) & (v[1:, 1] > 0)] - STEP / 2
            n = np.arange(len(when))
            exact = fall * (2 * np.cumsum(e**n) - 1)
            events.extend((when - exact)[e**n * fall * GRAVITY > 0.5] / STEP)  # impacts at over 0.5 m/s
            if e < 1:
                rest.append(t[np.hypot(*v.T) > 1e-3].max() / (fall * (1 + e) / (1 - e)) - 1)
    holds("C8 times of bounces, steps", events, 2)
    holds("C8 time until rest, relative", rest, 1e-2)


# Cradles ------------------------------------------------------------------------------------------------------------


def cradle(gap: float, speed: float) -> Case:
    """A disc that flies at a row of four."""
    row = [{"x": (k * (2 * RADIUS + gap), 0)} for k in range(4)]
    return Case([{"x": (-2 * RADIUS - 1, 0), "v": (speed, 0)}, *row])


@pytest.mark.full
def test_c9_cradle_hands_the_speed_to_the_last():
    speed = 2.0
    made = watch([cradle(0.05, speed), cradle(2 * speed * STEP, speed)], 361, 2, slots=8)
    last = made.v[:, :, -1, :5] / speed
    holds("C9 cradle: the last leaves with v, relative", last[:, :, 4] - [1, 0], 1e-3)
    holds("C9 cradle: the others stand, of v", last[:, :, :4], 1e-3)
    holds("C9 cradle: energy, relative", (last**2).sum((-1, -2)) - 1, 1e-4)
    holds("C9 cradle: momentum, relative", last.sum(2) - [1, 0], 1e-6)


@pytest.mark.slow
def test_c9b_touching_cradle_keeps_momentum_and_energy():
    """How the speeds are shared out is not determined."""
    speed = 2.0
    made = watch([cradle(0, speed), cradle(1e-3, speed)], 361, 2, slots=8)
    v = made.v[..., :5, :] / speed
    energy = (v**2).sum((-1, -2))
    holds("C9b touching cradle: momentum, relative", v.sum(3) - [1, 0], 1e-6)
    holds("C9b touching cradle: energy gained, relative", np.maximum(energy - 1, 0), 1e-4)
    holds("C9b touching cradle: energy lost, relative", np.maximum(1 - energy, 0), 0.05)


# Rolling and sliding ------------------------------------------------------------------------------------------------


def speed_after_impacts_in_sequence(elasticity: float) -> float:
    """Speed at which a disc leaves an equal one at rest on a floor, of that at which it arrives.

    The lower one hits the floor, and the upper one again, until the upper one is faster.
    """
    upper, lower = -1.0, 0.0
    while upper < lower - 1e-9:
        push = (1 + elasticity) / 2 * (lower - upper)
        upper, lower = upper + push, lower - push
        lower = abs(elasticity * lower)
    return upper


def test_disc_bounces_off_a_resting_one_by_impacts_in_sequence():
    """Newton's law for one impact after the other, not for all at once, which would be e times the speed of arrival."""
    ratios, fall = (0.5, 0.8, 0.9, 1.0), 1.0
    discs = [[{"x": (0, RADIUS + k * (2 * RADIUS + fall)), "elasticity": np.sqrt(e)} for k in (0, 1)] for e in ratios]
    floors = [{**FLOOR, "elasticity": np.sqrt(e)} for e in ratios]
    made = watch([Case(pair, [floor], DOWN) for pair, floor in zip(discs, floors, strict=True)])
    arrival, frame = np.sqrt(2 * GRAVITY * fall), 120
    since = frame * STEP - arrival / GRAVITY  # the impacts take a step each, in which gravity acts
    speeds = (made.v[:, :, frame, 1, 1] + GRAVITY * since) / arrival
    exact = np.array([speed_after_impacts_in_sequence(e) for e in ratios])
    holds("impacts in sequence: speed of the upper disc, of its arrival", speeds - exact[:, None], 2e-3)


def test_c10_disc_rolls_down_without_slip():
    made, t = watch([on_slope(friction=0.8)]), times(721)[120:]
    a = 2 / 3 * GRAVITY * SIN
    way = downhill(made.x[:, :, -1, 0] - made.x[:, :, 0, 0])
    v, rim = downhill(made.v[..., 0, :]), -made.spin[..., 0] * RADIUS
    holds("C10 rolling: way in 3 s, relative", way / (a * 3**2 / 2) - 1, 1e-4)
    holds("C10 rolling: speed, relative", v[..., 120:] / (a * t) - 1, 1e-4)
    holds("C10 rolling: rim speed, relative", rim[..., 120:] / (a * t) - 1, 1e-4)
    holds("C10 rolling: slip, m/s", v - rim, 1e-3)


def test_c11_disc_rolls_down_with_slip():
    mu, t = 0.05, times(721)[120:]
    made = watch([on_slope(friction=mu)])
    way = downhill(made.x[:, :, -1, 0] - made.x[:, :, 0, 0])
    v, rim = downhill(made.v[..., 120:, 0, :]), -made.spin[..., 120:, 0] * RADIUS
    a = GRAVITY * (SIN - mu * COS)
    holds("C11 slipping: way in 3 s, relative", way / (a * 3**2 / 2) - 1, 1e-4)
    holds("C11 slipping: speed, relative", v / (a * t) - 1, 1e-4)
    holds("C11 slipping: rim speed, relative", rim / (2 * mu * GRAVITY * COS * t) - 1, 1e-4)


def test_c11_slip_begins_at_a_third_of_the_slope():
    made = watch([on_slope(friction=0.118), on_slope(friction=0.125)])
    slip = downhill(made.v[:, :, -1, 0]) + made.spin[:, :, -1, 0] * RADIUS
    exact = GRAVITY * (SIN - 3 * 0.118 * COS) * 3
    holds("C11 slip of mu = .118 after 3 s, relative", slip[0] / exact - 1, 1e-2)
    holds("C11 slip of mu = .125 after 3 s, m/s", slip[1], 1e-3)


def test_c12_sliding_disc_begins_to_roll():
    u, mu = 5.0, 0.3
    start = {"x": (-5, RADIUS), "v": (u, 0), "elasticity": 0, "friction": mu}
    made, t = watch([Case([start], [FLOOR], DOWN)]), times(721)
    rolls, way = u / (3 * mu * GRAVITY), 5 * u**2 / (18 * mu * GRAVITY)
    v, rim = made.v[..., 0, 0], -made.spin[..., 0] * RADIUS
    holds("C12 slide to roll: final speed, m/s", v[..., t > rolls + 2 * STEP] - 2 / 3 * u, 1e-3)
    holds("C12 slide to roll: final rim speed, m/s", rim[..., t > rolls + 2 * STEP] - 2 / 3 * u, 1e-3)
    end = way + (3 - rolls) * 2 / 3 * u
    then = np.array([np.interp(rolls, t, x) for x in made.x[0, :, :, 0, 0] + 5])
    holds("C12 slide to roll: way until it rolls, relative", then / way - 1, 5e-3)
    holds("C12 slide to roll: way after 3 s, relative", (made.x[..., -1, 0, 0] + 5) / end - 1, 5e-3)


def test_c13_locked_disc_stops_after_u_squared_over_2_mu_g():
    """Of first order in the step: see the order of convergence in test_invariants.py."""
    # Needs the key `moment` of a disc in worlds.world; infinity locks its rotation.
    u, mu = 5.0, 0.3
    start = {"x": (-2, RADIUS), "v": (u, 0), "elasticity": 0, "friction": mu, "moment": np.inf}
    made = watch([Case([start], [FLOOR], DOWN)])
    holds("C13 stop distance, m", made.x[..., -1, 0, 0] + 2 - u**2 / (2 * mu * GRAVITY), 1.5e-2)
    holds("C13 speed after the stop, m/s", made.v[:, :, -240:, 0], 1e-3)
    holds("C13 spin of a locked disc, rad/s", made.spin, 0)


def test_c14_locked_disc_stands_on_a_slope_up_to_the_angle_of_friction():
    limit = SIN / COS
    cases = [on_slope(friction=limit * (1 + part), moment=np.inf) for part in (0.03, -0.03)]
    made = watch(cases, 2401)
    way = downhill(made.x[..., 0, :] - made.x[..., :1, 0, :])
    holds("C14 mu = 1.03 tan: drift in 10 s, m", way[0], 1e-3)
    holds("C14 mu = .97 tan: way in 10 s, relative", way[1, :, -1] / (0.03 * GRAVITY * SIN * 100 / 2) - 1, 1e-2)
    assert (np.diff(downhill(made.v[1, :, ::240, 0])) > 0).all()


@pytest.mark.full
def test_c15_pyramid_of_three_stands_from_2_minus_sqrt_3_on():
    """Friction between the discs; that of the floor is 1."""

    def pyramid(mu: float) -> Case:
        own = np.sqrt(mu)  # friction is the product of both
        places = [(-RADIUS, RADIUS), (RADIUS, RADIUS), (0, RADIUS + np.sqrt(3) * RADIUS)]
        discs = [{"x": x, "elasticity": 0, "friction": own} for x in places]
        return Case(discs, [{**FLOOR, "friction": 1 / own}], DOWN)

    made = watch([pyramid(0.28), pyramid(0.26)], 601, 4, slots=8)
    drop = made.x[..., :1, 2, 1] - made.x[..., 2, 1]
    holds("C15 pyramid of mu = .28: drop in 10 s, m", drop[0], 1e-3)
    assert (drop[1, :, -1] > 0.1).all(), f"mu = .26 has to fall: {drop[1, :, -1]} m"


# Long runs ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_c20_billiard_is_a_straight_line_in_the_unfolded_plane():
    radius, v, side = 0.1, np.array([3.1, 2.3]), 1.0
    case = Case([{"x": (0.5, 0.5), "v": v, "radius": radius}], box(side, centre=(0.5, 0.5)))
    made, t = watch([case], 3601, 4, walls=4), times(3601, 4 * STEP)
    room = side - 2 * radius
    folded = np.abs((0.5 - radius + v * t[:, None] + room) % (2 * room) - room) + radius
    early = t <= 10
    holds("C20 billiard: place, 10 s, m", (made.x[..., 0, :] - folded)[..., early, :], 1e-3)
    energy = (made.v[..., 0, :] ** 2).sum(-1) / (v**2).sum()
    holds("C20 billiard: energy, 60 s, relative", energy - 1, 5e-5)


@pytest.mark.slow
def test_c21_rolling_resistance_is_a_constant_deceleration():
    """The key `rolling` of a disc bounds the torque that resists rolling: rolling x radius x normal force.

    With a = -(2/3) rolling g for a solid disc that rolls on.
    """
    u, rolling = 3.0, 0.05
    start = {"x": (-5, RADIUS), "v": (u, 0), "spin": -u / RADIUS, "elasticity": 0, "friction": 0.5}
    made, t = watch([Case([{**start, "rolling": rolling}], [FLOOR], DOWN)]), times(721)[1:]
    slowed = (u - made.v[..., 1:, 0, 0]) / t
    error = slowed / (2 / 3 * rolling * GRAVITY) - 1
    holds("C21 rolling resistance: deceleration, relative", error, 1e-2)
