"""The demonstration: simulated digits, learned and classified in the terminal.

Lives here: the job, and the picture that it draws.
Not here: anything that other rooms need.
"""
