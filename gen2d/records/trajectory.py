"""A simulated video before it is rendered: states, contacts, energy and quality measures."""

from gen2d.records.axes import Array, axes, record
from gen2d.records.scene import State


@record
class Quality:
    """Per-video quality measures of the simulation."""

    max_penetration: Array = axes("quality/max_penetration", "n", "m", "depth of the deepest overlap at any step")
    contacts: Array = axes("quality/contacts", "n", "1", "number of contacts that began, bounces included", "int32")
    energy_residual: Array | None = axes(
        "quality/energy_residual", "n", "J", "largest residual of the energy balance in any frame", default=None
    )


@record
class Contacts:
    """Contact log: one row for each pair and frame in which the pair touched, ordered by time; unused rows are zero."""

    time: Array = axes("contacts/time", "n C", "s", "time of the first touch in the frame's interval", "float64")
    frame: Array = axes("contacts/frame", "n C", "1", "first frame at or after the touch", "int32")
    a: Array = axes("contacts/a", "n C", "object", "slot of the object that the normal leaves", "int16")
    b: Array = axes("contacts/b", "n C", "object", "slot of the object that the normal enters", "int16")
    point: Array = axes("contacts/point", "n C 2", "m", "point of the first touch")
    normal: Array = axes("contacts/normal", "n C 2", "1", "unit normal from a to b")
    normal_impulse: Array = axes(
        "contacts/normal_impulse", "n C", "N s", "impulse on b along the normal, over the frame"
    )
    tangent_impulse: Array = axes(
        "contacts/tangent_impulse", "n C", "N s", "impulse on b along the tangent, left of the normal"
    )
    approach_speed: Array = axes(
        "contacts/approach_speed", "n C", "m/s", "normal speed of approach before the first touch"
    )
    separation_speed: Array = axes(
        "contacts/separation_speed", "n C", "m/s", "normal speed of separation after the first touch"
    )
    kind: Array = axes("contacts/kind", "n C", "1", "kind: 0 none, 1 impact, 2 begin, 3 persist, 4 end", "uint8")
    count: Array = axes("contacts/count", "n", "1", "number of contacts, including those not stored", "int32")


@record
class Energy:
    """Energy and momentum at every frame. Losses, work and residual are cumulative from frame 0."""

    kinetic: Array = axes("energy/kinetic", "n T", "J", "kinetic energy of the centres of mass")
    rotational: Array = axes("energy/rotational", "n T", "J", "kinetic energy of rotation")
    potential: Array = axes("energy/potential", "n T", "J", "potential energy of gravity (0 at the origin) and springs")
    lost_in_contact: Array = axes(
        "energy/lost_in_contact", "n T", "J", "energy lost to impacts, friction, overlap and rigid joints"
    )
    lost_to_damping: Array = axes("energy/lost_to_damping", "n T", "J", "energy lost to damping of bodies and springs")
    work_in: Array = axes("energy/work_in", "n T", "J", "work of forces, torques, motors and kinematic bodies")
    residual: Array = axes("energy/residual", "n T", "J", "change of energy that the other terms do not explain")
    linear: Array = axes("momentum/linear", "n T 2", "kg m/s", "momentum of all dynamic objects")
    angular: Array = axes("momentum/angular", "n T", "kg m^2/s", "angular momentum of dynamic objects about the origin")


@record
class Trajectory:
    """A simulated video before rendering."""

    states: State
    quality: Quality
    contacts: Contacts | None = None
    energy: Energy | None = None
    between: State | None = None  # at every step, [T - 1, steps, ...]; not stored
