"""Pages and machines that figures are reported with.

Lives here: self-contained HTML pages, and the description of the machine that a figure was measured on.
Not here: the figures themselves.
"""
