"""Accuracies that others have published.

Lives here: the figures of the paper whose method this is, and of those it compares with, with citations.
Not here: anything measured by us.
"""

__all__ = ["ACCURACIES", "PAPER", "PAPER_SWEEPS", "SWEEP_DATA"]

PAPER = (
    "Kostadinov and Scaramuzza, Unsupervised Feature Learning for Event Data: Direct vs Inverse Problem "
    "Formulation, ICPR 2020/21"
)

SWEEP_DATA = "N-Caltech101"
"""Data set of the paper's third table."""

PAPER_SWEEPS: dict[str, dict[int, dict[str, float]]] = {
    "filters": {
        1000: {"inverse": 0.732, "direct": 0.743},
        1500: {"inverse": 0.745, "direct": 0.770},
        1700: {"inverse": 0.784, "direct": 0.771},
        2000: {"inverse": 0.760, "direct": 0.755},
    },
    "patch": {
        4: {"inverse": 0.696, "direct": 0.648},
        12: {"inverse": 0.784, "direct": 0.771},
        16: {"inverse": 0.764, "direct": 0.745},
        21: {"inverse": 0.752, "direct": 0.751},
    },
    "bins": {
        2: {"inverse": 0.617, "direct": 0.632},
        4: {"inverse": 0.724, "direct": 0.691},
        7: {"inverse": 0.784, "direct": 0.771},
        10: {"inverse": 0.763, "direct": 0.741},
    },
}
"""The paper's third table: accuracy over K, patch and bins, everything else as in its best setting."""

ACCURACIES: dict[str, dict[str, float]] = {
    "direct": {"N-Caltech101": 0.771, "N-CARS": 0.813, "N-MNIST": 0.968},
    "inverse": {"N-Caltech101": 0.784, "N-CARS": 0.847, "N-MNIST": 0.981},
    "hfirst": {"N-Caltech101": 0.060},
    "hots": {"N-Caltech101": 0.210, "N-CARS": 0.624},
    "gabor-snn": {"N-Caltech101": 0.192},
    "hats": {"N-Caltech101": 0.642, "N-CARS": 0.902},
    "dart": {"N-Caltech101": 0.703, "N-MNIST": 0.980},
    "est": {"N-Caltech101": 0.817, "N-CARS": 0.925},
}
"""Accuracies of each method on recorded data, by data set: the paper's first two tables, and what they cite.

All 101 classes of N-Caltech101; N-CARS on its official split but for `direct` and `inverse`, which the
paper has on its own; HFirst as a whole network; EST with a ResNet-34 that had seen ImageNet. Trained on
events that were simulated from the images, a network has 0.901 on N-Caltech101 (Gehrig et al. 2020, VID2E).
"""
