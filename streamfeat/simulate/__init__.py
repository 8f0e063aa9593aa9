"""Simulated events of an event camera: of still images that it looks at with saccades, and of films.

Lives here: the camera model, saccades, moving digits, and what image files and videos show.
Not here: recordings made of it (`streamfeat.convert.simulation`).
"""
