"""The encoder and the classifier of a job, from files or as they are.

Lives here: loading both, and refusing those that do not belong together.
Not here: their formats (`engine.encoder`, `classify`).
"""

from os import PathLike

from streamfeat.classify.classifier import Classifier
from streamfeat.classify.kernel import KernelClassifier, load_classifier
from streamfeat.engine.encoder import Encoder
from streamfeat.shipped.general import general_encoder

__all__ = ["AnyClassifier", "ClassifierSource", "ModelSource", "open_models"]

AnyClassifier = Classifier | KernelClassifier
ModelSource = str | PathLike[str] | Encoder
ClassifierSource = str | PathLike[str] | AnyClassifier


def open_models(
    model: ModelSource | None, classifier: ClassifierSource | None
) -> tuple[Encoder, AnyClassifier | None]:
    """Load what is given as a path; what is loaded already is taken as it is, no model means the general one.

    Raises:
        InputError: a file is not what it should be, or the classifier was trained with another model.
    """
    if model is None:
        encoder = general_encoder()
    else:
        encoder = model if isinstance(model, Encoder) else Encoder.load(str(model))
    if classifier is None:
        return encoder, None
    if isinstance(classifier, AnyClassifier):
        classifier.check_fits(encoder)
        return encoder, classifier
    loaded = load_classifier(str(classifier))
    loaded.check_fits(encoder, path=str(classifier))
    return encoder, loaded
