"""Measure streamfeat against floors and peers: `python tools/bench --help`.

Lives here: one module for each part of the measurement, and the tables made of their results.
Not here: anything that streamfeat itself needs; it is used through its public names.
"""
