"""Host loop: encode, write and complete a dataset, and regenerate parts of one."""
