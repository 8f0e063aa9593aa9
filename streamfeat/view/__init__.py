"""What an engine sees, as pictures: for Foxglove, for a page in the browser, and into MCAP.

Lives here: everything that a view needs beyond what replaying and listening do anyway.
Not here: replaying (`replay`) and listening (`live`), which a view only watches.
"""
