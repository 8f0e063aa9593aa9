"""The engine: volumes, operator, state, and the rules for changing them.

Lives here: the frozen encoder, the streaming engine, and the offline path that must give the same bits.
Not here: clocks, I/O, labels, classifiers.
"""
