"""Export of datasets to the formats of other programs."""
