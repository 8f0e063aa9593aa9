"""Small faults, put in on purpose, that the tests must notice: `python -m tools.mutate`."""
