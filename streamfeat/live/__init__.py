"""Live topics: zenoh keys and ROS 2 topics over zenoh, in and out.

Lives here: names and attachments, zenoh sessions, the bounded inbox, checkpoints, metrics, and the live jobs.
Not here: what is computed from events, tasks and queues (`stream`), delivery and clocks (`messages`).
"""
