"""Recordings: MCAP files, whatever state they are in.

Lives here: records, reading, writing, recovering, labelled samples. mcap is imported here only.
Not here: what is computed from the events.
"""
