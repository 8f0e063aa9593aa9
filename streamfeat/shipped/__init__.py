"""Files that ship with the package, ready for use.

Lives here: the general model, learned from simulated scenes, and the file that it is in.
Not here: making it (`tools/make_general_model.py`), and models of one's own (`learn`).
"""
