"""What every other package may use: errors, descriptions of fields, progress."""
