"""Measuring latency: how long an event takes to become features, and features to reach a user.

Lives here: the compiled stopwatch, updates, end to end, HDR histograms, pictures.
Not here: anything that a measured path needs; a measured path runs the same code as ever.
"""
