"""Every `@njit` function of the package: arrays in, arrays changed.

Lives here: loops over events, entries and filters; each releases the GIL and is cached on disk.
Not here: validation of arguments, allocation, Python objects, clocks. Each kernel has a slow,
obvious twin of the same name in `tests/naive.py`.
"""
