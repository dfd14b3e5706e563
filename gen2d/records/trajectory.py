"""A simulated video before it is rendered: states, contacts, energy and quality measures."""

from gen2d.records.axes import Array, axes, record
from gen2d.records.scene import State


@record
class Quality:
    """Per-video quality measures of the simulation."""

    max_penetration: Array = axes("quality/max_penetration", "n", "m", "deepest overlap of two objects at any step")
    contacts: Array = axes("quality/contacts", "n", "1", "contacts that began, bounces included", "int32")
    energy_residual: Array | None = axes(
        "quality/energy_residual",
        "n",
        "J",
        "largest of any frame: what the books of energy leave unexplained",
        default=None,
    )


@record
class Contacts:
    """Contact log: one row for each pair and frame in which the pair touched, ordered by time; unused rows are zero."""

    time: Array = axes("contacts/time", "n C", "s", "of the first touch in the frame's interval", "float64")
    frame: Array = axes("contacts/frame", "n C", "1", "at whose end, or just before, the touch was", "int32")
    a: Array = axes("contacts/a", "n C", "object", "slot of the one that the normal leaves", "int16")
    b: Array = axes("contacts/b", "n C", "object", "slot of the one that the normal enters", "int16")
    point: Array = axes("contacts/point", "n C 2", "m", "of the first touch")
    normal: Array = axes("contacts/normal", "n C 2", "1", "from a to b")
    normal_impulse: Array = axes("contacts/normal_impulse", "n C", "N s", "on b along the normal, over the frame")
    tangent_impulse: Array = axes("contacts/tangent_impulse", "n C", "N s", "on b a quarter turn left of the normal")
    approach_speed: Array = axes("contacts/approach_speed", "n C", "m/s", "along the normal, before the first touch")
    separation_speed: Array = axes("contacts/separation_speed", "n C", "m/s", "along the normal, after it")
    kind: Array = axes("contacts/kind", "n C", "1", "0 none, 1 impact, 2 begin, 3 persist, 4 end", "uint8")
    count: Array = axes("contacts/count", "n", "1", "rows there were; those over C are not stored", "int32")


@record
class Energy:
    """Energy and momentum at every frame. Losses, work and residual are cumulative from frame 0."""

    kinetic: Array = axes("energy/kinetic", "n T", "J", "of motion of the centres of mass")
    rotational: Array = axes("energy/rotational", "n T", "J", "of spin")
    potential: Array = axes("energy/potential", "n T", "J", "of gravity (0 at the origin) and of springs")
    lost_in_contact: Array = axes(
        "energy/lost_in_contact", "n T", "J", "to impacts, friction, overlap and rigid joints"
    )
    lost_to_damping: Array = axes("energy/lost_to_damping", "n T", "J", "to damping, of bodies and of springs")
    work_in: Array = axes("energy/work_in", "n T", "J", "done by forces, torques, motors and kinematic bodies")
    residual: Array = axes("energy/residual", "n T", "J", "what the terms above do not add up to")
    linear: Array = axes("momentum/linear", "n T 2", "kg m/s", "of all dynamic objects")
    angular: Array = axes("momentum/angular", "n T", "kg m^2/s", "of all dynamic objects, about the origin")


@record
class Trajectory:
    """A simulated video before rendering."""

    states: State
    quality: Quality
    contacts: Contacts | None = None
    energy: Energy | None = None
    between: State | None = None  # at every step, [T - 1, steps, ...]; not stored
