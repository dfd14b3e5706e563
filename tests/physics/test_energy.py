"""What a simulation says about itself: the books of energy and momentum, and the rows of contacts."""

import jax
import numpy as np
import pytest
from laws import DOWN, GRAVITY, POSES, Case, holds, pose_world, to_double
from test_invariants import gas
from worlds import STEP, box, energies, momenta, rules, run, world

from gen2d.core.enums import BEGIN, END, IMPACT, PERSIST
from gen2d.physics.simulate import SaveAt
from gen2d.records.trajectory import Contacts

FRAMES = 241
EVERYTHING = SaveAt(contacts=6000, energy=True)


def made(relax_iterations: int | None = None) -> tuple:
    """Eight discs that come to rest in a box, in frames of one step."""
    worlds = [gas(seed, 0.6, 0.4, DOWN) for seed in range(8)]
    return worlds, run(worlds, FRAMES, 1, rules(relax_iterations=relax_iterations), EVERYTHING)


@pytest.mark.parametrize(
    "relax_iterations", [None, *(pytest.param(passes, marks=pytest.mark.full) for passes in (1, 4))]
)
def test_books_and_rows_agree_with_the_states(relax_iterations):
    worlds, found = made(relax_iterations)
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
        missing = missing_impulses(scene, found, i, 8, DOWN)
        holds("rows: impulses against change of momentum, N s", missing, 1e-5)
        assert found.quality.contacts[i] == beginnings(rows, i)


def beginnings(rows: Contacts, i: int) -> int:
    """Contacts of world i that began, from its rows: each frame is a step."""
    count, rest = 0, {}  # the last frame in which a pair touched and did not bounce
    for a, b, kind, frame in zip(
        *(x[i, : rows.count[i]] for x in (rows.a, rows.b, rows.kind, rows.frame)), strict=True
    ):
        count += kind in (IMPACT, BEGIN) and rest.get((a, b)) != frame - 1
        if kind in (BEGIN, PERSIST):
            rest[a, b] = frame
    return count


def missing_impulses(scene, found, i, discs, gravity):
    """Impulses of the rows of world i less the changes of momentum of its discs in each frame, N s."""
    rows, n = found.contacts, found.contacts.count[i]
    mass, velocity = np.asarray(scene.objects.mass), found.states.velocity[i, :, :discs]
    change = mass[:discs, None] * (np.diff(velocity, axis=0) - np.multiply(gravity, STEP))
    normal = rows.normal[i, :n]
    tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    impulse = rows.normal_impulse[i, :n, None] * normal + rows.tangent_impulse[i, :n, None] * tangent
    given = np.zeros((len(change), len(mass), 2))
    np.add.at(given, (rows.frame[i, :n] - 1, rows.b[i, :n]), impulse)
    np.add.at(given, (rows.frame[i, :n] - 1, rows.a[i, :n]), -impulse)
    return given[:, :discs] - change


@pytest.mark.full
def test_rows_of_discs_that_meet_several_times_in_a_step_agree_with_the_states():
    """Each pass of a fast dense gas gives an impulse along another normal."""
    worlds = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        places = 0.7 + 1.15 * np.indices((4, 4)).reshape(2, -1).T + rng.uniform(-0.05, 0.05, (16, 2))
        discs = [{"x": x, "v": rng.normal(0, 12, 2), "elasticity": 0.3, "friction": 0.3} for x in places]
        worlds.append(world(discs, box(4.9, 0.5, 0.2, (2.45, 2.45))))
    found = run(worlds, 61, 1, keep=SaveAt(contacts=1000))
    assert (found.contacts.count <= 1000).all()
    missing = [missing_impulses(scene, found, i, 16, (0, 0)) for i, (scene, *_) in enumerate(worlds)]
    holds("rows of a fast gas: impulses against change of momentum, N s", missing, 0.03)


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
    holds("drop: place, m", rows.point[0, :2] - [0.25, 0], 1e-4)  # g h^2 / 2: from the speed after the kick
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


@pytest.mark.full
def test_a_contact_is_an_impact_then_persists_then_ends_and_bears_the_weight():
    """A disc lands on a ledge, rolls to its end and falls off."""
    disc = {"x": (-0.5, 0.7), "v": (1, 0), "spin": -2, "elasticity": 0, "friction": 1}
    found = run([world([disc], [{"a": (-1, 0), "b": (1, 0), "friction": 1}], DOWN)], 181, 4, keep=EVERYTHING)
    rows, n = found.contacts, int(found.contacts.count[0])
    kinds, frames = rows.kind[0, :n], rows.frame[0, :n]
    end = list(kinds).index(END)
    assert kinds[0] == IMPACT
    assert (kinds[1:end] == PERSIST).all()
    assert list(np.diff(frames[: end + 1])) == [1] * end
    assert (rows.b[0, :n] == 0).all()
    assert (rows.a[0, :n] == 1).all()
    fall = np.sqrt(2 * 0.2 / GRAVITY)
    holds("landing: time, s", rows.time[0, 0] - fall, 1e-4)
    holds("landing: separation, m/s", rows.separation_speed[0, 0], 0)
    holds(
        "rolling: impulse a frame, relative", rows.normal_impulse[0, 2 : n // 2] * 60 / (np.pi / 4 * GRAVITY) - 1, 1e-3
    )
    assert 1 < found.states.position[0, frames[end], 0, 0] < 1.5  # it turns about the end before it leaves
    assert found.quality.contacts[0] < 10
    holds(
        "quality: deepest overlap, m",
        found.quality.max_penetration[0] - (0.5 - found.states.position[0, :, 0, 1])[:90].max(),
        1e-4,
    )


@pytest.mark.full
def test_forces_and_damping_do_the_work_of_their_closed_forms():
    """A disc under gravity, a force and a torque, with damping; another that is only damped."""
    rate, mass, force, torque = 0.5, np.pi / 4, np.array([2.0, 1.0]), 0.3
    moment, start, spin = mass / 8, np.array([3.0, 4.0]), 5.0
    pushed = world([{"v": start, "spin": spin, "force": force, "torque": torque}], (), DOWN)
    damped = world([{"v": start, "spin": spin, "force": (0, 0), "torque": 0.0}], (), (0, 0))
    found = run([pushed, damped], 181, 4, rules(damping=rate), EVERYTHING)
    t = np.linspace(0, 3, 18001)
    slowed = np.exp(-rate * t)
    for k, (pull, twist) in enumerate(((np.add(DOWN, force / mass), torque / moment), ((0, 0), 0.0))):
        late = (1 - slowed) / rate
        v, w = slowed[:, None] * start + late[:, None] * pull, slowed * spin + late * twist
        way = late[:, None] * start + ((t - late) / rate)[:, None] * pull
        turn = late * spin + (t - late) / rate * twist
        holds("damped flight under forces: place, m", found.states.position[k, :, 0] - way[::100], 2e-4)
        holds("damped flight under forces: angle, rad", found.states.angle[k, :, 0] - turn[::100], 2e-4)
        power = rate * (mass * (v**2).sum(1) + moment * w**2)
        lost = np.concatenate([[0], np.cumsum((power[1:] + power[:-1]) / 2)]) * (t[1] - t[0])
        put_in = (way @ force + torque * turn) * (k == 0)
        holds("damped flight under forces: lost to damping, J", found.energy.lost_to_damping[k] - lost[::100], 2e-3)
        holds("damped flight under forces: put in, J", found.energy.work_in[k] - put_in[::100], 2e-3)
        holds("damped flight under forces: residual, J", found.energy.residual[k], 1e-3)
