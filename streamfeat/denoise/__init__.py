"""Noise: events that are taken out before anything is counted or learned.

Lives here: what noise is (`stage`), as one stage that any stream of packets can go through.
Not here: the loop over events (`kernels.denoise`), and where streams come from.
"""
