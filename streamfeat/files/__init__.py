"""Files and where they are: paths and URLs, files that appear whole, safetensors, JSON fields.

Lives here: one module for each of these.
Not here: what the bytes mean to the rooms that read and write them.
"""
