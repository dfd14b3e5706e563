"""The solver: contacts, joints, energy, and the loop over frames."""
