"""Simulated events of an event camera that sees moving images.

Lives here: the camera model, saccades, and moving digits.
Not here: files.
"""
