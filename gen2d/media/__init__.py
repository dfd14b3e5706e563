"""Pictures and films as files; nothing here knows of simulations."""
