"""What is said of fields that a dataset does not have."""

import difflib
from collections.abc import Iterable

# Options that make fields, by the beginnings of their names; the first that fits counts.
MAKERS = {
    "frames": "storage.frames=video",
    "masks/amodal": "annotations.amodal=true",
    "masks/": "annotations.masks=true",
    "boxes/": "annotations.boxes=true",
    "visibility/": "annotations.visibility=true",
    "quality/min_visibility": "annotations.visibility=true",
    "flow/": "annotations.flow=true",
    "tracks/": "annotations.tracks=8",
    "contacts/": "annotations.contacts=4",
    "energy/": "annotations.energy=true",
    "momentum/": "annotations.energy=true",
    "quality/energy_residual": "annotations.energy=true",
    "quality/lyapunov": "annotations.lyapunov=true",
    "text/": "annotations.captions=true",
}
RENDERED = "frames", "masks/", "boxes/", "visibility/", "flow/", "tracks/"  # what can be rendered from states
CLOSE = 0.6  # of difflib
MOST = 12  # names in a list


def suggestion(name: str, names: Iterable[str]) -> str:
    """End of a sentence that says that there is no field of this name: the option that makes it, or close names."""
    known = list(names)
    group, separator, last = name.rpartition("/")
    own = {each.rpartition("/")[2]: each for each in known if each.rpartition("/")[0] == group} if separator else {}
    near_own = [own[each] for each in difflib.get_close_matches(last, own, 1, CLOSE)]
    near = near_own or ([] if own else difflib.get_close_matches(name, known, 1, CLOSE))
    maker = next((option for begin, option in MAKERS.items() if name.startswith(begin)), None)
    if maker is not None and not near_own:
        renders = "render={} in gen2d.open renders it, and " if name.startswith(RENDERED) else ""
        return f", which is not stored: {renders}the option {maker} of gen2d.generate stores it"
    if near:
        return f": did you mean {near[0]!r}?"
    listed = list(own.values()) or known
    more = f" and {len(listed) - MOST} more" if len(listed) > MOST else ""
    return f": it has {', '.join(listed[:MOST])}{more}"
