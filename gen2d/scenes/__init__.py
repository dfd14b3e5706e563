"""Scene families: one file each, found by name. A family has `Options`, `layout`, `factors` and `sample`."""
