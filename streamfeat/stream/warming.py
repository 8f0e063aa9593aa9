"""Compiling kernels before anything waits for them.

Lives here: the one warm-up of all jobs. Not here: the kernels, and numba's cache (`kernels`).
"""

from streamfeat.engine.encoder import Encoder
from streamfeat.events import make_events
from streamfeat.messages.codecs import PAYLOAD_ENCODINGS, encode, make_decoder
from streamfeat.messages.packets import Packet
from streamfeat.stream.compiling import compile_together, state_of
from streamfeat.stream.emission import EmitPolicy
from streamfeat.stream.models import AnyClassifier
from streamfeat.stream.session import Session

__all__ = ["warm_up"]


def warm_up(
    encoder: Encoder,
    policy: EmitPolicy,
    classifier: AnyClassifier | None = None,
    *,
    decoders: bool = False,
) -> None:
    """Compile what the first packets would otherwise have to wait for; quick where it is compiled already.

    Args:
        encoder: kernels depend on its formulation and encoding alone.
        policy: that of the sessions to come.
        classifier: that they predict with.
        decoders: compile those of live payloads, too.
    """
    compile_together(state_of(encoder))
    event = make_events([0], [0], [1], [0])
    if decoders:
        for encoding in PAYLOAD_ENCODINGS:
            payload, base_ns = encode(event, encoding)
            make_decoder(encoding).decode(payload, base_ns)
    # In time and late are the two ways to feed, however long compiling takes.
    for is_late in (False, True):
        session = Session(encoder, policy, classifier, is_behind=lambda log_time_ns, is_late=is_late: is_late)  # type: ignore[misc]
        for _ in session.batches(Packet("", event, encoder.geometry.smallest, 0, 0)):
            pass
        session.rest()
        for _ in session.last_batches():
            pass
