"""Learning an encoder from unlabelled events: the paper's two formulations.

Lives here: local volumes out of recordings (`volumes`), whitening, the transform learner (direct), the
dictionary learner (inverse), and the step from learned matrices to an `Encoder` (`fit`).
Not here: anything that needs labels (`classifier`).
"""
