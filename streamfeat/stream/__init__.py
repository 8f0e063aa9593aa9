"""The main job: items of a stream in, emissions out.

Lives here: sessions, cameras, the asynchronous pipeline, sinks, and the replay of a recording.
Not here: live topics, and anything that draws.
"""
