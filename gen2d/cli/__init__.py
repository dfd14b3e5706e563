"""The command line: one module for what each verb prints."""
