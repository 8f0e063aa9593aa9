"""Pieces of work, wherever they run: on threads of this process or on a Dask cluster.

Lives here: what a place to work can do, and services that run until they are ended.
Not here: what the work is. Dask is imported here only.
"""
