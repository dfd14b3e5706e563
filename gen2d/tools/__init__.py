"""What people do with a dataset: verify, preview, gallery."""
