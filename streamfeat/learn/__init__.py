"""Learning an encoder from unlabelled events: the paper's two formulations.

Lives here: local volumes out of recordings (`volumes`), walking through them (`chunks`), whitening, the
transform learner (direct) and the dictionary learner (inverse) with the loop (`alternation`) and the penalty
(`omega`) that they share, and the step from learned matrices to an `Encoder` (`fit`).
Not here: anything that needs labels (`classifier`).
"""
