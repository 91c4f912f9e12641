"""Experiment files, the runner, metrics, the report and the command line."""
