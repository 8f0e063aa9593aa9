"""Measure live topics with real processes: `python tools/live_bench --help`.

Lives here: latency, rates and faults. A camera and a reader are in this process, the commands under test in
processes of their own.
"""
