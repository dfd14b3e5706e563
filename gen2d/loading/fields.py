"""What is said of fields that a dataset does not have."""

import difflib
import fnmatch
from collections.abc import Iterable

# Fields that only some datasets have, by the option that makes them.
_MADE = {
    "storage.frames=video": "frames",
    "annotations.amodal=true": "masks/amodal",
    "annotations.masks=true": "masks/instance",
    "annotations.boxes=true": "boxes/amodal boxes/visible",
    "annotations.visibility=true": "visibility/fraction visibility/pixels quality/min_visibility",
    "annotations.flow=true": "flow/forward flow/forward_valid flow/backward flow/backward_valid",
    "annotations.tracks=8": "tracks/points tracks/visible tracks/object",
    "annotations.centers=true": "centers/points centers/visible",
    "annotations.depth=true": "surface/height",
    "annotations.normals=true": "surface/normal",
    "annotations.shadow=true": "surface/shadow",
    "annotations.classes=true": "objects/class_name",
    "annotations.contacts=4": (
        "contacts/a contacts/b contacts/count contacts/time contacts/frame contacts/point contacts/normal "
        "contacts/kind contacts/normal_impulse contacts/tangent_impulse contacts/approach_speed "
        "contacts/separation_speed"
    ),
    "annotations.energy=true": (
        "energy/kinetic energy/rotational energy/potential energy/lost_in_contact energy/lost_to_damping "
        "energy/work_in energy/residual momentum/linear momentum/angular quality/energy_residual"
    ),
    "annotations.lyapunov=true": "quality/lyapunov",
    "annotations.captions=true": "text/caption text/short_caption text/questions text/events text/event_count",
    "matched.change": (
        "matched/set matched/member matched/kind matched/onset matched/object matched/partner matched/size"
    ),
}
MAKERS = {name: option for option, names in _MADE.items() for name in names.split()}
# What can be rendered from states.
RENDERED = "frames", "masks/", "boxes/", "visibility/", "flow/", "tracks/", "centers/", "surface/"
CLOSE = 0.6  # of difflib
MOST = 12  # names in a list


def suggestion(name: str, names: Iterable[str]) -> str:
    """End of a sentence that says that there is no field of this name: the option that makes it, or close names."""
    known = list(names)
    absent = [each for each in MAKERS if each not in known]
    group, separator, last = name.rpartition("/")
    own = {each.rpartition("/")[2]: each for each in [*known, *absent] if each.rpartition("/")[0] == group}
    near = difflib.get_close_matches(last, own, 1, CLOSE) if separator else []
    of_pattern = fnmatch.filter(absent, name)
    found = of_pattern[0] if of_pattern else own[near[0]] if near else ""
    if not found and not (own and separator):
        candidates = [*known, *absent] if separator else known
        found = next(iter(difflib.get_close_matches(name, candidates, 1, CLOSE)), "")
    if found in absent:
        meant = "" if of_pattern else f": did you mean {found!r}"
        renders = "render={} in gen2d.open renders it, and " if found.startswith(RENDERED) else ""
        return f"{meant}, which is not stored: {renders}the option {MAKERS[found]} of gen2d.generate stores it"
    if found:
        return f": did you mean {found!r}?"
    listed = [each for each in own.values() if each in known] if separator else []
    listed = listed or known
    more = f" and {len(listed) - MOST} more" if len(listed) > MOST else ""
    makers = sorted({MAKERS[each] for each in own.values() if each in absent}) if separator else []
    made = f"; {' and '.join(makers)} make{'s' * (len(makers) == 1)} others of {group}/" if makers else ""
    return f": it has {', '.join(listed[:MOST])}{more}{made}"
