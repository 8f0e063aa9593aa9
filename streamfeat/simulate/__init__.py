"""Simulated events: what an event camera would see of moving images.

Lives here: the camera model, saccades, and moving digits.
Not here: files.
"""
