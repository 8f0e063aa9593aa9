"""How well features serve recognition, beside those of others.

Lives here: held-out and prequential scores of learned features and of baselines, sweeps, early decisions.
Not here: learning (`learn`), the classifier (`classifier`), speed (`latency`).
"""
