"""Looks: one file each, found by name; a look says what each slot is drawn as, `gen2d.raster` draws it."""
