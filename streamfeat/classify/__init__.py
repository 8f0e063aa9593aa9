"""From features to labels.

Lives here: the classifier, its training offline and online, and features as a scikit-learn step.
Not here: how features are computed, and how they are compared.
"""
