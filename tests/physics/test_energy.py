"""What a simulation says about itself: the books of energy and momentum, and the rows of contacts."""

import jax
import numpy as np
import pytest
from laws import DOWN, GRAVITY, POSES, Case, holds, pose_world, to_double
from test_invariants import gas
from worlds import STEP, energies, momenta, run, world

from gen2d.physics.simulate import SaveAt

FRAMES = 241
EVERYTHING = SaveAt(contacts=6000, energy=True)


def made() -> tuple:
    """Eight discs that come to rest in a box, in frames of one step."""
    worlds = [gas(seed, 0.6, 0.4, DOWN) for seed in range(8)]
    return worlds, run(worlds, FRAMES, 1, keep=EVERYTHING)


def test_books_and_rows_agree_with_the_states():
    worlds, found = made()
    energy, rows = found.energy, found.contacts
    total = energy.kinetic + energy.rotational + energy.potential
    most = np.abs(total).max(1)
    holds("books: total energy, relative", (total - energies(worlds, found)) / most[:, None], 1e-5)
    holds("books: residual, relative", energy.residual / most[:, None], 1e-4)
    holds("quality: largest residual, J", found.quality.energy_residual - np.abs(energy.residual).max(1), 0)
    linear, angular = momenta(worlds, found)
    holds("books: momentum, kg m/s", energy.linear - linear, 1e-3)
    holds("books: angular momentum, kg m^2/s", energy.angular - angular, 1e-2)
    assert (np.diff(energy.lost_in_contact.astype(float)[:, ::20]) > -1e-4 * most[:, None]).all()
    assert (energy.work_in == 0).all()
    assert (energy.lost_to_damping == 0).all()

    assert (rows.count <= EVERYTHING.contacts).all()
    for i, (scene, *_) in enumerate(worlds):
        n = rows.count[i]
        assert (rows.kind[i, :n] > 0).all()
        assert (rows.kind[i, n:] == 0).all()
        assert (np.diff(rows.time[i, :n]) >= 0).all()
        late = rows.time[i, :n] - (rows.frame[i, :n] - 1) * STEP
        assert ((late > -1e-6) & (late < STEP + 1e-6)).all()
        mass = np.asarray(scene.objects.mass)[:8]
        change = mass[:, None] * (np.diff(found.states.velocity[i, :, :8], axis=0) - np.multiply(DOWN, STEP))
        normal = rows.normal[i, :n]
        tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
        impulse = rows.normal_impulse[i, :n, None] * normal + rows.tangent_impulse[i, :n, None] * tangent
        given = np.zeros((FRAMES - 1, len(scene.objects.mass), 2))
        np.add.at(given, (rows.frame[i, :n] - 1, rows.b[i, :n]), impulse)
        np.add.at(given, (rows.frame[i, :n] - 1, rows.a[i, :n]), -impulse)
        holds("rows: impulses against change of momentum, N s", given[:, :8] - change, 1e-5)


@pytest.mark.full
def test_falling_disc_tells_its_bounces():
    """Where, when, how fast and how hard are closed forms; in double precision the books close to rounding."""
    with jax.enable_x64(True):
        drop = to_double([world([{"x": (0.25, 2.5), "elasticity": 0.5}], [{"a": (-5, 0), "b": (5, 0)}], DOWN)])
        found = run(drop, 181, 2, keep=EVERYTHING)
    rows, mass = found.contacts, np.pi / 4
    first = np.sqrt(2 * 2 / GRAVITY)
    times = [first, 2 * first]  # of flight: e v up and down again takes as long as the fall
    assert list(rows.kind[0, :2]) == [1, 1]
    holds("drop: times, s", rows.time[0, :2] - times, 1e-6)
    holds("drop: approach, m/s", rows.approach_speed[0, :2] - GRAVITY * first * np.array([1, 0.5]), 1e-5)
    holds("drop: separation, m/s", rows.separation_speed[0, :2] - GRAVITY * first * np.array([0.5, 0.25]), 1e-5)
    holds("drop: place, m", rows.point[0, :2] - [0.25, 0], 1e-4)  # g h^2 / 2: told from the speed after the kick
    holds("drop: impulse, N s", rows.normal_impulse[0, 0] - mass * 1.5 * GRAVITY * first, 1e-5)
    holds("drop: books in double precision, J", found.energy.residual, 1e-9)
    lost = mass * GRAVITY * 2 * 0.75
    at = round((times[1] + times[0]) / 2 / (2 * STEP))
    holds("drop: lost in the first bounce, J", found.energy.lost_in_contact[0, at] - lost, 1e-6)


@pytest.mark.full
def test_c16_contacts_carry_the_weight_in_a_zigzag_channel():
    """Eight smooth discs lean on each other and on the walls of a channel 1.6 diameters wide; statics is a sum."""
    count, width, radius, steps, share = 8, 1.6, 0.5, 4, 60  # number, m, m, steps a frame, frames that are averaged
    side, rise = width / 2 - radius, np.sqrt(1 - (width - 1) ** 2)  # sine of the angle of two neighbours' line
    discs = [{"x": ((-1) ** k * side, radius + k * rise), "elasticity": 0} for k in range(count)]
    walls = [{"a": (s * width / 2, -1), "b": (s * width / 2, 20), "elasticity": 0} for s in (-1, 1)]
    case = Case(discs, [{"a": (-5, 0), "b": (5, 0), "elasticity": 0}, *walls], DOWN)
    rows = run([pose_world(case, pose, 8, 4) for pose in POSES], FRAMES, steps, keep=EVERYTHING).contacts
    assert (rows.count <= EVERYTHING.contacts).all()
    weight = np.pi * radius**2 * GRAVITY
    late = rows.frame >= FRAMES - share

    def force(one: int, other: int) -> np.ndarray:
        pair = ((rows.a == one) & (rows.b == other)) | ((rows.a == other) & (rows.b == one))
        return np.where(late & pair, rows.normal_impulse, 0.0).sum(1) / (share * steps * STEP)

    between = np.array([force(k, k + 1) * rise / (weight * (count - 1 - k)) for k in range(count - 1)])
    holds("C16 zigzag channel: forces between discs, relative", between - 1, 1e-2)
    holds("C16 zigzag channel: force on the floor, relative", force(0, count) / (count * weight) - 1, 1e-4)
