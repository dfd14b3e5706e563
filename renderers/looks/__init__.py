"""Looks: one file each, found by its name; a look says what each slot is drawn as."""
