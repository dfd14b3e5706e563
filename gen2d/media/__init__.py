"""Pictures and films as files, independent of simulations."""
