"""Tools for datasets: verify, preview, gallery."""
