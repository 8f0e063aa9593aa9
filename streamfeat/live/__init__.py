"""Live topics: zenoh keys and ROS 2 topics over zenoh, in and out.

Lives here: names and attachments, delivery, camera clocks, the bounded inbox, health, and the live jobs.
Not here: what is computed from events (`session`, `cameras`), tasks and queues (`pipeline`).
"""
