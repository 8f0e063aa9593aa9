"""Break streamfeat on purpose, and count what survives: `python tests/torture --help`.

Lives here: one module for each kind of fault. Not here: anything that streamfeat itself needs.
"""
