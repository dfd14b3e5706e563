"""SHA-256 of every stored field of 64 videos of ten families: proof that a change of code changes no bit.

    python tests/support/golden.py before.json           (on the commit before)
    python tests/support/golden.py after.json before.json

With a second file the hashes are compared: fields that differ are printed, and the exit status is 1 if there are any.
Hashes depend on the machine's instruction set and on jax's version, so they are not part of the project.
"""

import argparse
import hashlib
import json
import pathlib
import tempfile

import numpy as np

import gen2d

VIDEOS = 64
ANNOTATED = [
    *(f"annotations.{name}=true" for name in ("masks", "amodal", "boxes", "visibility", "flow", "energy", "captions")),
    "annotations.tracks=2",
    "annotations.contacts=4",
]
OVERRIDES = {
    "bouncing": [*ANNOTATED, "annotations.lyapunov=true"],
    "billiards": ["look=textured", "annotations.contacts=4"],
    "pile": ["look=shaded"],
    "ramp": [*ANNOTATED, "look=outline"],
    "galton": ["annotations.contacts=4", "annotations.captions=true"],
    "marble_run": ["look=marked", "camera.shake=0.05", "image.exposure=0.5", "image.exposure_samples=4"],
    "occluder": ["annotations.masks=true", "annotations.visibility=true", "image.noise=4", "image.occluders=2"],
    "tower": ["annotations.energy=true", "look.palette=random"],
    "seesaw": ["annotations.energy=true", "camera.follow=0", "annotations.flow=true"],
    "chain": ["annotations.contacts=4", "annotations.energy=true", "annotations.boxes=true"],
}


def field_hashes(family: str) -> dict[str, str]:
    """Hash of each stored field of a family's first videos, by stored name."""
    with tempfile.TemporaryDirectory() as folder:
        gen2d.generate(f"{family}.yaml", VIDEOS, folder, overwrite=True, overrides=OVERRIDES[family])
        batch = gen2d.open(folder, "train", fields=["*"])[:]
        hashes = {}
        for name, values in sorted(batch.items()):
            described = f"{values.dtype}{values.shape}".encode()
            hashes[name] = hashlib.sha256(described + np.ascontiguousarray(values).tobytes()).hexdigest()[:16]
        return hashes


def main() -> int:
    """Write the hashes, and compare them with those of another run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=pathlib.Path, help="JSON file to write")
    parser.add_argument("before", type=pathlib.Path, nargs="?", help="JSON file of another run")
    parser.add_argument("--only", nargs="+", choices=sorted(OVERRIDES), default=list(OVERRIDES), help="families")
    args = parser.parse_args()
    after = {family: field_hashes(family) for family in args.only}
    args.out.write_text(json.dumps(after, indent=1))
    print(f"{sum(map(len, after.values()))} fields of {len(after)} families written to {args.out}")
    if args.before is None:
        return 0
    before = json.loads(args.before.read_text())
    names = {(family, name) for family in after for name in after[family] | before.get(family, {})}
    changed = sorted((f, n) for f, n in names if before.get(f, {}).get(n) != after[f].get(n))
    for family, name in changed:
        print(f"{family}: {name} differs")
    print(f"{len(names) - len(changed)} of {len(names)} fields are equal")
    return 1 if changed else 0


if __name__ == "__main__":
    raise SystemExit(main())
